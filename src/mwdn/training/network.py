"""The network of a run: its initial weights, and the moving average of its weights."""

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor, nn
from torch.optim.swa_utils import get_ema_multi_avg_fn

from mwdn.calibration import Calibration
from mwdn.errors import CheckpointError, ParameterError
from mwdn.inference.methods import psf_for
from mwdn.networks import Network, build
from mwdn.networks.empty import build_empty
from mwdn.networks.network import FixedFront
from mwdn.optics.polynomials import polynomial_order
from mwdn.registration.distortion import measure_distortion
from mwdn.registration.shading import measure_shading
from mwdn.runtime import distributed
from mwdn.training.recipe import Recipe
from mwdn.training.sample_cache import SampleCache
from mwdn.types import Psf
from mwdn.weights.bundled import load_network
from mwdn.weights.checkpoint import first_difference, load_checkpoint
from mwdn.weights.growth import grown

MEASURED_BUFFERS = {"distortion": measure_distortion, "shading": measure_shading}
"""Buffers of a network that are measured from recorded scenes, in this order: the shading of undistorted pictures."""


def build_network(recipe: Recipe) -> nn.Module:
    """The network of a recipe with its initial weights: random ones, or those that the schedule names.

    Raises:
        CheckpointError: the weights do not fit the network.
    """
    with torch.random.fork_rng(devices=[]):  # the caller's random numbers stay theirs
        torch.default_generator.manual_seed(recipe.schedule.seed)
        network = build(**recipe.network)
    start, denoiser = recipe.schedule.start, recipe.schedule.denoiser
    started = load_network(start) if start else network
    if type(started) is not type(network):
        raise CheckpointError(
            f"`start` ('{start}') holds the weights of a `{type(started).__name__}`, but the recipe's network is a "
            f"`{type(network).__name__}`. Give weights of that network, or choose the other one: `network.name`."
        )
    weights = started.state_dict()
    if denoiser:
        weights |= {f"denoiser.{key}": value for key, value in load_checkpoint(denoiser).state_dict().items()}
    try:
        network.load_state_dict(grown(weights, network))
    except RuntimeError as error:
        raise CheckpointError(
            f"`start` ('{start}') must hold the network of the recipe, and `denoiser` ('{denoiser}') its denoiser, if "
            f"it has one: {first_difference(error)}. The recipe has {recipe.network}."
        ) from error
    return network


def takes_channels(network: nn.Module, colours: int) -> bool:
    """Whether a network takes measurements of ``colours`` channels; a `FixedFront` takes grey as equal colours."""
    channels = getattr(network, "channels", colours)
    return channels in (0, colours) or (colours == 1 and isinstance(network, FixedFront))  # 0 is any number


def check_colours(network: Mapping[str, Any], colours: int, *, of: str, way_out: str) -> None:
    """Check that a network takes measurements of ``colours`` channels.

    Args:
        network: its name and options, as in [network] of a recipe.
        colours: channels of the measurements.
        of: what has them, for the message.
        way_out: its last sentence.

    Raises:
        ParameterError: it takes another number of channels.
    """
    built = build_empty(**network)
    if not takes_channels(built, colours):
        raise ParameterError(
            f"`channels` of the network '{network['name']}' ({built.channels}) must be {colours}, as many as the "
            f"measurements of {of} have. {way_out}"
        )


def stored_psf(recipe: Recipe, calibration: Calibration, device: torch.device) -> Psf | None:
    """The PSF (1, C, H, W) for a network that takes it as stored; ``None`` for the others, which take the samples'.

    Raises:
        ParameterError: it does, but the recipe has random cameras, captures without scenes, or aligned pairs.
    """
    network = build_empty(**recipe.network)
    if not (isinstance(network, Network) and network.stored_psf):
        return None
    if recipe.cameras.sizes or recipe.selfsupervised.consistency or recipe.pairs.aligned:
        raise ParameterError(
            f"[network] {recipe.network} takes the PSF as stored, of one camera: leave [cameras], [selfsupervised] and "
            "`aligned` of [pairs] out of the recipe."
        )
    return psf_for(network, calibration).to(device)


@torch.no_grad()
def measure_scenes(cache: SampleCache | None, network: nn.Module, average: nn.Module) -> None:
    """Measure the network's `MEASURED_BUFFERS` from the cached scenes; the mean over all processes.

    Args:
        cache: of the training's samples.
        network: receives the coefficients.
        average: of its weights; computes the reconstructions and receives the coefficients, too.
    """
    for name, measure in MEASURED_BUFFERS.items():
        coefficients = getattr(network, name, None)
        if cache is None or coefficients is None:
            continue
        measured = cache.measured(measure, average, polynomial_order(coefficients.shape[1]) or 0).to(coefficients)
        measured = distributed.all_reduce_sum(measured) / distributed.world_size()
        for each in (network, average):
            each.get_buffer(name).copy_(measured)


@torch.no_grad()
def update_average(
    average: nn.Module,
    network: nn.Module,
    *,
    decay: float,
    start: Mapping[str, Tensor] | None = None,
    share: float = 0.0,
) -> None:
    """Update an exponential moving average of a network's weights; integers (BatchNorm's counters) are copied.

    The average is of ``(1 - share)`` times the weights and ``share`` times those of ``start``, by name; of the weights
    alone if ``start`` has none of that name.
    """
    means, values = [], []
    for (name, value), mean in zip(network.state_dict().items(), average.state_dict().values(), strict=True):
        if value.is_floating_point():
            means.append(mean)
            values.append(value.lerp(start[name], share) if start and share and name in start else value)
        else:
            mean.copy_(value)
    # All at once: hundreds of small operations take long on a GPU.
    get_ema_multi_avg_fn(decay)(means, values, None)  # type: ignore[no-untyped-call]

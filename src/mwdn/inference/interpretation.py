"""Intermediate results of a network for one capture: its PSFs, filters and estimates, scale by scale."""

import copy
from dataclasses import dataclass, field
from typing import Any, Literal, NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from mwdn.arguments import check_batch
from mwdn.errors import ParameterError, ShapeError
from mwdn.fourier.convolution import convolve
from mwdn.fourier.transforms import transfer_function
from mwdn.networks.mwdn import Mwdn
from mwdn.networks.mwdn_cpsf import MwdnCpsf
from mwdn.networks.wiener import WienerNetwork
from mwdn.networks.wiener_bank import WienerBank
from mwdn.networks.wiener_filter import WienerFilter, normalise_psf
from mwdn.networks.wiener_unet import WienerUNet
from mwdn.optics.psf import checked_psf
from mwdn.solvers.alignment import align
from mwdn.types import Measurement, Psf, Scene, size_of

Kind = Literal["light", "psf", "features", "change"]
"""How a picture is displayed: linear light, a PSF, features of any sign, or a change of the picture around 0."""

EXPLAINED = "mwdn, mwdn-cpsf, wiener, wiener-unet or wiener-bank"
"""Names of these networks in [network] of a recipe; the solver `wiener` is something else."""


class Panel(NamedTuple):
    """One picture.

    Args:
        name: in a few words.
        picture: (1, 1 or 3, H, W).
        kind: see `Kind`.
    """

    name: str
    picture: Tensor
    kind: Kind = "light"


@dataclass(frozen=True, eq=False)
class Row:
    """The pictures of one part of a network.

    Args:
        name: of the part.
        panels: its pictures.
        numbers: what was measured of it; ``None`` for a number that it does not have.
    """

    name: str
    panels: tuple[Panel, ...]
    numbers: dict[str, float | None] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Interpretation:
    """What a network did.

    Args:
        network: name of its class.
        rows: part by part, the first for input and output.
        pose: of the PSF that was aligned to the capture: rotation, scale and so on; empty without alignment.
    """

    network: str
    rows: tuple[Row, ...]
    pose: dict[str, float] = field(default_factory=dict)

    def content(self) -> dict[str, Any]:
        """All numbers, in values that JSON can hold."""
        parts = [{"name": row.name, **row.numbers} for row in self.rows if row.numbers]
        return {"network": self.network, "aligned": self.pose, "parts": parts}


@torch.no_grad()
def interpret(network: object, measurement: Measurement, psf: Psf) -> Interpretation:
    """Reconstruct one capture and keep what the network computes on the way.

    Args:
        network: one with Wiener filters, see `EXPLAINED`; on the device of the measurement.
        measurement: (1, C, H, W).
        psf: (1, C, H, W), as the network takes it (`mwdn.inference.methods.psf_for`).

    Raises:
        ParameterError: another network.
        ShapeError: measurement and PSF do not fit, or there are several measurements.
    """
    if not isinstance(network, Mwdn | MwdnCpsf | WienerNetwork | WienerUNet | WienerBank):
        kind = "network" if isinstance(network, nn.Module) else "solver"
        raise ParameterError(
            f"The {kind} `{type(network).__name__}` has no learned Wiener filters to look into. Use universal, "
            f"universal-small, or the checkpoint of a network that has some: {EXPLAINED}."
        )
    check_batch(measurement, "measurement")
    if len(measurement) != 1:
        raise ShapeError(
            f"`measurement` {tuple(measurement.shape)} must be one, (1, C, H, W), because the numbers are of one "
            "capture: `measurement[:1]`."
        )
    network = copy.deepcopy(network).eval()
    psf, pose = checked_psf(psf, scale=not network.stored_psf), {}
    if network.align:
        aligned = align(measurement, psf)
        psf, pose = aligned.move(psf), aligned.numbers()
    result = network(measurement, psf)
    first = Row(
        "input and output",
        (Panel("measurement", measurement), Panel("PSF", psf, "psf"), Panel("reconstruction", result)),
    )
    if isinstance(network, WienerBank):
        rows = _bank_rows(network, measurement, psf, result)
    elif isinstance(network, WienerNetwork | WienerUNet):
        rows = [_single_row(network, measurement, psf, result)]
    else:
        rows = _scale_rows(network, measurement, psf, result)
    return Interpretation(type(network).__name__, (first, *rows), pose)


def _scale_rows(network: Mwdn | MwdnCpsf, measurement: Measurement, psf: Psf, result: Scene) -> list[Row]:
    """A row for each filter of MWDN and MWDN-CPSF, finest first.

    The contribution of a filter is the change of the picture if its features are replaced by their means over the
    frame: these have no spatial information, but the level that the decoder expects.
    """
    size = size_of(measurement)
    given = normalise_psf(psf, size, network.channels, stored=network.stored_psf)
    psfs = network.pyramid(given)
    *features, bottom = network.encoder(measurement)
    prepared = network.prepare(psf, size)
    filtered = [w.deconvolve(x, t) for w, x, t in zip(network.filters, features, prepared, strict=True)]
    means = [x.mean((-2, -1), keepdim=True).expand_as(x) for x in filtered]

    def decoded(*kept: int) -> Scene:
        """The picture if only the filters of these scales have spatial information."""
        return network.decoder([*(filtered[i] if i in kept else means[i] for i in range(len(filtered))), bottom])

    every = range(len(filtered))
    rows = []
    for i, wiener in enumerate(network.filters):
        change = result - decoded(*(j for j in every if j != i))
        channel = int(filtered[i].std((0, 2, 3)).argmax())
        used = [Panel("PSF at this scale", F.avg_pool2d(given, 2**i), "psf"), *_used_psfs(network, psfs[i])]
        panels = (
            *used,
            Panel(f"features {channel}", features[i][:, channel : channel + 1], "features"),
            Panel("deconvolved", filtered[i][:, channel : channel + 1], "features"),
            Panel("adds to the picture", change, "change"),
            Panel("from here down", decoded(*every[i:])),
        )
        numbers = {**_filter_numbers(wiener, psfs[i]), "share_of_picture": _share(change, result)}
        rows.append(Row(f"scale 1/{2**i}" if i else "scale 1", panels, numbers))
    return rows


def _used_psfs(network: Mwdn | MwdnCpsf, psf: Tensor) -> list[Panel]:
    """The PSF that a filter used: one for all channels, or the mean and the strongest of one for each channel."""
    if isinstance(network, Mwdn):
        return [Panel("PSF used, colours summed", psf, "psf")]
    strongest = int(psf.std((0, 2, 3)).argmax())
    mean = Panel(f"mean of {psf.shape[1]} corrected", psf.mean(1, keepdim=True), "psf")
    return [mean, Panel(f"corrected PSF {strongest}", psf[:, strongest : strongest + 1], "psf")]


def _single_row(network: WienerNetwork | WienerUNet, measurement: Measurement, psf: Psf, result: Scene) -> Row:
    wiener = network if isinstance(network, WienerNetwork) else network.wiener
    size = size_of(measurement)
    used = normalise_psf(psf, size, stored=wiener.stored_psf)
    estimate = wiener.reconstruct(measurement, wiener.prepare(psf, size))
    panels = [Panel("PSF used", used, "psf"), Panel("Wiener estimate", estimate)]
    numbers = _filter_numbers(wiener.filter, used)
    if isinstance(network, WienerUNet):
        panels.append(Panel("U-Net's change", result - estimate, "change"))
        numbers["share_of_picture"] = _share(estimate, result)
    return Row("Wiener filter", tuple(panels), numbers)


def _bank_rows(network: WienerBank, measurement: Measurement, psf: Psf, result: Scene) -> list[Row]:
    """Rows of the iterations if there are any, of the bank, smoothest first, and of the U-Net."""
    measurement = measurement.expand(-1, network.channels, -1, -1)  # a grey one: equal colours
    pictures = network.estimates(measurement, psf)[:, : network.pictures]
    *estimates, _ = torch.split(pictures, network.channels, dim=1)  # the last picture is the measurement
    lambdas = network.regularisations
    filtered = zip(lambdas, estimates[-len(lambdas) :], strict=True)
    bank = Row(
        "Wiener bank",
        tuple(Panel(f"lambda {value:g}", picture) for value, picture in filtered),
        {f"lambda_{number}": value for number, value in enumerate(lambdas, 1)},
    )
    smoothest = estimates[0]
    change = result - smoothest
    unet = Row(
        "U-Net",
        (Panel("U-Net's change", change, "change"), Panel("reconstruction", result)),
        {"share_of_picture": _share(change, result)},
    )
    return [_iterations_row(network, measurement, psf, smoothest), bank, unet] if network.levels else [bank, unet]


def _iterations_row(network: WienerBank, measurement: Measurement, psf: Psf, scene: Scene) -> Row:
    """The scene after the iterations and plug and play; with plug and play, also the one before it and the change."""
    panels = [Panel("iterations", scene)]
    if network.rounds:
        prepared = network.prepare(psf, size_of(measurement))
        start = network.iterate(measurement.float(), prepared).scene
        after = Panel(f"after {network.rounds} rounds", scene)
        panels = [Panel("iterations", start), after, Panel("the rounds' change", scene - start, "change")]
    return Row("iterations", tuple(panels), {"residual": _share(measurement - convolve(scene, psf), measurement)})


def _filter_numbers(wiener: WienerFilter, psf: Tensor) -> dict[str, float | None]:
    """w, lambda, and what they mean for this PSF (1, 1 or C, H, W).

    ``inverted``: part of all frequencies at which |w H|^2 exceeds lambda: more than half of the blur is inverted there.
    ``largest_gain``: of the filter, over all frequencies; 1 / (2 sqrt(lambda)) at most.
    """
    weight = None if wiener.weight is None else wiener.weight.item()
    inverted, gain = [], []
    for channel in torch.split(psf, 1, dim=1):
        power = transfer_function(channel * (1 if weight is None else weight), wiener.grid(psf)).abs().square()
        inverted.append((power > wiener.regularisation).float().mean().item())
        gain.append((power.sqrt() / (power + wiener.regularisation)).max().item())
    return {
        "w": weight,
        "lambda": wiener.regularisation.item(),
        "inverted": sum(inverted) / len(inverted),
        "largest_gain": max(gain),
    }


def _share(change: Tensor, result: Tensor) -> float | None:
    """Standard deviation of a change over that of the picture; ``None`` for an even picture, up to rounding."""
    spread = result.std()
    return (change.std() / spread).item() if spread > 1e-6 * result.abs().max() else None

"""The contract of all networks. It holds for a new one as soon as `NETWORKS` lists it."""

import contextlib
import inspect
from dataclasses import replace
from functools import lru_cache

import pytest
import torch
from safetensors.torch import load_file, save_file
from torch.nn import functional as F

from made import trained
from mwdn import fourier
from mwdn.errors import MwdnError, ParameterError, ShapeError, UnknownNameError
from mwdn.inference.engine import Engine
from mwdn.networks import NETWORKS, build

FEW = ("wiener", "le-admm")
"""Networks of so few numbers that they learn the camera's constants at most."""

SLOW = ("mmcn", "updn", "le-admm-u", "ifin", "svdeconv")
"""Networks that take 1 to 3 seconds to export."""

ANY_SIDE = (*FEW, "wiener-bank", "le-admm-u", "mmcn", "flatnet", "svdeconv")
"""Networks that pad small pictures, or never halve them."""

LEARN_SLOWLY = (*SLOW, "wiener-bank", "flatnet", "wiener-unet", "unet", "mwdn")
"""Networks that take 2 to 10 seconds to learn four pairs; `mwdn-cpsf` has the blocks of `unet` and `mwdn`."""

EXPORTED_ELSEWHERE = ("wiener", "unet", "mwdn-cpsf", "wiener-unet", "mwdn")
"""Networks that `test_exporter` exports and compares, too, and those of the same blocks."""

NARROW = {"le-admm-u": 8, "mmcn": 12, "updn": 4}
"""Widths of networks that compute small pictures on grids of twice or four times their sides."""


def small(name, **options):
    """A narrow network of few steps; options that it does not have are left out."""
    parameters = inspect.signature(NETWORKS[name]).parameters
    width = 8 if name == "mwdn-cpsf" else 4  # with 4, no feature of the PSF is left at the coarsest scales
    options = {"width": width, "size": (24, 24), "depth": 2, "iterations": 2, **options}
    network = build(name, **{key: value for key, value in options.items() if key in parameters})
    if name == "wiener-bank":  # 66 iterations, of which those of one level are alike
        network.levels = tuple(replace(level, iterations=2) for level in network.levels)
    return network


def pair(generator, size=(24, 24), *, batch=2, channels=3, psf_batch=1):
    """Blurred blobs, their scenes, and a PSF of a few points."""
    seeds = torch.rand(batch, channels, 6, 6, generator=generator)
    scene = F.interpolate(seeds, size=size, mode="bicubic").clamp(0, 1)
    h = torch.rand(psf_batch, channels, *size, generator=generator) ** 8
    h = h / h.sum((-2, -1), keepdim=True)
    return fourier.convolve(scene, h), h, scene


@pytest.fixture(params=NETWORKS)
def name(request):
    return request.param


@pytest.fixture(params=["network", "fast"])
def ready(request):
    """A network in evaluation mode, or its engine: both are functions of measurement and PSF.

    The engine of precision "exact" is compared with the network in `test_engine`.
    """
    if request.param == "network":
        return lambda network: network.eval()

    def fast(network):
        engine = lru_cache(1)(lambda h: Engine(network, h, precision=request.param))
        return lambda b, h: engine(h)(b)

    return fast


@pytest.mark.parametrize("size", [(16, 16), (33, 17)])
def test_scene_has_the_size_of_the_measurement(name, size, generator):
    """In training, in evaluation and in the engine, which the tests of `ready` call with other sizes."""
    b, h, _ = pair(generator, size)
    network = small(name)
    precisions = ("exact",) if size == (16, 16) else ("exact", "fast")
    engines = [Engine(network, h, precision=precision) for precision in precisions]
    scenes = [network.train()(b, h), network.eval()(b, h), *(engine(b) for engine in engines)]
    for scene in scenes:
        assert scene.shape == b.shape
        assert scene.dtype == torch.float32
        assert scene.isfinite().all()


def test_every_parameter_gets_a_gradient(name, generator):
    """In evaluation mode, since BatchNorm of a batch takes away what a bias before it adds."""
    b, h, scene = pair(generator, (33, 47))
    network = trained(small(name), generator)
    F.mse_loss(network(b, h), scene).backward()
    for key, parameter in network.named_parameters():
        assert parameter.grad is not None, key
        assert parameter.grad.isfinite().all(), key
        assert parameter.grad.abs().max() > 0, key


def test_training_mode_gives_every_parameter_a_finite_gradient(name, generator):
    b, h, scene = pair(generator)
    network = small(name).train()
    F.mse_loss(network(b, h), scene).backward()
    for key, parameter in network.named_parameters():
        assert parameter.grad is not None, key
        assert parameter.grad.isfinite().all(), key


def test_measurement_and_psf_get_gradients(name, generator):
    b, h, scene = pair(generator)
    b, h = b.requires_grad_(), h.requires_grad_()
    F.mse_loss(trained(small(name), generator)(b, h), scene).backward()
    assert b.grad.isfinite().all()
    assert b.grad.abs().max() > 0
    if name == "unet":
        assert h.grad is None
    else:
        assert h.grad.isfinite().all()
        assert h.grad.abs().max() > 0


def test_samples_of_a_batch_do_not_meet_in_evaluation(name, ready, generator, request):
    b, h, _ = pair(generator, batch=2)
    network = ready(trained(small(name), generator))
    together = network(b, h)
    # Iterations amplify the last bits of float32, and half precision rounds these differently.
    tolerance = (1e-2, 1e-2) if request.node.callspec.params["ready"] == "fast" else (1e-4, 1e-5)
    for i in range(2):
        alone = network(b[i : i + 1], h)
        torch.testing.assert_close(together[i : i + 1], alone, rtol=tolerance[0], atol=tolerance[1])


def test_each_sample_may_have_its_own_psf(name, generator):
    b, h, _ = pair(generator, (21, 24), batch=3, psf_batch=3)
    # Different peaks too: whatever scales a PSF must do so for each of them.
    h = h * torch.tensor([1.0, 5.0, 0.2])[:, None, None, None]
    network = trained(small(name), generator)
    together = network(b, h)
    for i in range(3):
        alone = network(b[i : i + 1], h[i : i + 1])
        torch.testing.assert_close(together[i : i + 1], alone, rtol=1e-4, atol=1e-5)


def test_psf_matters_but_not_its_scale(name, ready, generator):
    """The brightness of a calibration shot is no property of a camera.

    Scaling by a power of 2 is exact, so the scenes are equal bit for bit. Neither PSF has unit sum: such a one is taken
    as it is, and differs in its last digits, which bfloat16 can turn into 0.5 %.
    """
    b, h, _ = pair(generator)
    h = 4 * h
    network = ready(trained(small(name), generator))
    scene = network(b, h)
    assert torch.equal(network(b, 32 * h), scene)
    moved = network(b, h.roll(3, -1))
    assert torch.equal(moved, scene) == (name == "unet")


def test_both_steps_together_are_a_call(name, generator):
    """Also for a PSF that is as bright as its colours were exposed: docs/methods.md calls the steps one by one."""
    b, h, _ = pair(generator)
    h = h * torch.tensor([1.0, 5.0, 0.2])[:, None, None]
    network = trained(small(name), generator)
    torch.testing.assert_close(network.reconstruct(b, network.prepare(h, b.shape[-2:])), network(b, h))


def test_grey_psf_is_that_of_each_colour(name, ready, generator, request):
    """A monochrome calibration shot serves a colour camera, with weights trained on coloured ones too."""
    b, h, _ = pair(generator)
    network = ready(trained(small(name), generator))
    grey = h[:, :1]
    # A last digit of float32 may be a step of bfloat16: 0.4 % of one of many features.
    atol = 1e-3 if request.node.callspec.params["ready"] == "fast" else 1e-5
    torch.testing.assert_close(network(b, grey), network(b, grey.expand_as(h)), rtol=1e-4, atol=atol)


def test_grey(name, ready, generator):
    b, h, _ = pair(generator, channels=1)
    assert ready(small(name, channels=1))(b, h).shape == b.shape


@pytest.mark.parametrize("name", [name for name in NETWORKS if name not in FEW])
def test_measurement_of_other_channels_is_named(name, generator):
    """The message names the measurement's channels and the network's, not those of a weight."""
    b, h, _ = pair(generator, channels=2)
    with pytest.raises(ShapeError, match=r"2, \d+, \d+\) must have 3 channels"):
        small(name).eval()(b, h[:, :1])


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.acceptance] * (name in LEARN_SLOWLY)) for name in NETWORKS]
)
def test_overfits_four_pairs(name, generator):
    """Networks learn the pictures, not just their mean; a few numbers learn the camera's constants at most."""
    b, h, scene = pair(generator, (16, 16), batch=4)
    network = small(name, width=NARROW.get(name, 16), iterations=5).train()
    optimiser = torch.optim.Adam(network.parameters(), lr=3e-3 if name not in FEW else 1e-1)
    losses = []
    for _ in range(300):
        loss = F.mse_loss(network(b, h), scene)
        losses.append(loss.item())
        if losses[-1] < (0.99 * losses[0] if name in FEW else min(0.15 * losses[0], 0.6 * scene.var().item())):
            return
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
    pytest.fail(f"loss from {losses[0]} to {losses[-1]} only, of pictures of variance {scene.var()}")


def test_weights_survive_a_file(name, generator, tmp_path):
    b, h, _ = pair(generator)
    network = trained(small(name), generator)
    save_file(network.state_dict(), tmp_path / "weights.safetensors")
    other = small(name).eval()
    with torch.no_grad():
        for parameter in other.parameters():
            parameter.add_(1)
    other.load_state_dict(load_file(tmp_path / "weights.safetensors"))
    assert torch.equal(other(b, h), network(b, h))


def test_same_seed_same_network(name, generator):
    b, h, _ = pair(generator)
    scenes = []
    for _ in range(2):
        torch.manual_seed(7)
        scenes.append(small(name).eval()(b, h))
    assert torch.equal(*scenes)


def test_inputs_are_left_as_they_were(name, generator):
    """The blocks compute in place, but never in the tensors of the caller."""
    b, h, _ = pair(generator)
    before = b.clone(), h.clone()
    network = small(name)
    network.train()(b, h)
    network.eval()(b, h)
    Engine(network, h, precision="fast")(b)
    assert torch.equal(b, before[0])
    assert torch.equal(h, before[1])


@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=[pytest.mark.acceptance] * (name in SLOW + EXPORTED_ELSEWHERE)) for name in NETWORKS],
)
@pytest.mark.usefixtures("unchecked")
def test_export_is_the_same_function(name, generator):
    b, h, _ = pair(generator, (16, 18), batch=1)
    # Two levels of the pyramid: the others are the same again.
    network = trained(small(name, width=2, finest=4, regularisations=(1e-3,)), generator)
    with torch.no_grad():
        exported = torch.export.export(network, (b, h)).module()
        torch.testing.assert_close(exported(b, h), network(b, h), rtol=1e-4, atol=1e-5)
        other, own, _ = pair(generator, (16, 18), batch=1)
        torch.testing.assert_close(exported(other, own), network(other, own), rtol=1e-4, atol=1e-5)


def test_half_precision_is_close(name, generator):
    """bfloat16 keeps 8 bits: 0.4 % an operation, some per cent after a U-Net."""
    b, h, _ = pair(generator, (32, 32))
    network = trained(small(name), generator)
    with torch.no_grad():
        expected = network(b, h)
        with torch.autocast("cpu", torch.bfloat16):
            half = network(b, h).float()
    assert half.isfinite().all()
    assert (half - expected).norm() < 0.05 * expected.norm()


def test_training_step_in_half_precision_is_finite(name, generator):
    b, h, scene = pair(generator)
    network = small(name).train()
    with torch.autocast("cpu", torch.bfloat16):
        loss = F.mse_loss(network(b, h).float(), scene)
    loss.backward()
    assert all(parameter.grad.isfinite().all() for parameter in network.parameters())


def test_wiener_constants_stay_positive_whatever_the_step(name):
    network = small(name)
    filters = [module for module in network.modules() if hasattr(module, "log_regularisation")]
    for module in filters:
        with torch.no_grad():
            module.log_regularisation.sub_(5)
    h = torch.zeros(1, 3, 16, 16)
    h[..., 8, 8] = 1
    assert network.eval()(torch.rand(2, 3, 16, 16), h).isfinite().all()


def test_unknown_network_gets_the_nearest_name():
    with pytest.raises(UnknownNameError, match=r"No network named 'mwdm'\. Did you mean 'mwdn'\? Known: .*wiener-unet"):
        build("mwdm")
    with pytest.raises(MwdnError, match="Known: " + ", ".join(sorted(NETWORKS))):
        build("?")


@pytest.mark.parametrize("name", ["mwdn", "wiener-bank", "ifin"])
def test_width_must_be_positive(name):
    with pytest.raises(ParameterError, match=r"`width` \(0\) must be at least 1"):
        build(name, width=0)


@pytest.mark.parametrize("name", NETWORKS)
@pytest.mark.usefixtures("unchecked")
def test_picture_without_batch_is_refused(name):
    network, picture = small(name).eval(), torch.rand(3, 32, 32)
    with pytest.raises(ShapeError, match=r"`measurement` \(3, 32, 32\) must be \(B, C, H, W\)"):
        network(picture, picture[None])
    if name != "unet":  # it has no PSF
        with pytest.raises(ShapeError, match=r"`psf` \(3, 32, 32\) must be \(B, C, H, W\)"):
            network(picture[None], picture)


def test_precision_of_the_measurement_does_not_matter(name, generator):
    """numpy's floats are float64. Each result has the precision of the weights."""
    b, h, _ = pair(generator, (16, 18))
    network = small(name).eval()
    expected = network(b.half().float(), h)
    for dtype in (torch.float64, torch.float16):
        result = network(b.half().to(dtype), h.to(dtype))
        assert result.dtype == torch.float32
        assert (result - expected).norm() < 1e-2 * expected.norm()


@pytest.mark.parametrize("dtype", [torch.float16, torch.float64])
def test_weights_of_another_precision_work_or_are_refused(name, dtype, generator):
    """Most mix them with float32, which Fourier transforms give. An engine converts the weights back."""
    b, h, _ = pair(generator, (16, 18))
    network = small(name).eval()
    expected = network(b, h)
    network = network.to(dtype)
    with contextlib.suppress(ParameterError):
        assert (network(b, h) - expected).norm() < 1e-2 * expected.norm()
    assert (Engine(network, h, precision="exact")(b) - expected).norm() < 1e-2 * expected.norm()


def test_refused_precision_names_the_way_out(generator):
    b, h, _ = pair(generator, (16, 18))
    with pytest.raises(ParameterError, match=r"WienerBank \(torch.float16\).*`network.float\(\)`"):
        small("wiener-bank").half()(b, h)


@pytest.mark.parametrize("name", NETWORKS)
@pytest.mark.usefixtures("unchecked")
def test_what_does_not_fit_is_refused(name):
    network, b = small(name).eval(), torch.rand(2, 3, 24, 24)
    for measurement, psf in ((b[:0], b[:1]), (b, b[:0]), (b[:, :1], b[:1]), (b, b[:1, :2]), (b[:1], b)):
        with pytest.raises(ShapeError):
            network(measurement, psf)


@pytest.mark.parametrize("side", [1, 15])
def test_small_picture_is_reconstructed_or_refused(name, ready, side, generator):
    """docs/methods.md promises sides from 16 pixels on: U-Nets halve four times."""
    b, h, _ = pair(generator, (16, side))
    network = ready(small(name))
    if name in ANY_SIDE:
        assert network(b, h).shape == b.shape
    else:
        with pytest.raises(ShapeError, match="at least 16 x 16 pixels"):
            network(b, h)


@pytest.mark.parametrize("option", ["pooling", "psf_pooling"])
@pytest.mark.usefixtures("unchecked")
def test_unknown_pooling_is_refused(option):
    with pytest.raises(ValueError, match=rf"No {option} named 'min'.* average, max") as caught:
        build("mwdn", width=2, **{option: "min"})
    assert isinstance(caught.value, MwdnError)

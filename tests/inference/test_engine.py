"""An engine computes the same function as its network."""

import copy
import pickle

import pytest
import torch
from torch import nn
from torch.nn import functional as F

from made import trained
from mwdn import Calibration, Camera, Reconstructor, read_frame
from mwdn.errors import ParameterError
from mwdn.inference.engine import Engine
from mwdn.inference.fusion import MAX_LAYOUTS, FusedConvolution, fuse
from mwdn.networks import NETWORKS, build
from mwdn.networks.network import as_network

SIZE = 33, 47


def small(name):
    return build(name, **({} if name in ("wiener", "le-admm") else {"width": 8}))


def psf_and_batch(generator, batch=2):
    psf = torch.rand(1, 3, *SIZE, generator=generator) ** 8
    return psf / psf.sum(), torch.rand(batch, 3, *SIZE, generator=generator)


def psnr(result, expected):
    return -10 * ((result - expected).square().mean() / expected.abs().max().square()).log10().item()


@pytest.mark.parametrize("name", NETWORKS)
def test_exact_is_the_network_and_fast_is_close(name, generator):
    psf, batch = psf_and_batch(generator)
    network = trained(small(name), generator)
    with torch.no_grad():
        expected = network(batch, psf)
    torch.testing.assert_close(Engine(network, psf, precision="exact")(batch), expected, rtol=1e-4, atol=1e-5)
    assert psnr(Engine(network, psf)(batch), expected) > 35


@pytest.mark.parametrize("name", ["mwdn", "wiener", "unet"])
@pytest.mark.parametrize("dtype", [torch.float16, torch.float64])
def test_precision_of_the_measurement_does_not_matter(name, dtype, generator):
    """The filters rounded their results to that of a measurement in half precision."""
    psf, batch = psf_and_batch(generator)
    engine, batch = Engine(trained(small(name), generator), psf, precision="exact"), batch.half()
    assert torch.equal(engine(batch.to(dtype)), engine(batch.float()))


def test_complex_weights_of_another_package_stay_complex(generator):
    """They are no float32, to which a network in half precision is converted."""
    module = nn.Module()
    module.weight = nn.Parameter(torch.tensor(2 + 3j))
    assert Engine(as_network(module), psf_and_batch(generator)[0]).network.module.weight == 2 + 3j


def test_plug_and_play_too(generator):
    """The denoiser between the iterations computes in half precision; its level and the picture do not."""
    psf, batch = psf_and_batch(generator)
    network = build("wiener-bank", width=8, rounds=3).eval()
    with torch.no_grad():
        expected = network(batch, psf)
    torch.testing.assert_close(Engine(network, psf, precision="exact")(batch), expected, rtol=1e-4, atol=1e-5)
    assert psnr(Engine(network, psf)(batch), expected) > 50


@pytest.mark.parametrize("packed", [True, False])
@pytest.mark.parametrize("dtype", [None, torch.bfloat16])
def test_fused_convolution(packed, dtype, generator):
    """With packed weights, and as where torch or the processor has no fused operation."""
    layers = nn.Sequential(
        nn.Conv2d(20, 17, 3, padding=1, bias=False), nn.BatchNorm2d(17), nn.ReLU(), nn.Conv2d(17, 18, 1)
    )
    layers[1].running_mean.uniform_(-1, 1, generator=generator)
    layers[1].running_var.uniform_(0.5, 2, generator=generator)
    image = torch.randn(2, 20, 9, 11, generator=generator)
    with torch.no_grad():
        expected = layers.eval()(image)
        result = fuse(copy.deepcopy(layers), dtype, pack=packed)(image)
    assert result.dtype == (dtype or torch.float32)
    tolerance = 1e-5 if dtype is None else 0.03
    torch.testing.assert_close(result.float(), expected, rtol=tolerance, atol=tolerance)


def test_packed_weights_follow_the_shape(generator):
    """The layout for 20 x 20 pixels and one thread is another than the default (on AVX2)."""
    layer = nn.Sequential(nn.Conv2d(64, 128, 3, padding=1), nn.ReLU())
    fused = fuse(copy.deepcopy(layer), None)
    shapes = [(1, 64, 20, 20), (2, 64, 5, 7), (1, 64, 20, 20), (1, 64, 8, 8), (1, 64, 9, 8), (1, 64, 10, 8)]
    with torch.no_grad():
        for shape in shapes:
            image = torch.randn(*shape, generator=generator)
            for each in (fused, copy.deepcopy(fused), pickle.loads(pickle.dumps(fused))):
                torch.testing.assert_close(each(image), layer(image), rtol=1e-4, atol=1e-4)
    assert 0 < len(fused[0].packed) <= MAX_LAYOUTS


@pytest.mark.parametrize("channels", [(3, 20), (20, 3)])
def test_a_convolution_that_sees_the_picture_stays_float32(channels, generator):
    layer = nn.Conv2d(*channels, 3, padding=1)
    image = torch.randn(1, channels[0], 9, 11, generator=generator)
    with torch.no_grad():
        torch.testing.assert_close(fuse(copy.deepcopy(layer), torch.bfloat16)(image), layer(image))


def test_other_convolutions_are_left_alone(generator):
    strided = nn.Conv2d(4, 4, 3, stride=2, padding=1)
    grouped = nn.Conv2d(4, 4, 3, groups=2, padding="same")
    layers = nn.Sequential(strided, nn.BatchNorm2d(4), nn.ReLU(), grouped)
    fused = fuse(layers, None)
    assert [getattr(module, "layer", module) for module in fused] == list(layers)
    assert not any(isinstance(module, FusedConvolution) for module in fused.modules())


def test_psf_branch_is_computed_once(generator):
    psf, batch = psf_and_batch(generator)
    network = trained(small("mwdn-cpsf"), generator)
    bound = Engine(network, psf)
    seen = []
    bound.exact.psf_encoder.register_forward_hook(lambda *_: seen.append(1))
    first = bound(batch)
    assert torch.equal(bound(batch), first)
    assert len(seen) == 1


def test_callers_network_is_left_alone_and_later_changes_do_not_matter(generator):
    psf, batch = psf_and_batch(generator)
    network = trained(small("mwdn"), generator).train()
    before = copy.deepcopy(network.state_dict())
    bound = Engine(network, psf)
    result = bound(batch)
    assert network.training
    assert all(parameter.requires_grad for parameter in network.parameters())
    assert all(torch.equal(value, before[key]) for key, value in network.state_dict().items())
    with torch.no_grad():
        for parameter in network.parameters():
            parameter.zero_()
    assert torch.equal(bound(batch), result)


def test_batches_of_any_size_and_order(generator):
    psf, batch = psf_and_batch(generator, batch=3)
    bound = Engine(trained(small("mwdn"), generator), psf, precision="exact")
    together = bound(batch)
    for part in (slice(1, 3), slice(0, 1)):
        torch.testing.assert_close(bound(batch[part]), together[part], rtol=1e-4, atol=1e-5)


@pytest.mark.usefixtures("unchecked")
def test_unknown_precision(generator):
    with pytest.raises(ParameterError, match="`precision` must be fast or exact, not 'half'"):
        Engine(build("unet", width=2), torch.rand(1, 3, 32, 32), precision="half")


def learned(name, psf):
    """A hundred steps on blurred blobs: weights, and what BatchNorm makes of them, are no longer random.

    At half the PSF's size: it is the learning that takes the time of a test. In float64, or every processor, which
    rounds in its own way, would learn another network.
    """
    psf = F.avg_pool2d(psf, 2).double()
    psf = psf / psf.sum((-2, -1), keepdim=True)
    generator = torch.manual_seed(2)
    network = build(name, width=16).double().train()
    optimiser = torch.optim.AdamW(network.parameters(), lr=5e-3)
    for _ in range(100):
        seeds = torch.rand(2, 3, 6, 6, dtype=torch.float64, generator=generator)
        scene = F.pad(F.interpolate(seeds, (20, 20), mode="bicubic").clamp(0, 1), (10,) * 4)
        measurement = Camera(psf).forward(scene)
        measurement = measurement / measurement.amax((1, 2, 3), keepdim=True)
        measurement = measurement + 0.005 * torch.randn(scene.shape, dtype=torch.float64, generator=generator)
        loss = F.mse_loss(network(measurement, psf), scene)
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
    return network.float()


# 55 to 63 dB, and 74 of the one that is trained to the end. Networks that have learned as little as MWDN-CPSF in a
# hundred steps have between 46 and 61.
@pytest.mark.parametrize(
    "name",
    [
        "universal-small",
        *(pytest.param(name, marks=pytest.mark.acceptance) for name in ("unet", "mwdn", "mwdn-cpsf")),
    ],
)
def test_fast_against_exact_on_real_captures(name, data):
    """PSNR, the brightest pixel of the exact picture taken as 1; captures and PSF binned by 4."""
    camera = data / "mwdn-camera"
    calibration = Calibration.from_file(camera / "psf_320.png")
    psf = F.avg_pool2d(calibration.psf, 4)
    psf = psf / psf.sum((-2, -1), keepdim=True)
    network = name if name == "universal-small" else learned(name, psf)
    exact = Reconstructor(network, Calibration(psf), device="cpu", precision="exact")
    fast = Reconstructor(network, Calibration(psf), device="cpu")
    files = sorted((camera / "real-objects").glob("object_*"))
    assert files
    for path in files:
        measurement = F.avg_pool2d(calibration.correct(read_frame(path)), 4)
        measurement = measurement / measurement.amax()
        assert psnr(fast(measurement), exact(measurement)) >= 50, path

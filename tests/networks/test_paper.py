"""The paper's counts, the wiring of its figures 1 and 2, and the form of its authors' code."""

import math

import numpy as np
import pytest
import torch
from torch import nn
from torch.nn import functional as F

import oracles
from made import trained
from mwdn.networks import build
from mwdn.optics import unit_sum

COUNTS = {
    "wiener": 2,
    "unet": 17_267_523,
    "wiener-unet": 17_267_525,
    "mwdn": 17_267_531,
    "mwdn-cpsf": 21_956_743,
}


def count(name, **options):
    with torch.device("meta"):
        return sum(parameter.numel() for parameter in build(name, **options).parameters())


@pytest.mark.parametrize("name", COUNTS)
def test_learnable_numbers_are_the_papers(name):
    assert count(name) == COUNTS[name]


def test_learnable_numbers_of_the_authors_cpsf():
    assert count("mwdn-cpsf", authors_scalars=True) == 21_956_745


@pytest.mark.parametrize("name", ["mwdn", "unet", "mwdn-cpsf"])
def test_options_without_weights_of_their_own_keep_the_count(name):
    options = {"pooling": "average"} | ({"orthonormal": True} if name == "mwdn-cpsf" else {})
    if name == "mwdn":
        options |= {"psf_pooling": "average", "boundary": "circular", "weight": 0.1, "regularisation": 0.5}
    assert count(name, **options) == COUNTS[name]


def test_unet_is_the_papers():
    """Widths 64 to 512, 3x3 convolutions with bias, half of the input inside a decoder block, a 1x1 head."""
    with torch.device("meta"):
        network = build("unet")
    shapes = [(m.in_channels, m.out_channels, m.kernel_size[0]) for m in network.modules() if isinstance(m, nn.Conv2d)]
    encoder = [(3, 64), (64, 64), (64, 128), (128, 128), (128, 256), (256, 256), (256, 512), (512, 512)]
    encoder += [(512, 512), (512, 512)]
    decoder = [(1024, 512), (512, 256), (512, 256), (256, 128), (256, 128), (128, 64), (128, 64), (64, 64)]
    assert shapes == [(*pair, 3) for pair in encoder + decoder] + [(64, 3, 1)]
    assert all(m.bias is not None for m in network.modules() if isinstance(m, nn.Conv2d))
    assert sum(isinstance(m, nn.BatchNorm2d) for m in network.modules()) == 18


def test_filters_start_at_the_authors_values():
    for name, has_weight in (("wiener", True), ("mwdn", True), ("mwdn-cpsf", False)):
        named = dict(build(name, **({} if name == "wiener" else {"width": 2})).named_parameters())
        weights = [value for key, value in named.items() if key.endswith("log_weight")]
        constants = [value for key, value in named.items() if key.endswith("log_regularisation")]
        filters = 1 if name == "wiener" else 4
        assert len(constants) == filters
        assert len(weights) == (filters if has_weight else 0)
        assert all(math.isclose(value.exp().item(), 1e-3, rel_tol=1e-5) for value in weights)
        assert all(math.isclose(value.exp().item(), 1e-2, rel_tol=1e-5) for value in constants)


# --- Figures 1 and 2, step by step ------------------------------------------------------------


def halved(picture, pooling):
    """2x2 blocks of the last two axes, an odd last row or column dropped, in numpy."""
    height, width = (n // 2 * 2 for n in picture.shape[-2:])
    blocks = picture[..., :height, :width].reshape(*picture.shape[:-2], height // 2, 2, width // 2, 2)
    return blocks.max((-3, -1)) if pooling == "max" else blocks.mean((-3, -1))


def encode(encoder, picture, pooling):
    """Features of each scale, through the encoder's own convolutions and numpy's pooling."""
    features = [encoder.scales[0](picture)]
    for block in list(encoder.scales)[1:]:
        features.append(block(torch.from_numpy(halved(features[-1].numpy(), pooling))))
    return features


def decode(decoder, skips, bottleneck):
    """Up-sample to the skip's size with aligned corners, skip first, coarse to fine."""
    x = bottleneck
    for block, skip in zip(decoder.scales, skips[::-1], strict=True):
        x = block(torch.cat([skip, stretched(x, skip.shape[-2:])], 1))
    return decoder.head(x)


def stretched(picture, size):
    """Bilinear, corners aligned, as two matrix products: row i of n is row i (m - 1) / (n - 1) of m."""

    def weights(n, m):
        source = torch.linspace(0, m - 1, n, dtype=torch.float64) if n > 1 else torch.zeros(1, dtype=torch.float64)
        return (1 - (source[:, None] - torch.arange(m)).abs()).clamp(min=0).float()

    return weights(size[0], picture.shape[-2]) @ picture @ weights(size[1], picture.shape[-1]).T


def deconvolved(features, psf, constant, boundary):
    """Each channel of each sample with its PSF: numpy's Wiener filter."""
    result = np.zeros(features.shape)
    for b in range(features.shape[0]):
        for c in range(features.shape[1]):
            own = psf[b % psf.shape[0], c % psf.shape[1]]
            result[b, c] = oracles.wiener(features[b, c].double().numpy(), own, constant, boundary)
    return torch.from_numpy(result).float()


FORMS = [
    {"pooling": "max", "psf_pooling": "max", "boundary": "taper"},
    {"pooling": "average", "psf_pooling": "average", "boundary": "circular"},
    {"pooling": "max", "psf_pooling": "average", "boundary": "replicate"},
]


@torch.no_grad()
@pytest.mark.parametrize("size", [(32, 48), (33, 47)])
@pytest.mark.parametrize("form", FORMS, ids=["paper", "authors", "mixed"])
def test_mwdn_is_figure_1(form, size, generator):
    network = trained(build("mwdn", width=4, **form), generator, spread=1.0)
    b, h = torch.rand(2, 3, *size, generator=generator), unit_sum(torch.rand(1, 3, *size, generator=generator) ** 4)
    *skips, bottleneck = encode(network.encoder, b, form["pooling"])
    psf = h.double().numpy()
    # The colours of a PSF whose peak is 1, summed; then one scale after the other.
    psf = psf.sum(1, keepdims=True) / psf.max()
    for scale, skip in enumerate(skips):
        w, constant = (
            getattr(network.filters[scale], which).double().exp().item()
            for which in ("log_weight", "log_regularisation")
        )
        skips[scale] = deconvolved(skip, w * psf, constant, form["boundary"])
        psf = halved(psf, form["psf_pooling"])
    expected = decode(network.decoder, skips, bottleneck)
    torch.testing.assert_close(network(b, h), expected, rtol=1e-3, atol=1e-4)


@torch.no_grad()
@pytest.mark.parametrize("pooling", ["max", "average"])
@pytest.mark.parametrize("authors", [False, True])
def test_mwdn_cpsf_is_figure_2(authors, pooling, generator):
    boundary = "circular" if authors else "taper"
    options = {"width": 4, "pooling": pooling, "boundary": boundary, "authors_scalars": authors}
    network = trained(build("mwdn-cpsf", **options), generator, spread=1.0)
    b, h = torch.rand(2, 3, 32, 35, generator=generator), unit_sum(torch.rand(1, 3, 32, 35, generator=generator) ** 4)
    *skips, bottleneck = encode(network.encoder, b, pooling)
    start = h / h.max() * (network.weight if authors else 1)
    psfs = encode(network.psf_encoder, start, pooling)
    assert len(psfs) == 4
    for scale, (skip, psf) in enumerate(zip(skips, psfs, strict=True)):
        constant = network.filters[scale].log_regularisation.double().exp().item()
        skips[scale] = deconvolved(skip, psf.double().numpy(), constant, boundary)
    expected = decode(network.decoder, skips, bottleneck)
    torch.testing.assert_close(network(b, h), expected, rtol=1e-3, atol=1e-4)


@torch.no_grad()
def test_unet_has_no_filter_and_wiener_unet_has_one_before(generator):
    network = trained(build("wiener-unet", width=4), generator, spread=1.0)
    b, h = torch.rand(2, 3, 33, 32, generator=generator), unit_sum(torch.rand(1, 3, 33, 32, generator=generator) ** 4)
    named = dict(network.wiener.named_parameters())
    w, constant = (
        next(value for key, value in named.items() if key.endswith(which)).double().exp().item()
        for which in ("log_weight", "log_regularisation")
    )
    psf = (w * h / h.max()).double().numpy()
    first = deconvolved(b, psf, constant, "taper")
    torch.testing.assert_close(network.wiener(b, h), first, rtol=1e-4, atol=1e-4 * first.abs().max().item())
    *skips, bottleneck = encode(network.unet.encoder, first, "max")
    torch.testing.assert_close(network(b, h), decode(network.unet.decoder, skips, bottleneck), rtol=1e-3, atol=1e-3)
    torch.testing.assert_close(network.unet(first, h), network.unet(first, h.flip(-1)), rtol=0, atol=0)


@torch.no_grad()
def test_authors_form_is_their_unshifted_wiener(generator):
    """Their code leaves the PSF's centre where it is, and moves the result by half of the picture instead.

    On even sizes, which theirs was made for, that is eq. (2) on a circle.
    """
    network = trained(build("mwdn", width=2, **FORMS[1]), generator, spread=1.0)
    features = torch.rand(1, 2, 16, 24, generator=generator)
    psf = torch.rand(1, 1, 16, 24, generator=generator)
    wiener = network.filters[0]
    w, constant = wiener.log_weight.exp().item(), wiener.log_regularisation.exp().item()
    H = np.fft.fft2(w * psf.double().numpy())
    V = H.conj() / (abs(H) ** 2 + constant) * np.fft.fft2(features.double().numpy())
    expected = torch.from_numpy(np.roll(np.fft.ifft2(V).real, (8, 12), (-2, -1))).float()
    result = wiener.deconvolve(features, wiener.prepare(psf))
    torch.testing.assert_close(result, expected, rtol=1e-4, atol=1e-5 * expected.abs().max().item())


def test_authors_start_values_of_cpsf():
    network = build("mwdn-cpsf", width=2, authors_scalars=True)
    assert math.isclose(network.weight.item(), 1e-3, rel_tol=1e-5)
    assert network.weight.requires_grad
    parameters = dict(network.named_parameters())
    b, h = torch.rand(2, 3, 16, 16), torch.rand(1, 3, 16, 16)
    F.mse_loss(network(b, h), torch.rand(2, 3, 16, 16)).backward()
    assert {key for key, value in parameters.items() if value.grad is None} == {"unused_regularisation"}
    assert network.weight.grad.abs().item() > 0


# --- Why MWDN-CPSF learns slowly as published, and our option ----------------------------------


@torch.no_grad()
def filtered(side, seed=0, **options):
    """Standard deviation of the finest features behind their filter over that before, of a new network in training."""
    torch.manual_seed(seed)
    network = build("mwdn-cpsf", width=4, **options).train()
    b, h = torch.rand(4, 3, side, side), torch.rand(1, 3, side, side) ** 8
    features = network.encoder(b)[0]
    result = network.filters[0].deconvolve(features, network.prepare(h, (side, side))[0])
    return (result.std() / features.std()).item()


def test_published_filters_of_cpsf_fade_with_the_size():
    """BatchNorm makes every pixel of a corrected PSF about 1, so |H| is about the root of their number."""
    small, large = filtered(48), filtered(128)
    assert large < 0.1
    assert math.isclose(small / large, 128 / 48, rel_tol=0.3)


def test_orthonormal_filters_keep_features_at_any_size():
    small, large = filtered(48, orthonormal=True), filtered(128, orthonormal=True)
    assert small > 1
    assert math.isclose(small, large, rel_tol=0.3)


@torch.no_grad()
def test_orthonormal_is_a_larger_lambda_and_gain(generator):
    """conj(H / r) B / (|H / r|^2 + lambda) = r conj(H) B / (|H|^2 + lambda r^2), with r^2 pixels at each scale."""
    ours, papers = (trained(build("mwdn-cpsf", width=2, orthonormal=own), generator) for own in (True, False))
    papers.load_state_dict(ours.state_dict())
    h = torch.rand(1, 3, 32, 48, generator=generator)
    for scale, wiener in enumerate(papers.filters):
        wiener.log_regularisation += math.log(32 * 48 / 4**scale)
    prepared = zip(ours.prepare(h, (32, 48)), papers.prepare(h, (32, 48)), strict=True)
    for scale, (transfer, expected) in enumerate(prepared):
        torch.testing.assert_close(transfer, math.sqrt(32 * 48) / 2**scale * expected, rtol=1e-4, atol=1e-5)

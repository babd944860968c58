"""FlatNet, SVDeconv and the network after IFIN: what they compute of physics, against numpy and scipy."""

import numpy as np
import pytest
import torch

import oracles
from mwdn.networks import build
from mwdn.networks.svdeconv import field_weights
from mwdn.optics import unit_sum

COUNTS = {"flatnet": 34_669_260, "svdeconv": 35_849_494, "ifin": 7_608_456}


@pytest.mark.parametrize("name", COUNTS)
def test_learnable_numbers_are_those_of_the_docstring(name):
    with torch.device("meta"):
        network = build(name)
    result = sum(parameter.numel() for parameter in network.parameters())
    assert result == COUNTS[name]
    assert f"{result:,}" in " ".join(type(network).__doc__.split())


def pair(generator, size=(15, 18)):
    return torch.rand(2, 3, *size, generator=generator), unit_sum(torch.rand(1, 3, *size, generator=generator) ** 6)


def wiener(b, psf, constant):
    """Each colour of each sample, the border repeated, a PSF of unit sum."""
    b, psf = b.double().numpy(), psf.double().numpy()
    result = [[oracles.wiener(x, h, constant, "replicate") for x, h in zip(one, psf, strict=True)] for one in b]
    return torch.from_numpy(np.stack(result)).float()


def close(result, expected, part=1e-4):
    torch.testing.assert_close(result, expected, rtol=0, atol=part * expected.abs().max().item())


# --- FlatNet ------------------------------------------------------------------------------------------


@torch.no_grad()
def test_flatnet_begins_as_wiener_and_learns_taps(generator):
    network = build("flatnet", width=2, size=(15, 18), regularisation=2e-3)
    b, h = pair(generator)
    start = network.inverse(b, network.prepare(h, b.shape[-2:]))
    close(start, wiener(b, h[0], 2e-3))
    # One tap, 2 rows above and 3 columns right of the centre: it adds the measurement, moved so.
    network.correction[0, 0, 15 // 2 - 2, 18 // 2 + 3] = 1
    added = (network.inverse(b, network.prepare(h, b.shape[-2:])) - start) * (15 * 18) ** 0.5
    torch.testing.assert_close(added[..., :-2, 3:], b[..., 2:, :-3], rtol=0, atol=1e-3)


@torch.no_grad()
def test_flatnet_filter_is_stretched_to_other_sizes(generator):
    """A filter that is even light adds the same brightness at any size."""
    network = build("flatnet", width=2, size=(16, 20), channels=1)
    network.correction.fill_(1)
    h = torch.zeros(1, 1, 32, 40)
    h[..., 16, 20] = 1
    flat = build("flatnet", width=2, size=None, channels=1)
    assert flat.correction is None
    learned, start = (each.inverse(h, each.prepare(h, (32, 40))) for each in (network, flat))
    taps = (learned - start)[0, 0, 8:24, 10:30]
    torch.testing.assert_close(taps.mean().item() * 4, (16 * 20) ** -0.5, rtol=0.02, atol=0)


# --- SVDeconv -----------------------------------------------------------------------------------------


def test_field_weights_add_up_and_favour_the_nearest():
    weights = field_weights(3, (31, 45), torch.device("cpu"))
    assert weights.shape == (9, 31, 45)
    torch.testing.assert_close(weights.sum(0), torch.ones(31, 45))
    # Tiles are numbered by rows; each leads in its tile, and all but alone at its middle.
    nearest = weights.argmax(0)
    assert nearest[2, 3] == 0
    assert nearest[2, 42] == 2
    assert nearest[28, 3] == 6
    assert nearest[15, 22] == 4
    assert weights[4, 15, 22] > 0.95
    rows, columns = (np.arange(n) + 0.5 for n in (31, 45))
    far = np.hypot(rows[:, None] / 31 - 1 / 6, columns / 45 - 5 / 6)
    near = np.hypot(rows[:, None] / 31 - 1 / 2, columns / 45 - 1 / 2)
    expected = torch.from_numpy((near + 1e-3) / (far + 1e-3)).float()
    torch.testing.assert_close(weights[2] / weights[4], expected, rtol=1e-4, atol=1e-6)


@torch.no_grad()
def test_svdeconv_blends_one_wiener_estimate_a_place(generator):
    network = build("svdeconv", width=2, field=2, size=(15, 18), regularisation=3e-3)
    b, h = pair(generator)
    for result in network.deconvolve(b, network.prepare(h, b.shape[-2:])):
        close(result, wiener(b, h[0], 3e-3))
    network.correction.copy_(0.05 * torch.rand(network.correction.shape, generator=generator))
    network.log_regularisation.add_(torch.randn(5, generator=generator))
    peak = h / h.max()
    total = peak.sum((-2, -1), keepdim=True)
    estimates = [
        wiener(b, ((peak + network.correction[:, k : k + 1]) / total)[0], network.log_regularisation[k].exp().item())
        for k in range(5)
    ]
    single, blend = network.deconvolve(b, network.prepare(h, b.shape[-2:]))
    close(single, estimates[0])
    weights = field_weights(2, (15, 18), torch.device("cpu"))
    close(blend, sum(weight * estimate for weight, estimate in zip(weights, estimates[1:], strict=True)))


# --- After IFIN ---------------------------------------------------------------------------------------


@torch.no_grad()
def test_ifin_kernels_begin_near_the_measured_psf(generator):
    network = build("ifin", width=4).eval()
    psf = torch.zeros(1, 3, 33, 47)
    psf[..., 16, 23] = 1
    for scale, kernels in enumerate(network.kernels(psf)):
        height, width = 33 // 2**scale, 47 // 2**scale
        assert kernels.shape == (1, 4 * 2**scale, height, width)
        assert kernels.min() >= 0
        torch.testing.assert_close(kernels.sum((-2, -1)), torch.ones(1, 4 * 2**scale))
        # The point stays at the centre of each scale.
        assert (kernels.flatten(2).argmax(-1) == height // 2 * width + width // 2).all()


@torch.no_grad()
def test_ifin_streams_meet_through_both_operators(generator):
    network = build("ifin", width=4).eval()
    exchange = network.scales[0]
    exchange.log_regularisation.add_(torch.randn(4, 1, 1, generator=generator))
    b, scene = (torch.rand(1, 3, 15, 18, generator=generator) for _ in range(2))
    kernels = torch.rand(1, 4, 15, 18, generator=generator) ** 6
    kernels = kernels / kernels.sum((-2, -1), keepdim=True)
    result = exchange(b, scene, kernels)
    sensor_features, scene_features = exchange.sensor(b), exchange.scene(scene)
    constants = exchange.log_regularisation.exp().flatten().tolist()
    patterns, estimates = [], []
    for c in range(4):
        kernel = kernels[0, c].double().numpy()
        patterns.append(oracles.convolve(scene_features[0, c].double().numpy(), kernel))
        estimates.append(oracles.wiener(sensor_features[0, c].double().numpy(), kernel, constants[c], "replicate"))
    for stream, exchanged, mixing, output in (
        (sensor_features, patterns, exchange.from_scene, result[0]),
        (scene_features, estimates, exchange.from_sensor, result[1]),
    ):
        other = torch.from_numpy(np.stack(exchanged)[None]).float()
        close(output, stream + mixing(torch.cat([stream, other], dim=1)), part=1e-3)

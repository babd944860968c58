"""Le-ADMM, Le-ADMM-U, MMCN and UPDN against float64 loops written from their equations, and their counts."""

import numpy as np
import pytest
import torch
from torch.nn import functional as F

import oracles
from made import trained
from mwdn.benchmark.published import PUBLISHED
from mwdn.networks import NETWORKS, build
from mwdn.optics import unit_sum
from mwdn.solvers import Admm, Penalties
from mwdn.solvers.proximal import dual_projection

COUNTS = {"le-admm": 20, "le-admm-u": 11_772_327, "mmcn": 18_863_559, "updn": 2_744_411}


def count(module):
    return sum(parameter.numel() for parameter in module.parameters())


@pytest.mark.parametrize("name", COUNTS)
def test_learnable_numbers(name):
    with torch.device("meta"):
        assert count(build(name)) == COUNTS[name]


def test_parts_of_the_counts():
    """As the sources' parts have them."""
    with torch.device("meta"):
        updn, both = build("updn"), build("le-admm-u")
    assert updn.correction.numel() == 1_944_000
    assert count(updn.steps) == 42_400
    assert count(updn.unet) == 758_011
    assert count(both.denoiser) == 11_772_307
    assert count(both.admm) == 20


def test_published_settings_are_of_known_networks():
    assert set(PUBLISHED) <= set(NETWORKS)
    assert PUBLISHED["updn"].rate == 5e-4
    assert all(each.rate is None or 0 < each.rate < 1 for each in PUBLISHED.values())


def pair(generator, size, *, batch=2):
    scene = F.interpolate(torch.rand(batch, 3, 5, 5, generator=generator), size=size, mode="bicubic").clamp(0, 1)
    h = unit_sum(torch.rand(1, 3, *size, generator=generator) ** 8)
    b = np.stack([[oracles.convolve(v, k) for v, k in zip(one, h[0], strict=True)] for one in scene.numpy()])
    return torch.from_numpy(b / b.max()).float(), h


# --- Le-ADMM ------------------------------------------------------------------------------------------


def le_admm(b, h, constants):
    """Each iterate of one sample (C, H, W), all on the whole grid, multipliers not divided by anything."""
    height, width = b.shape[-2:]
    grid = oracles.smooth_even(2 * height), oracles.smooth_even(2 * width)
    fourier, inverse = np.fft.fft2, lambda z: np.fft.ifft2(z).real
    grey = h.sum(0)
    H = oracles.transfer(grey / np.sqrt((grey**2).sum()), grid)
    sensor, data = np.zeros(grid), np.zeros((len(b), *grid))
    sensor[:height, :width] = 1
    data[:, :height, :width] = b / b.max()
    forward = lambda v: np.stack([np.roll(v, -1, axis) - v for axis in (-2, -1)])  # noqa: E731
    backward = lambda u: sum(np.roll(u[i], 1, axis) - u[i] for i, axis in enumerate((-2, -1)))  # noqa: E731
    laplacian = sum(4 * np.sin(np.pi * np.fft.fftfreq(n)) ** 2 for n in [grid[0]])[:, None]
    laplacian = laplacian + 4 * np.sin(np.pi * np.fft.fftfreq(grid[1])) ** 2
    v = np.zeros_like(data)
    xi, rho, eta = np.zeros_like(v), np.zeros_like(v), np.zeros((2, *v.shape))
    result = []
    for mu1, mu2, mu3, threshold in constants:
        g = forward(v) + eta / mu2
        length = np.sqrt((g**2).sum(0))
        u = g * np.maximum(length - threshold, 0) / np.where(length > 0, length, 1)
        x = (xi + mu1 * inverse(H * fourier(v)) + data) / (sensor + mu1)
        w = np.maximum(rho / mu3 + v, 0)
        right = fourier(mu3 * w - rho + backward(mu2 * u - eta)) + H.conj() * fourier(mu1 * x - xi)
        v = inverse(right / (mu1 * abs(H) ** 2 + mu2 * laplacian + mu3))
        xi = xi + mu1 * (inverse(H * fourier(v)) - x)
        eta = eta + mu2 * (forward(v) - u)
        rho = rho + mu3 * (v - w)
        result.append(v[:, :height, :width])
    return result


def constants_of(network):
    names = ("log_data", "log_gradient", "log_sign", "log_threshold")
    return np.stack([getattr(network, name).detach().double().exp().numpy() for name in names], axis=1)


def close(result, expected, part=2e-3):
    """Within a part of the expected picture's largest value: single precision, 5 divisions by small numbers."""
    expected = torch.as_tensor(np.asarray(expected)).float()
    torch.testing.assert_close(result, expected, rtol=0, atol=part * expected.abs().max().item())


@torch.no_grad()
@pytest.mark.parametrize("size", [(12, 16), (13, 9)])
def test_le_admm_is_its_equations(size, generator):
    network = trained(build("le-admm"), generator, spread=0.5, power=0.2)
    b, h = pair(generator, size)
    iterates, scenes = network.iterates(b, network.prepare(h, b.shape[-2:])), network(b, h)
    assert len(iterates) == 5
    for sample in range(2):
        expected = le_admm(b[sample].double().numpy(), h[0].double().numpy(), constants_of(network))
        for result, one in zip(iterates, expected, strict=True):
            close(result[sample], one)
        close(scenes[sample], expected[-1] / expected[-1].max())


@torch.no_grad()
def test_le_admm_with_fixed_numbers_is_the_solver(generator):
    """The solver brings b to unit L2 norm, the network to a peak of 1; tau and the scene scale with it."""
    penalty, threshold = 0.02, 0.01
    network = build("le-admm", iterations=7, penalty=penalty, threshold=threshold)
    b, h = pair(generator, (14, 11), batch=1)
    h = h.mean(1, keepdim=True)
    tau = threshold * penalty * (b.max() / b.norm()).item()
    expected = Admm(tau, Penalties(penalty, penalty, penalty), iterations=7, variation="isotropic")(b, h)
    result = network.iterates(b, network.prepare(h, b.shape[-2:]))[-1].clamp(min=0) * b.max() / h.norm()
    torch.testing.assert_close(result, expected, rtol=1e-4, atol=1e-5 * expected.max().item())


def train(network, b, h, scene, *, steps):
    optimiser = torch.optim.Adam(network.parameters(), lr=0.1)
    losses = []
    for _ in range(steps):
        loss = F.mse_loss(network(b, h), scene)
        optimiser.zero_grad()
        loss.backward()
        losses.append(loss.item())
        if not all(parameter.grad.isfinite().all() for parameter in network.parameters()):
            return losses, False
        optimiser.step()
    return losses, True


def test_le_admm_trains_from_its_zero_start(generator):
    b, h = pair(generator, (16, 16))
    scene = torch.rand(2, 3, 16, 16, generator=generator).cumsum(-1) / 16
    network = build("le-admm")
    losses, finite = train(network, b, h, scene, steps=25)
    assert finite
    assert losses[-1] < 0.95 * losses[0]
    assert all((parameter.grad != 0).any() for parameter in network.parameters())


def test_the_original_shrinkage_does_not():
    """Its first step takes the root of (0 / mu2)^2, whose derivative by mu2 is 0 times infinity."""

    def textbook(u, threshold, variation):
        length = (u[0].square() + u[1].square()).sqrt()
        kept = (length - threshold).clamp(min=0)
        return u[0] * kept / (kept + threshold), u[1] * kept / (kept + threshold)

    def ours(u, threshold, variation):
        return [given - part for given, part in zip(u, dual_projection(u, threshold, variation), strict=True)]

    for shrinkage, finite in ((textbook, False), (ours, True)):
        mu = torch.tensor(1e-4, requires_grad=True)
        zero = torch.zeros(1, 1, 4, 4) / mu
        sum(part.sum() for part in shrinkage((zero, zero), 2e-4, "isotropic")).backward()
        assert mu.grad.isfinite().item() is finite


# --- The U-Net behind it ------------------------------------------------------------------------------


def normalised(x, state, key):
    """Convolution without bias, BatchNorm's running statistics, ReLU, in float64."""
    where, _, place = key.rpartition(".")
    norm = f"{where}.{int(place) + 1}"
    x = F.conv2d(x, state[f"{key}.weight"], padding=1)
    mean, var = state[f"{norm}.running_mean"], state[f"{norm}.running_var"]
    x = (x - mean[:, None, None]) / (var[:, None, None] + 1e-5).sqrt()
    return (x * state[f"{norm}.weight"][:, None, None] + state[f"{norm}.bias"][:, None, None]).clamp(min=0)


def halved(x):
    height, width = (n // 2 for n in x.shape[-2:])
    return x[..., : 2 * height, : 2 * width].reshape(*x.shape[:-2], height, 2, width, 2).amax((-3, -1))


def enlarged(x, size):
    """Bilinear between the centres of pixels, as two matrix products."""

    def weights(n, m):
        source = ((torch.arange(n, dtype=torch.float64) + 0.5) * m / n - 0.5).clamp(0, m - 1)
        return (1 - (source[:, None] - torch.arange(m)).abs()).clamp(min=0)

    return weights(size[0], x.shape[-2]) @ x @ weights(size[1], x.shape[-1]).T


@torch.no_grad()
@pytest.mark.parametrize("size", [(64, 66), (40, 67)])
def test_le_admm_u_is_its_equations(size, generator):
    network = trained(build("le-admm-u", width=3, iterations=2), generator, spread=0.5, power=0.2)
    b, h = pair(generator, size, batch=1)
    x = le_admm(b[0].double().numpy(), h[0].double().numpy(), constants_of(network.admm))[-1]
    x = torch.from_numpy(np.pad(x / x.max(), ((0, 0), (0, max(0, 64 - size[0])), (0, 0)), mode="edge"))[None]
    state = {key.removeprefix("denoiser."): value.double() for key, value in network.state_dict().items()}
    skips = []
    for scale in range(5):
        for layer in (0, 3):
            x = normalised(x, state, f"encoders.{scale}.{layer}")
        skips.append(x)
        x = halved(x)
    x = normalised(x, state, "centre.0")
    for scale, skip in enumerate(skips[::-1]):
        x = torch.cat([enlarged(x, skip.shape[-2:]), skip], 1)
        for layer in (0, 3, 6):
            x = normalised(x, state, f"decoders.{scale}.{layer}")
    x = F.conv2d(x, state["head.weight"], state["head.bias"])
    close(network(b, h), x[..., : size[0], : size[1]])


# --- MMCN ---------------------------------------------------------------------------------------------


@torch.no_grad()
def test_mmcn_without_compensation_is_le_admm_u(generator):
    network = trained(build("mmcn", width=4), generator, spread=0.5, power=0.2)
    b, h = pair(generator, (20, 33))
    with_branch = network(b, h)
    weight = network.denoiser.centre[0].weight
    inputs = weight.shape[1]
    weight[:, inputs // 2 :] = 0  # what the branch gives comes second, as many channels as the U-Net's own
    plain = build("le-admm-u", width=4).eval()
    state = {key: value for key, value in network.state_dict().items() if key.startswith(("admm.", "denoiser."))}
    state["denoiser.centre.0.weight"] = weight[:, : inputs // 2]
    plain.load_state_dict(state)
    torch.testing.assert_close(network(b, h), plain(b, h), rtol=1e-4, atol=1e-5)
    assert (with_branch - plain(b, h)).abs().max() > 1e-4


@torch.no_grad()
def test_mmcn_sees_every_iterate(generator):
    """The branch of step k + 1 is fed by iterate k, at half the scale of the step before."""
    network = trained(build("mmcn", width=4), generator, spread=0.5, power=0.2)
    b, h = pair(generator, (20, 33))
    seen = []
    for module in network.residuals:
        module.register_forward_pre_hook(lambda _, inputs: seen.append(inputs[0]))
    shapes = []
    for module in network.branch:
        module.register_forward_hook(lambda _, inputs, output: shapes.append((inputs[0].shape[1:], output.shape[1])))
    network(b, h)
    for result, iterate in zip(seen, network.admm.iterates(b, network.prepare(h, b.shape[-2:]))[:4], strict=True):
        close(result[..., :20, :33], iterate / iterate.amax((1, 2, 3), keepdim=True), part=1e-5)
    sizes = [tuple(shape[1:]) for shape, _ in shapes]
    assert sizes == [(64, 64), (32, 32), (16, 16), (8, 8), (4, 4)]
    widths = [width for _, width in shapes]
    assert [shape[0] for shape, _ in shapes] == [3, *(width + 3 for width in widths[:-1])]


# --- UPDN ---------------------------------------------------------------------------------------------


def updn(network, b, h):
    """One sample, colour for colour, in float64: circular convolution on twice the sensor, the sensor in its middle."""
    state = {key: value.double() for key, value in network.state_dict().items()}
    height, width = b.shape[-2:]
    grid = 2 * height, 2 * width
    top, left = height - height // 2, width - width // 2
    middle = (slice(top, top + height), slice(left, left + width))
    h = h / h.max()
    total = h.sum((-2, -1)).mean()
    conv = lambda x, key, pad: F.conv2d(x, state[f"{key}.weight"], state.get(f"{key}.bias"), padding=pad)  # noqa: E731
    colours = []
    for colour in range(len(b)):
        psfs = (h[colour] + state["correction"][colour].numpy()) / total
        H = np.stack([oracles.transfer(psf, grid) for psf in psfs])
        data = torch.from_numpy(b[colour])[None, None]
        primal, dual = (
            torch.zeros(1, network.width, *grid).double(),
            torch.zeros(1, network.width, height, width).double(),
        )
        for step in range(len(network.steps)):
            cast = torch.from_numpy(np.fft.ifft2(H * np.fft.fft2(primal.numpy())).real)[..., *middle]
            x = conv(torch.cat([cast, dual, data], 1), f"steps.{step}.dual.0", 1).clamp(min=0)
            dual = dual + conv(x, f"steps.{step}.dual.2", 0)
            wide = np.zeros(primal.shape)
            wide[..., *middle] = dual.numpy()
            back = torch.from_numpy(np.fft.ifft2(H.conj() * np.fft.fft2(wide)).real)
            x = conv(torch.cat([back, primal], 1), f"steps.{step}.primal.0", 1).clamp(min=0)
            primal = primal + conv(x, f"steps.{step}.primal.2", 0)
        scenes = primal[..., *middle]
        x, skips = scenes, []
        for scale in range(5):
            x = halved(x) if scale else x
            for layer in (0, 2):
                x = conv(x, f"unet.encoders.{scale}.{layer}", 1).clamp(min=0)
            skips.append(x)
        for scale, skip in enumerate(skips[-2::-1]):
            weight, bias = state[f"unet.ups.{scale}.weight"], state[f"unet.ups.{scale}.bias"]
            # Each pixel becomes a block of 2 x 2; an odd last row or column has the bias alone.
            blocks = torch.einsum("bihw,iokl->bohkwl", x, weight).flatten(4, 5).flatten(2, 3)
            odd = (0, skip.shape[-1] - blocks.shape[-1], 0, skip.shape[-2] - blocks.shape[-2])
            x = torch.cat([F.pad(blocks, odd) + bias[:, None, None], skip], 1)
            for layer in (0, 2):
                x = conv(x, f"unet.decoders.{scale}.{layer}", 1).clamp(min=0)
        colours.append(torch.sigmoid(scenes[:, :1] + conv(x, "unet.head", 0))[0, 0])
    return torch.stack(colours)


@torch.no_grad()
@pytest.mark.parametrize("size", [(16, 18), (17, 31)])
def test_updn_is_its_equations(size, generator):
    network = build("updn", width=3, depth=3, size=size).eval()
    network.correction.copy_(0.1 * torch.randn(network.correction.shape, generator=generator))
    b, h = pair(generator, size)
    result = network(b, h)
    for sample in range(2):
        close(result[sample], updn(network, b[sample].double().numpy(), h[0].double().numpy()), part=1e-4)


@torch.no_grad()
def test_updn_begins_at_the_measured_psf_and_stretches_what_it_learned(generator):
    network = build("updn", width=2, depth=1, size=(16, 20))
    _, h = pair(generator, (32, 40))
    start = network.psfs(h, (32, 40))
    assert start.shape == (1, 6, 32, 40)
    torch.testing.assert_close(start[:, ::2], h / h.sum((-2, -1)).mean())
    network.correction.fill_(0.25)  # of the PSF's peak, everywhere
    added = (network.psfs(h, (32, 40)) - start) * (h / h.max()).sum((-2, -1)).mean()
    torch.testing.assert_close(added, torch.full_like(added, 0.25), rtol=0, atol=1e-4)
    plain = build("updn", width=2, depth=1, size=None)
    assert plain.correction is None
    torch.testing.assert_close(plain.psfs(h, (32, 40)), start)

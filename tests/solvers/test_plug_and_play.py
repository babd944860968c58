"""Plug and play: its fixed point against a dense system of equations, its noise levels, its mirrors."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
import torch

import oracles
from cameras import contour_psf
from mwdn.fourier.convolution import convolve
from mwdn.networks import build
from mwdn.solvers import Penalties
from mwdn.solvers.levels import REFERENCE_NOISE, Level, root_mean_square
from mwdn.solvers.plug_and_play import certainty, plug_and_play
from mwdn.solvers.pyramid import solve

SIZE = 24, 32


@pytest.fixture
def solved(generator):
    """The pyramid's estimate of a scene in the middle of the frame, whose pattern the sensor crops."""
    psf = contour_psf(SIZE, cell=6, generator=generator).expand(1, 3, -1, -1)
    scene = torch.zeros(2, 3, *SIZE)
    scene[..., 6:18, 8:26] = 0.2 + torch.rand(2, 3, 12, 18, generator=generator)
    return solve(convolve(scene, psf), psf), scene, psf


def constant(scene):
    """A denoiser that returns this scene, mirrored as in each round."""
    mirrored = itertools.cycle([scene.flip(axes) for axes in ([], [-1], [-2], [-2, -1])])
    return lambda picture, level: next(mirrored)


def with_noise(estimate, noise):
    """The same estimate with this noise."""
    estimate = replace(estimate)
    vars(estimate)["noise"] = noise  # the cached property's value
    return estimate


def test_fixed_point_minimises_data_and_prior(generator):
    """W/2 |crop(h * v) - b|^2 + rho/2 |v - z|^2 with a denoiser that always returns z in the frame."""
    level, weight, sensor, centre = 0.02, 5.0, (5, 6), (slice(1, 6), slice(1, 7))
    psf = 0.2 + torch.rand(3, 3, generator=generator, dtype=torch.float64)
    psf = psf / psf.sum()
    A = oracles.matrix(psf.numpy(), sensor)
    truth = 1 + torch.rand(7, 8, generator=generator, dtype=torch.float64) + 4 * (torch.arange(8) > 3)
    b = A @ truth.numpy().ravel()
    z = truth[centre] + 0.5 * torch.rand(sensor, generator=generator, dtype=torch.float64)
    estimate = solve(
        torch.from_numpy(b).view(1, 1, *sensor).float(),
        psf.float()[None, None],
        (Level(1, 50, Penalties(0.5, 0.0, 0.5)),),
    )
    brightest, pictures = estimate.scene.max(), []
    clean = constant((z / brightest).float()[None, None])

    def denoise(picture, sigma):
        assert sigma.item() == pytest.approx(level)
        pictures.append(picture)
        return clean(picture, sigma)

    result = plug_and_play(
        estimate, denoise, 1501, noise_levels=(level, level), noise_exponent=0.0, prior_weight=weight
    )
    torch.testing.assert_close(result.scene, z.float()[None, None])
    noise = estimate.noise.clamp(min=REFERENCE_NOISE) * root_mean_square(estimate.measurement)
    rho = weight * float(noise / (level * brightest)) ** 2
    inside = np.zeros((7, 8), bool)
    inside[centre] = True
    prior = np.sqrt(rho) * np.eye(56)[inside.ravel()]

    def minimum(certain):
        rows = np.sqrt(certain.numpy().ravel())
        system, target = np.vstack([rows[:, None] * A, prior]), [rows * b, np.sqrt(rho) * z.numpy().ravel()]
        solution = np.linalg.lstsq(system, np.concatenate(target), rcond=None)[0]
        return torch.from_numpy(solution.reshape(7, 8)[centre]).float()

    certain = certainty(estimate.measurement - estimate.residual)
    expected = minimum(certain)
    torch.testing.assert_close((pictures[-1] * brightest)[0, 0], expected, rtol=0, atol=2e-3)
    assert (z - expected).abs().max() > 0.02  # the data matter
    assert (minimum(torch.ones_like(certain)) - expected).abs().max() > 0.01  # and their weights


def test_perfect_denoiser_gives_the_scene(solved):
    estimate, scene, _ = solved
    unit = estimate.scene.amax((1, 2, 3), keepdim=True)
    result = plug_and_play(estimate, constant(scene / unit), 8)
    torch.testing.assert_close(result.scene, scene)
    assert result.residual.norm() < 0.3 * estimate.residual.norm()
    assert result.measurement is estimate.measurement
    assert (result.grid_scene >= 0).all()


def test_dark_pixels_weigh_more():
    """Photon noise: k times the light has k times the variance, besides the noise that all pixels have."""
    light = torch.tensor([0.0, 1.0, 1.0, 2.0]).view(1, 1, 2, 2)
    weight = certainty(light)
    torch.testing.assert_close(weight.mean(), torch.tensor(1.0))
    torch.testing.assert_close(weight[0, 0, 0, 0] / weight[0, 0, 0, 1], torch.tensor(2.0))
    torch.testing.assert_close(weight[0, 0, 0, 1] / weight[0, 0, 1, 1], torch.tensor(1.5))
    both = torch.cat([7 * light, light.flip(-1)])  # each sample on its own
    torch.testing.assert_close(certainty(both), torch.cat([weight, weight.flip(-1)]))
    assert torch.equal(certainty(torch.zeros_like(light)), torch.ones_like(light))


def test_noise_level_falls_and_only_the_frame_is_denoised(solved):
    estimate, _, _ = solved
    calls = []

    def denoise(picture, level):
        calls.append((tuple(picture.shape), level.flatten().tolist()))
        return picture

    plug_and_play(with_noise(estimate, torch.full((2, 1, 1, 1), REFERENCE_NOISE)), denoise, 3)
    assert [shape for shape, _ in calls] == 3 * [(2, 3, *SIZE)]
    assert [level for _, levels in calls for level in levels] == pytest.approx(
        [level for level in (0.03, (0.03 * 0.005) ** 0.5, 0.005) for _ in range(2)]
    )


def test_noise_raises_the_levels_of_its_own_sample(solved):
    estimate, _, _ = solved
    noise, levels = torch.tensor([0.5 * REFERENCE_NOISE, 16 * REFERENCE_NOISE]).view(2, 1, 1, 1), []

    def denoise(picture, level):
        levels.append(level.flatten().tolist())
        return picture

    plug_and_play(with_noise(estimate, noise), denoise, 2)
    assert levels[0] == pytest.approx([0.03, 8 * 0.03])
    assert levels[1] == pytest.approx([0.005, 8 * 0.005])


def test_mirrored_rounds_cancel_asymmetric_errors(solved):
    """A denoiser that shifts everything to the right shifts it to the left as often."""
    estimate, _, _ = solved
    right = plug_and_play(estimate, lambda picture, level: picture.roll(1, -1), 4).scene
    left = plug_and_play(estimate, lambda picture, level: picture.roll(-1, -1), 4).scene
    still = plug_and_play(estimate, lambda picture, level: picture, 4).scene
    once = plug_and_play(estimate, lambda picture, level: picture.roll(1, -1), 1).scene
    assert (right - left).norm() < (once - still).norm()


def test_scene_scales_with_the_measurement(solved):
    estimate, _, psf = solved
    torch.manual_seed(0)
    denoise = build("drunet", widths=(4, 6), blocks=1).requires_grad_(False)
    once = plug_and_play(estimate, denoise, 2).scene
    bright = plug_and_play(solve(100 * estimate.measurement, psf), denoise, 2).scene
    torch.testing.assert_close(bright, 100 * once, rtol=1e-3, atol=1e-2)
    alone = plug_and_play(solve(estimate.measurement[1:], psf), denoise, 2).scene
    torch.testing.assert_close(alone, once[1:], rtol=1e-3, atol=1e-4)


def test_residual_of_a_wrong_psf_counts_as_noise(solved):
    """With constant denoiser levels, which follow the sensor's noise alone."""
    estimate, _, psf = solved
    wrong = solve(estimate.measurement, psf.flip(-1))
    relative = root_mean_square(wrong.residual) / root_mean_square(wrong.measurement)
    assert (relative > 1.5 * wrong.noise.clamp(min=REFERENCE_NOISE)).all()
    blur = lambda picture, level: torch.nn.functional.avg_pool2d(picture, 3, 1, 1)  # noqa: E731
    expected, result = (
        plug_and_play(start, blur, 3, noise_exponent=0.0).scene for start in (with_noise(wrong, relative), wrong)
    )
    torch.testing.assert_close(result, expected)

"""Plug and play: where it ends against a dense system of equations, and what a good denoiser is worth."""

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
from mwdn.solvers import plug_and_play as module
from mwdn.solvers.plug_and_play import certainty, plug_and_play
from mwdn.solvers.pyramid import QUIET, Level, brightness, solve

SIZE = 24, 32


@pytest.fixture
def found(generator):
    """A scene in the middle of the frame, whose pattern the sensor crops, and what the pyramid makes of it."""
    psf = contour_psf(SIZE, cell=6, generator=generator).expand(1, 3, -1, -1)
    scene = torch.zeros(2, 3, *SIZE)
    scene[..., 6:18, 8:26] = 0.2 + torch.rand(2, 3, 12, 18, generator=generator)
    return solve(convolve(scene, psf), psf), scene, psf


def knowing(scene):
    """A denoiser that answers with this scene, mirrored as each round shows it."""
    ways = itertools.cycle([scene.flip(axes) for axes in ([], [-1], [-2], [-2, -1])])
    return lambda picture, level: next(ways)


def as_noisy(explained, noise):
    """The same explanation, as if its noise had been found to be this."""
    explained = replace(explained)
    vars(explained)["noise"] = noise  # where the cached property would keep it
    return explained


def test_it_ends_where_sensor_and_denoiser_pull_alike(generator, monkeypatch):
    """Of W/2 |crop(h * v) - b|^2 + rho/2 |v - z|^2 with a denoiser that always answers z, the least in the frame."""
    level, sensor, centre = 0.02, (5, 6), (slice(1, 6), slice(1, 7))
    monkeypatch.setattr(module, "LEVELS", (level, level))
    monkeypatch.setattr(module, "POOR", 0.0)  # whatever the noise
    monkeypatch.setattr(module, "TRUST", 5.0)  # where the sensor's pixels must give way, and which do matters
    psf = 0.2 + torch.rand(3, 3, generator=generator, dtype=torch.float64)
    psf = psf / psf.sum()
    A = oracles.matrix(psf.numpy(), sensor)
    truth = 1 + torch.rand(7, 8, generator=generator, dtype=torch.float64) + 4 * (torch.arange(8) > 3)
    b = A @ truth.numpy().ravel()
    z = truth[centre] + 0.5 * torch.rand(sensor, generator=generator, dtype=torch.float64)
    found = solve(
        torch.from_numpy(b).view(1, 1, *sensor).float(),
        psf.float()[None, None],
        (Level(1, 50, Penalties(0.5, 0.0, 0.5)),),
    )
    brightest, seen = found.scene.max(), []
    answer = knowing((z / brightest).float()[None, None])

    def denoise(picture, told):
        assert told.item() == pytest.approx(level)
        seen.append(picture)
        return answer(picture, told)

    ended = plug_and_play(found, denoise, 1501)
    torch.testing.assert_close(ended.scene, z.float()[None, None])
    rho = module.TRUST * float(found.noise.clamp(min=QUIET) * brightness(found.measurement) / (level * brightest)) ** 2
    inside = np.zeros((7, 8), bool)
    inside[centre] = True
    prior = np.sqrt(rho) * np.eye(56)[inside.ravel()]

    def least(weight):
        rows = np.sqrt(weight.numpy().ravel())
        system, wanted = np.vstack([rows[:, None] * A, prior]), [rows * b, np.sqrt(rho) * z.numpy().ravel()]
        solution = np.linalg.lstsq(system, np.concatenate(wanted), rcond=None)[0]
        return torch.from_numpy(solution.reshape(7, 8)[centre]).float()

    certain = certainty(found.measurement - found.residual)
    expected = least(certain)
    torch.testing.assert_close((seen[-1] * brightest)[0, 0], expected, rtol=0, atol=2e-3)
    assert (z - expected).abs().max() > 0.02  # which is not merely z
    assert (least(torch.ones_like(certain)) - expected).abs().max() > 0.01  # nor that of pixels that weigh the same


def test_a_denoiser_that_knows_the_scene_explains_the_measurement(found):
    explained, scene, _ = found
    unit = explained.scene.amax((1, 2, 3), keepdim=True)
    ended = plug_and_play(explained, knowing(scene / unit), 8)
    torch.testing.assert_close(ended.scene, scene)
    assert ended.residual.norm() < 0.3 * explained.residual.norm()
    assert ended.measurement is explained.measurement
    assert (ended.whole >= 0).all()


def test_a_dark_pixel_says_more():
    """Light is counted: of k times the light, the noise has k times the variance, but for what all pixels have."""
    light = torch.tensor([0.0, 1.0, 1.0, 2.0]).view(1, 1, 2, 2)
    weight = certainty(light)
    torch.testing.assert_close(weight.mean(), torch.tensor(1.0))
    torch.testing.assert_close(weight[0, 0, 0, 0] / weight[0, 0, 0, 1], torch.tensor(2.0))
    torch.testing.assert_close(weight[0, 0, 0, 1] / weight[0, 0, 1, 1], torch.tensor(1.5))
    both = torch.cat([7 * light, light.flip(-1)])  # each sample by itself, whatever its brightness
    torch.testing.assert_close(certainty(both), torch.cat([weight, weight.flip(-1)]))
    assert torch.equal(certainty(torch.zeros_like(light)), torch.ones_like(light))


def test_the_level_falls_and_the_frame_alone_is_denoised(found):
    explained, _, _ = found
    told = []

    def denoise(picture, level):
        told.append((tuple(picture.shape), level.flatten().tolist()))
        return picture

    plug_and_play(as_noisy(explained, torch.full((2, 1, 1, 1), QUIET)), denoise, 3)  # in good light
    assert [shape for shape, _ in told] == 3 * [(2, 3, *SIZE)]
    assert [level for _, levels in told for level in levels] == pytest.approx(
        [each for each in (0.03, (0.03 * 0.005) ** 0.5, 0.005) for _ in range(2)]
    )


def test_poor_light_raises_the_levels_of_its_own_sample(found):
    explained, _, _ = found
    noise, told = torch.tensor([0.5 * QUIET, 16 * QUIET]).view(2, 1, 1, 1), []

    def denoise(picture, level):
        told.append(level.flatten().tolist())
        return picture

    plug_and_play(as_noisy(explained, noise), denoise, 2)
    assert told[0] == pytest.approx([0.03, 8 * 0.03])
    assert told[1] == pytest.approx([0.005, 8 * 0.005])


def test_each_round_shows_the_scene_mirrored_another_way(found):
    """A denoiser that moves everything to the right is as often told the other way round."""
    explained, _, _ = found
    right = plug_and_play(explained, lambda picture, level: picture.roll(1, -1), 4).scene
    left = plug_and_play(explained, lambda picture, level: picture.roll(-1, -1), 4).scene
    still = plug_and_play(explained, lambda picture, level: picture, 4).scene
    once = plug_and_play(explained, lambda picture, level: picture.roll(1, -1), 1).scene
    assert (right - left).norm() < (once - still).norm()


def test_brighter_light_gives_a_brighter_scene(found):
    explained, _, psf = found
    torch.manual_seed(0)
    denoise = build("drunet", widths=(4, 6), blocks=1).requires_grad_(False)
    once = plug_and_play(explained, denoise, 2).scene
    bright = plug_and_play(solve(100 * explained.measurement, psf), denoise, 2).scene
    torch.testing.assert_close(bright, 100 * once, rtol=1e-3, atol=1e-2)
    alone = plug_and_play(solve(explained.measurement[1:], psf), denoise, 2).scene
    torch.testing.assert_close(alone, once[1:], rtol=1e-3, atol=1e-4)


def test_what_the_psf_does_not_explain_counts_as_noise(found, monkeypatch):
    """Through a PSF that is not the camera's; the levels, which follow the sensor's noise alone, kept."""
    monkeypatch.setattr(module, "POOR", 0.0)
    explained, _, psf = found
    wrong = solve(explained.measurement, psf.flip(-1))
    rest = brightness(wrong.residual) / brightness(wrong.measurement)
    assert (rest > 1.5 * wrong.noise.clamp(min=QUIET)).all()
    blur = lambda picture, level: torch.nn.functional.avg_pool2d(picture, 3, 1, 1)  # noqa: E731
    told = plug_and_play(as_noisy(wrong, rest), blur, 3).scene
    torch.testing.assert_close(plug_and_play(wrong, blur, 3).scene, told)

"""The pyramid against scipy's least squares, direct decimation, and a Wiener filter on cropped patterns."""

from functools import partial

import numpy as np
import pytest
import torch
from scipy.optimize import nnls
from torch.nn import functional as F

import oracles
from cameras import contour_psf
from mwdn import Camera, fourier
from mwdn.errors import ParameterError
from mwdn.optics.noise import noise_level
from mwdn.solvers import Penalties
from mwdn.solvers.levels import LEVELS, Level
from mwdn.solvers.pyramid import Pyramid, even_start, halve, low_band, solve
from mwdn.solvers.splitting import Problem
from mwdn.solvers.wiener import Wiener

FINE = Penalties(0.5, 0.0, 0.5)


def test_one_fine_level_reaches_the_least_squares_of_scipy(generator):
    """Alone, a level of the full size is non-negative least squares with the crop."""
    sensor, psf = (5, 6), torch.rand(1, 1, 5, 6, generator=generator) ** 4
    psf = psf / psf.sum()
    b = torch.rand(1, 1, *sensor, generator=generator)
    result = solve(b, psf, (Level(1, 3000, FINE),))
    A = oracles.matrix(psf[0, 0].double().numpy(), sensor)
    _, smallest = nnls(A.reshape(A.shape[0], -1), b.double().numpy().ravel())
    assert float(result.residual.norm()) == pytest.approx(smallest, abs=2e-3)


@pytest.mark.parametrize("seed", range(3))
def test_an_evenly_lit_wall_is_even(seed):
    """The sensor crops most at the edges; there light around the frame explains the measurement nearly as well."""
    size, random = (96, 128), torch.Generator().manual_seed(seed)
    psf = contour_psf(size, generator=random)
    b = Camera(psf / psf.sum()).forward(torch.ones(1, 1, *size))
    b = b + 0.005 * b.max() * torch.randn(b.shape, generator=random)
    blocks = F.avg_pool2d(solve(b, psf / psf.sum()).scene, 16)
    assert 0.8 < blocks.min() <= blocks.max() < 1.15


def test_even_light_is_that_of_an_evenly_lit_frame(generator):
    """Where only the frame is lit, and evenly, the iterations start at the solution; each colour has its own light."""
    size, psf = (48, 64), contour_psf((48, 64), generator=generator)
    colours = torch.tensor([0.2, 1.0, 0.5])[:, None, None]
    b = Camera(psf).forward(colours.expand(1, 3, *size))
    problem = Problem.from_psf(b, psf.expand(1, 3, -1, -1))
    light = even_start(problem)
    torch.testing.assert_close(light[..., : size[0], : size[1]], colours.expand(1, 3, *size), rtol=1e-4, atol=1e-4)
    assert light.sum((-2, -1)) == pytest.approx(light[..., : size[0], : size[1]].sum((-2, -1)))


def test_a_lit_start_ends_at_the_same_scene_and_gets_there_sooner(generator):
    size, psf = (32, 40), contour_psf((32, 40), cell=8, generator=generator)
    scene = F.interpolate(torch.rand(1, 1, 4, 5, generator=generator), size=size, mode="bilinear")
    b = Camera(psf).forward(scene)

    def solved(iterations, *, lit):
        return solve(b, psf, (Level(1, iterations, Penalties(0.06, 1.5, 0.24), 0.01, lit=lit),)).scene

    end, lit_end = solved(2000, lit=False), solved(2000, lit=True)
    torch.testing.assert_close(lit_end, end, rtol=0, atol=2e-3)
    assert (solved(10, lit=True) - end).norm() < 0.8 * (solved(10, lit=False) - end).norm()


def test_halving_keeps_place_and_light():
    """A linear ramp halved is the ramp at the middles of pairs of pixels."""
    ramp = torch.arange(16.0).expand(1, 1, 12, 16)
    half = halve(ramp)
    assert half.shape == (1, 1, 6, 8)
    torch.testing.assert_close(half[..., 1:-1], (2 * torch.arange(8.0) + 0.5)[1:-1].expand(1, 1, 6, 6))
    assert halve(torch.ones(2, 3, 7, 5)).shape == (2, 3, 4, 3)
    torch.testing.assert_close(halve(torch.ones(1, 3, 7, 5)), torch.ones(1, 3, 4, 3))


@pytest.mark.parametrize("downsampling", [1, 2, 4])
def test_low_band_of_a_coarse_scene_is_the_decimated_result(downsampling, generator):
    """A scene of low frequencies alone may be sampled before or after the convolution."""
    grid = (32, 48)
    psf = torch.rand(1, 1, *grid, generator=generator, dtype=torch.float64)
    spectrum = np.zeros(grid, complex)
    for row, column in ((0, 1), (2, 0), (3, 5), (-2, 4)):
        spectrum[row, column] = 1 + 2j
    scene = torch.from_numpy(np.fft.ifft2(spectrum).real)[None, None]
    H = fourier.transfer_function(psf, grid)
    fine = fourier.inverse_spectrum(fourier.spectrum(scene, grid) * H, grid, grid)
    small = grid[0] // downsampling, grid[1] // downsampling
    coarse = fourier.spectrum(scene[..., ::downsampling, ::downsampling], small) * low_band(H, grid, downsampling)
    result = fourier.inverse_spectrum(coarse, small, small)
    torch.testing.assert_close(result, fine[..., ::downsampling, ::downsampling], rtol=1e-4, atol=1e-5)


def test_cropped_pattern_is_reconstructed_far_better_than_by_wiener(generator):
    """Shading and colour of a scene that fills the field: the crop takes them from every linear filter."""
    psf = contour_psf((96, 128), generator=generator)
    scene = torch.full((1, 3, 96, 128), 0.1)
    scene[..., 20:70, 30:90] = torch.tensor([0.8, 0.5, 0.2])[:, None, None]
    measurement = fourier.convolve(scene, psf)
    errors = [
        float((method(measurement, psf) - scene).square().mean()) for method in (Pyramid(), Wiener(regularisation=1e-4))
    ]
    assert errors[0] < errors[1] / 5


def test_smoothing_follows_the_noise_of_the_light_not_of_the_dark(generator, monkeypatch):
    """A pattern on a part of the sensor: with the median noise of the whole frame the scene is hardly smoothed."""
    psf = F.pad(contour_psf((48, 64), generator=generator), (32, 32, 24, 24))
    scene = torch.zeros(1, 3, 96, 128)
    scene[..., 36:60, 44:84] = torch.tensor([0.8, 0.5, 0.2])[:, None, None]
    light = fourier.convolve(scene, psf)
    light = light / light.max()
    electrons = 2000 * light + (2000 * light + 9).sqrt() * torch.randn(light.shape, generator=generator)
    truth, errors = light.sum() / fourier.convolve(scene, psf).sum() * scene, {}
    for parts in (16, 1):
        monkeypatch.setattr("mwdn.solvers.levels.noise_level", partial(noise_level, parts=parts))
        errors[parts] = float((Pyramid()(electrons / 2000, psf) - truth).square().mean())
    assert errors[16] < 0.7 * errors[1]


def test_residual_has_less_energy_than_the_measurement(generator):
    psf = torch.rand(1, 3, 20, 27, generator=generator) ** 6
    measurement = torch.rand(2, 3, 20, 27, generator=generator)
    result = solve(measurement, psf)
    assert (result.scene >= 0).all()
    assert (result.residual.square().sum((1, 2, 3)) < measurement.square().sum((1, 2, 3))).all()


@pytest.mark.parametrize("downsampling", [2, 4, 8])
@pytest.mark.parametrize("size", [(33, 48), (40, 41), (47, 70)])
def test_coarse_scene_is_enlarged_and_cropped(downsampling, size, generator):
    psf, measurement = (torch.rand(1, 1, *size, generator=generator) ** power for power in (6, 1))
    result = solve(measurement, psf, (Level(downsampling, 2, FINE),))
    large = F.interpolate(result.grid_scene, scale_factor=downsampling, mode="bilinear")
    torch.testing.assert_close(result.scene, large[..., : size[0], : size[1]])


def test_impossible_constants_are_refused():
    with pytest.raises(ParameterError, match=r"`regularisation` \(0.0\) must be positive"):
        Pyramid(0.0)
    for sizes in ((), (2, 4), (3, 1), (2, 2), (4, 2), (1, 0)):
        with pytest.raises(ParameterError, match=r"`levels` .* powers of two"):
            Pyramid(levels=tuple(Level(size, 1, FINE) for size in sizes))


def test_pyramid_without_fine_levels_leaves_the_detail(generator):
    """A smooth scene that fills the field is fitted at a quarter of the size; fine detail stays in the residual."""
    psf = contour_psf((96, 128), generator=generator)
    smooth = torch.full((1, 3, 96, 128), 0.1)
    smooth[..., 20:70, 30:90] = torch.tensor([0.8, 0.5, 0.2])[:, None, None]
    fine = smooth.clone()
    fine[..., 40:44, 50:54] += 5.0
    residuals = []
    for scene in (smooth, fine):
        measurement = fourier.convolve(scene, psf)
        result = solve(measurement, psf, tuple(level for level in LEVELS if level.downsampling >= 4))
        assert result.scene.shape == measurement.shape
        assert (result.scene >= 0).all()
        residuals.append(float(result.residual.norm() / measurement.norm()))
        error = (result.scene - scene)[..., 24:66, 34:86].mean((2, 3)) / scene[..., 24:66, 34:86].mean((2, 3))
        assert error.abs().max() < 0.1
    assert residuals[0] < 0.02
    assert residuals[1] > 2 * residuals[0]

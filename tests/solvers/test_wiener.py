"""The noise level of a measurement, and the lambda that the Wiener solver chooses for it."""

import pytest
import torch

from cameras import contour_psf
from mwdn import fourier
from mwdn.errors import ParameterError, ShapeError
from mwdn.optics import Camera, Sensor
from mwdn.solvers import Wiener, noise_level

SIZE = 96, 80


@pytest.fixture
def psf(generator):
    return contour_psf(SIZE, generator=generator)


@pytest.fixture
def scene():
    """Bright shapes of several colours on dark ground."""
    scene = torch.full((1, 3, *SIZE), 0.02)
    scene[..., 30:60, 20:28] = torch.tensor([0.9, 0.6, 0.3])[:, None, None]
    scene[..., 30:37, 20:55] = torch.tensor([0.2, 0.8, 0.5])[:, None, None]
    scene[..., 50:66, 44:60] = torch.tensor([0.5, 0.5, 1.0])[:, None, None]
    return scene


def chosen(measurement, psf, **options):
    """The solver's lambda (B, C, 1, 1)."""
    solver = Wiener(**options)
    size = tuple(measurement.shape[-2:])
    grid = fourier.deconvolution_grid(size, solver.boundary)
    H = fourier.transfer_function(psf / psf.sum((-2, -1), keepdim=True), grid)
    B = fourier.spectrum(fourier.pad(measurement, grid, solver.boundary), grid)
    return solver.discrepancy(measurement, B, H, grid[1])


def psnr(result, scene):
    return -10 * (result.clamp(0, 1) - scene).square().mean().log10().item()


@pytest.mark.parametrize("sigma", [1e-3, 0.05, 2.0])
def test_white_noise_is_measured_to_two_percent(sigma, generator):
    noise = sigma * torch.randn(2, 3, 200, 300, generator=generator)
    torch.testing.assert_close(noise_level(noise), torch.full((2, 3, 1, 1), sigma), rtol=0.02, atol=0)


def test_smooth_pattern_and_a_few_edges_are_no_noise(generator):
    y, x = torch.linspace(0, 9, 200)[:, None], torch.linspace(0, 7, 240)
    pattern = 0.5 + 0.4 * torch.sin(y) * torch.cos(x + 0.3 * y)
    pattern[60:90, 50:120] += 0.8
    pattern = pattern.expand(1, 1, -1, -1)
    assert noise_level(pattern).item() < 1e-3
    noisy = pattern + 0.01 * torch.randn(pattern.shape, generator=generator)
    assert noise_level(noisy).item() == pytest.approx(0.01, rel=0.03)


def test_channels_are_measured_apart(generator):
    sigma = torch.tensor([0.01, 0.1, 0.3]).reshape(1, 3, 1, 1)
    result = noise_level(sigma * torch.randn(1, 3, 200, 200, generator=generator))
    torch.testing.assert_close(result, sigma, rtol=0.02, atol=0)


def test_photon_noise_is_the_mean_over_bright_and_dark_parts(generator):
    sigma = torch.full((200, 300), 0.001)
    sigma[:, 120:180] = 0.03
    noise = sigma * torch.randn(1, 1, 200, 300, generator=generator)
    mean = sigma.square().mean().sqrt().item()
    assert noise_level(noise).item() == pytest.approx(mean, rel=0.05)
    assert noise_level(noise, parts=1).item() < 0.1 * mean


@pytest.mark.parametrize("size", [(1, 1), (1, 7), (5, 1)])
def test_one_row_has_no_noise(size):
    assert noise_level(torch.rand(2, 3, *size)).tolist() == torch.zeros(2, 3, 1, 1).tolist()


def test_lambda_grows_with_the_noise(psf, scene, generator):
    light = fourier.convolve(scene, psf)
    noise = torch.randn(light.shape, generator=generator)
    result = [chosen(light + sigma * noise, psf).mean().item() for sigma in (0, 0.003, 0.01, 0.03, 0.1)]
    assert result == sorted(result)
    assert result[-1] > 10 * result[0]


@pytest.mark.parametrize("tolerance", [0.01, 0.03, 0.2])
@pytest.mark.parametrize("size", [(64, 48), (45, 51)])
def test_residual_has_the_power_of_noise_and_tolerance(size, tolerance, generator):
    """Circular, so that nothing is cropped, and in pixels instead of frequencies.

    An odd width has no Nyquist column: all columns of its half spectrum but the first count twice.
    """
    psf = contour_psf(size, cell=12, line=3.0, generator=generator)
    scene = torch.zeros(2, 3, *size)
    scene[..., 10:30, 12:20] = torch.tensor([0.9, 0.5, 1.0])[:, None, None]
    light = fourier.convolve(scene, psf, circular=True)
    measurement = light + 0.003 * torch.randn(light.shape, generator=generator)
    regularisation = chosen(measurement, psf, tolerance=tolerance, boundary="circular")
    estimate = fourier.wiener(measurement, psf, regularisation, boundary="circular")
    assert (regularisation < 1).all()
    residual = measurement - fourier.convolve(estimate, psf, circular=True)
    power = residual.var((-2, -1), correction=0, keepdim=True)  # the mean is left out
    contrast = measurement.var((-2, -1), correction=0, keepdim=True)
    torch.testing.assert_close(power, noise_level(measurement) ** 2 + tolerance**2 * contrast, rtol=1e-3, atol=0)


@pytest.mark.parametrize("full_well", [500, 5000, 50000])
def test_chosen_lambda_is_better_than_one_far_from_it(full_well, psf, scene, generator):
    b = Camera(psf, sensor=Sensor(full_well=float(full_well))).simulate(scene, generator=generator)
    best = chosen(b, psf).mean().item()
    chosen_psnr = psnr(Wiener()(b, psf), scene)
    assert chosen_psnr > psnr(Wiener(regularisation=best / 100)(b, psf), scene) + 0.5
    assert chosen_psnr > psnr(Wiener(regularisation=best * 100)(b, psf), scene) + 0.5


def test_solver_is_eq_2_with_the_chosen_lambda(psf, scene, generator):
    b = Camera(psf).simulate(scene, generator=generator)
    expected = fourier.wiener(b, psf, chosen(b, psf)).clamp(min=0)
    torch.testing.assert_close(Wiener()(b, psf), expected)
    expected = fourier.wiener(b, psf, 1e-3, boundary="replicate").clamp(min=0)
    torch.testing.assert_close(Wiener(regularisation=1e-3, boundary="replicate")(b, psf), expected)


@pytest.mark.parametrize("factor", [0.01, 100.0])
def test_scale_of_measurement_and_psf(psf, scene, factor, generator):
    b = Camera(psf).simulate(scene, generator=generator)
    torch.testing.assert_close(Wiener()(factor * b, psf), factor * Wiener()(b, psf), rtol=1e-3, atol=1e-4 * factor)
    torch.testing.assert_close(Wiener()(b, factor * psf), Wiener()(b, psf), rtol=1e-3, atol=1e-4)


def test_batch_is_one_by_one(psf, scene, generator):
    b = Camera(psf).simulate(torch.cat([scene, scene.flip(-1) / 8]), generator=generator)
    torch.testing.assert_close(Wiener()(b, psf)[1:], Wiener()(b[1:], psf), rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize(
    "measurement", [torch.zeros(1, 3, 9, 12), torch.full((1, 1, 9, 12), 0.3), torch.ones(1, 1, 1, 1)]
)
def test_constant_measurements_stay_finite(measurement):
    psf = torch.zeros(1, 1, *measurement.shape[-2:])
    psf[..., measurement.shape[-2] // 2, measurement.shape[-1] // 2] = 1
    result = Wiener()(measurement, psf)
    assert result.isfinite().all()
    assert result.max() <= 1.01 * measurement.max()


@pytest.mark.usefixtures("unchecked")
def test_psf_of_other_channels_is_refused():
    with pytest.raises(ShapeError, match=r"`psf` .* has 3 channels and `measurement` .* has 1"):
        Wiener()(torch.rand(1, 1, 8, 8), torch.rand(1, 3, 8, 8))


@pytest.mark.parametrize("options", [{"regularisation": 0.0}, {"regularisation": -1.0}, {"tolerance": 0.0}])
def test_constants_are_positive(options):
    with pytest.raises(ParameterError, match=rf"`{next(iter(options))}` .* must be positive"):
        Wiener(**options)

"""Convolution, its adjoint and Wiener deconvolution against closed forms, scipy, numpy and scikit-image."""

import itertools
import re
from typing import get_args

import numpy as np
import pytest
import torch
from scipy.signal import convolve2d, fftconvolve
from skimage import restoration

import oracles
from mwdn import fourier
from mwdn.errors import MwdnError, ParameterError, ShapeError
from mwdn.fourier.fast_filter import Padding, whole_spectrum
from mwdn.fourier.filtering import reference_filter
from mwdn.fourier.memory_format import as_channels, as_complex

BOUNDARIES = get_args(fourier.Boundary)

# (scene, PSF, sensor): one pixel, odd, even, prime, not square; PSF and sensor smaller and larger than scene.
SIZES = [
    ((1, 1), (1, 1), None),
    ((1, 1), (4, 3), None),
    ((5, 7), (1, 1), None),
    ((8, 8), (8, 8), None),
    ((9, 9), (9, 9), None),
    ((9, 6), (4, 5), None),
    ((6, 9), (5, 4), None),
    ((7, 11), (3, 3), None),
    ((6, 5), (13, 10), None),
    ((5, 6), (10, 13), None),
    ((17, 23), (12, 31), None),
    ((1, 16), (16, 1), None),
    ((32, 48), (32, 48), None),
    ((20, 30), (12, 15), (12, 15)),
    ((21, 31), (13, 16), (12, 15)),
    ((12, 15), (12, 15), (20, 31)),
    ((13, 10), (6, 7), (31, 3)),
    ((13, 9), (6, 7), (1, 1)),
    ((1, 16), (16, 1), (4, 5)),
    ((40, 7), (3, 3), (2, 41)),
]


def fits(scene, psf, sensor):
    """Whether the PSF is no longer than a circular grid."""
    return all(p <= max(s, o) for s, p, o in zip(scene, psf, sensor or scene, strict=True))


FITS = [sizes for sizes in SIZES if fits(*sizes)]


def close(ours, expected, tolerance=2e-6):
    """Equal up to ``tolerance`` of the largest value, which is what float32 transforms can promise."""
    ours, expected = np.asarray(ours, float), np.asarray(expected, float)
    assert ours.shape == expected.shape
    assert abs(ours - expected).max() <= tolerance * max(abs(expected).max(), 1e-30)


def noise(shape, generator):
    return torch.randn(shape, generator=generator)


def point(size, row, column):
    picture = torch.zeros(1, 1, *size)
    picture[..., row, column] = 1
    return picture


def dot(a, b):
    return (a.double() * b.double()).sum().item()


def test_a_convolution_refuses_images_of_another_size():
    """A larger scene was cropped at its top left corner without a word."""
    camera = fourier.Convolution.from_psf(torch.ones(1, 1, 3, 3), (6, 7), (4, 5))
    assert camera.adjoint(camera.forward(torch.ones(1, 1, 6, 7))).shape == (1, 1, 6, 7)
    for apply, name in ((camera.forward, "scene"), (camera.adjoint, "measurement")):
        with pytest.raises(ShapeError, match=f"`{name}`"):
            apply(torch.ones(1, 1, 20, 20))


def test_fast_length_is_the_next_even_smooth_number():
    for length in range(1, 700):
        assert fourier.fast_length(length) == oracles.smooth_even(length)
    assert fourier.fast_length(0) == 2  # it never returned


@pytest.mark.parametrize("grid", [(1, 2), (6, 10), (7, 9), (12, 5)])
def test_spectrum_is_numpys(grid, generator):
    picture = noise((2, 3, min(5, grid[0]), min(4, grid[1])), generator)
    expected = np.fft.rfft2(picture.double().numpy(), s=grid)
    result = fourier.spectrum(picture, grid)
    assert result.dtype == torch.complex64
    assert abs(result.numpy() - expected).max() < 1e-5
    close(fourier.inverse_spectrum(result, grid, picture.shape[-2:]), picture)


@pytest.mark.parametrize("grid", [(40, 46), (41, 45)])
def test_gaussian_transfer_blurs_a_point_to_a_gaussian(grid):
    result = fourier.inverse_spectrum(fourier.gaussian_transfer(grid, 2.5)[None, None], grid, grid)[0, 0]
    y, x = (torch.minimum(torch.arange(n), n - torch.arange(n)) for n in grid)
    expected = torch.exp(-(y[:, None].square() + x.square()) / (2 * 2.5**2)) / (2 * torch.pi * 2.5**2)
    torch.testing.assert_close(result, expected, rtol=0, atol=1e-7)


@pytest.mark.parametrize(("scene", "psf", "size"), SIZES)
def test_convolve_is_the_sum_over_points(scene, psf, size, generator):
    v, h = noise((1, 1, *scene), generator), noise((1, 1, *psf), generator)
    result = fourier.convolve(v, h, size=size)
    close(result[0, 0], oracles.convolve(v[0, 0], h[0, 0], size))


def test_grid_is_long_enough_for_every_small_combination(generator):
    """One row, lengths 1 to 7: on a grid one pixel too short, a wrapped end lands on the sensor."""
    for scene, psf, sensor in itertools.product(range(1, 8), repeat=3):
        v, h = noise((1, 1, 1, scene), generator), noise((1, 1, 1, psf), generator)
        expected = oracles.convolve(v[0, 0], h[0, 0], (1, sensor))
        result = fourier.convolve(v, h, size=(1, sensor))[0, 0].double().numpy()
        assert abs(result - expected).max() < 1e-5, (scene, psf, sensor)


@pytest.mark.parametrize(("scene", "psf", "size"), FITS)
def test_circular_convolve_wraps_what_leaves(scene, psf, size, generator):
    v, h = noise((1, 1, *scene), generator), noise((1, 1, *psf), generator)
    result = fourier.convolve(v, h, size=size, circular=True)
    close(result[0, 0], oracles.convolve(v[0, 0], h[0, 0], size, circular=True))


@pytest.mark.parametrize("size", [(5, 5), (8, 8), (7, 10)])
def test_odd_psfs_agree_with_scipys_same_mode(size, generator):
    """For odd PSFs alone scipy's "same" mode is unambiguous."""
    v, h = noise((1, 1, *size), generator), noise((1, 1, 3, 5), generator)
    expected = convolve2d(v[0, 0].double(), h[0, 0].double(), mode="same")
    close(fourier.convolve(v, h)[0, 0], expected)
    wrapped = convolve2d(v[0, 0].double(), h[0, 0].double(), mode="same", boundary="wrap")
    close(fourier.convolve(v, h, circular=True)[0, 0], wrapped)


def test_convolve_at_the_papers_size_agrees_with_fftconvolve(generator):
    v, h = torch.rand(1, 1, 320, 320, generator=generator), torch.rand(1, 1, 320, 320, generator=generator)
    full = fftconvolve(v[0, 0].double(), h[0, 0].double())
    close(fourier.convolve(v, h)[0, 0], full[160:480, 160:480])


@pytest.mark.parametrize("circular", [False, True])
@pytest.mark.parametrize("psf", [(1, 1), (3, 3), (4, 4), (4, 7), (8, 11)])
@pytest.mark.parametrize("scene", [(8, 11), (9, 12), (13, 17)])
def test_delta_at_the_centre_is_the_identity(scene, psf, circular, generator):
    v = noise((2, 3, *scene), generator)
    delta = point(psf, psf[0] // 2, psf[1] // 2)
    close(fourier.convolve(v, delta, circular=circular), v)
    close(fourier.correlate(v, delta, circular=circular), v)


@pytest.mark.parametrize("psf", [(9, 9), (10, 12), (11, 14)])
def test_delta_below_and_right_moves_the_scene_down_and_right(psf, generator):
    v = noise((1, 1, 11, 14), generator)
    delta = point(psf, psf[0] // 2 + 2, psf[1] // 2 + 3)
    moved = fourier.convolve(v, delta)
    close(moved[..., 2:, 3:], v[..., :-2, :-3])
    assert moved[..., :2, :].abs().max() < 1e-5
    assert moved[..., :, :3].abs().max() < 1e-5
    close(fourier.convolve(v, delta, circular=True), v.roll((2, 3), (-2, -1)))


@pytest.mark.parametrize("sensor", [(4, 4), (5, 6), (12, 3), (1, 1), (20, 21)])
@pytest.mark.parametrize("scene", [(12, 13), (13, 12)])
def test_sensor_faces_the_centre_of_the_scene(scene, sensor):
    """A point at the scene's centre lands on the sensor's centre, whatever the two sizes are."""
    v = point(scene, scene[0] // 2, scene[1] // 2)
    result = fourier.convolve(v, point((3, 4), 1, 2), size=sensor)
    close(result, point(sensor, sensor[0] // 2, sensor[1] // 2), 1e-5)


@pytest.mark.parametrize("circular", [False, True])
@pytest.mark.parametrize(("scene", "psf", "size"), FITS)
def test_correlate_is_the_adjoint(scene, psf, size, circular, generator):
    v, h = noise((2, 3, *scene), generator), noise((1, 3, *psf), generator)
    y = noise((2, 3, *(size or scene)), generator)
    Av = fourier.convolve(v, h, size=size, circular=circular)
    Ay = fourier.correlate(y, h, size=scene, circular=circular)
    assert Ay.shape == v.shape
    assert abs(dot(Av, y) - dot(v, Ay)) <= 1e-5 * (Av.norm() * y.norm()).item()


@pytest.mark.parametrize(("scene", "psf", "size"), [s for s in SIZES if s not in FITS])
def test_correlate_is_the_adjoint_of_psfs_larger_than_the_scene(scene, psf, size, generator):
    v, h = noise((2, 3, *scene), generator), noise((1, 3, *psf), generator)
    y = noise((2, 3, *(size or scene)), generator)
    Av, Ay = fourier.convolve(v, h, size=size), fourier.correlate(y, h, size=scene)
    assert abs(dot(Av, y) - dot(v, Ay)) <= 1e-5 * (Av.norm() * y.norm()).item()


@pytest.mark.parametrize("psf", [(5, 5), (6, 4), (9, 8)])
def test_energy_of_a_scene_away_from_the_border_is_conserved(psf, generator):
    v = torch.zeros(1, 2, 25, 26)
    v[..., 8:17, 8:17] = torch.rand(1, 2, 9, 9, generator=generator)
    h = torch.rand(1, 1, *psf, generator=generator)
    b = fourier.convolve(v, h / h.sum())
    torch.testing.assert_close(b.sum((-2, -1)), v.sum((-2, -1)), rtol=1e-5, atol=0)
    everything = fourier.convolve(torch.rand(1, 1, 9, 9, generator=generator), h / h.sum(), circular=True)
    assert everything.min() > 0


def test_linear_convolution_loses_at_the_border_what_circular_keeps():
    v, h = torch.ones(1, 1, 12, 15), torch.ones(1, 1, 5, 5) / 25
    close(fourier.convolve(v, h, circular=True), v)
    corner, edge = fourier.convolve(v, h)[0, 0, 0, :1], fourier.convolve(v, h)[0, 0, 0, 7:8]
    close(corner, [9 / 25], 1e-5)
    close(edge, [15 / 25], 1e-5)


def test_convolve_is_linear_in_scene_and_psf(generator):
    v, w = noise((2, 1, 2, 9, 10), generator)
    h, g = noise((2, 1, 2, 7, 7), generator)
    A = fourier.convolve
    close(A(2 * v - 3 * w, h), 2 * A(v, h) - 3 * A(w, h), 1e-5)
    close(A(v, 2 * h - 3 * g), 2 * A(v, h) - 3 * A(v, g), 1e-5)


@pytest.mark.parametrize("operation", [fourier.convolve, fourier.correlate])
@pytest.mark.parametrize("batch", [1, 2])
@pytest.mark.parametrize("channels", [1, 3])
def test_psf_broadcasts_over_batch_and_channels(operation, batch, channels, generator):
    v, h = noise((2, 3, 8, 9), generator), noise((batch, channels, 5, 6), generator)
    result = operation(v, h)
    for b in range(2):
        for c in range(3):
            kernel = h[b % batch, c % channels][None, None]
            close(result[b, c], operation(v[b, c][None, None], kernel)[0, 0], 1e-5)


@pytest.mark.parametrize("batch", [1, 2])
@pytest.mark.parametrize("channels", [1, 3])
def test_wiener_broadcasts_over_batch_and_channels(batch, channels, generator):
    b, h = noise((2, 3, 8, 9), generator), noise((batch, channels, 5, 6), generator)
    k = torch.rand(2, 3, 1, 1, generator=generator) + 0.1
    result = fourier.wiener(b, h, k)
    for i in range(2):
        for c in range(3):
            kernel = h[i % batch, c % channels].double()
            close(result[i, c], oracles.wiener(b[i, c], kernel, k[i, c].item()), 1e-5)


OPERATIONS = {
    "convolve": fourier.convolve,
    "correlate": fourier.correlate,
    "wiener": lambda b, h: fourier.wiener(b, h, 0.1),
}


@pytest.mark.parametrize("name", OPERATIONS)
def test_autocast_changes_nothing(name, generator):
    b, h = noise((1, 2, 11, 13), generator), noise((1, 2, 6, 7), generator)
    expected = OPERATIONS[name](b, h)
    with torch.autocast("cpu", torch.bfloat16):
        result = OPERATIONS[name](b, h)
    assert result.dtype == torch.float32
    assert torch.equal(result, expected)


@pytest.mark.parametrize("dtype", [torch.float64, torch.bfloat16, torch.float16])
@pytest.mark.parametrize("name", OPERATIONS)
def test_other_precisions_are_computed_in_float32(name, dtype, generator):
    b, h = noise((1, 2, 11, 13), generator).to(dtype), noise((1, 2, 6, 7), generator).to(dtype)
    result = OPERATIONS[name](b, h)
    assert result.dtype == torch.float32
    assert torch.equal(result, OPERATIONS[name](b.float(), h.float()))


@pytest.mark.parametrize("circular", [False, True])
def test_gradients_of_convolve_are_those_of_the_bilinear_map(circular, generator):
    """Linear in each argument, so the derivative along a direction is the map of that direction."""
    v = noise((1, 1, 4, 5), generator).requires_grad_()
    h = noise((1, 1, 3, 4), generator).requires_grad_()
    y = noise((1, 1, 6, 7), generator)
    (fourier.convolve(v, h, size=(6, 7), circular=circular) * y).sum().backward()
    for variable in (v, h):
        expected = np.zeros(variable.shape[-2:])
        for index in np.ndindex(*expected.shape):
            unit = np.zeros(expected.shape)
            unit[index] = 1
            scene, psf = (unit, h[0, 0].detach()) if variable is v else (v[0, 0].detach(), unit)
            image = oracles.convolve(scene, np.asarray(psf), (6, 7), circular=circular)
            expected[index] = (image * y[0, 0].numpy()).sum()
        close(variable.grad[0, 0], expected, 1e-5)


@pytest.mark.parametrize("boundary", BOUNDARIES)
def test_gradients_of_wiener_are_finite_differences(boundary, generator):
    b = noise((1, 1, 4, 5), generator).requires_grad_()
    h = torch.rand(1, 1, 3, 4, generator=generator).requires_grad_()
    k = torch.tensor(0.3, requires_grad=True)
    y = noise((1, 1, 4, 5), generator)
    (fourier.wiener(b, h, k, boundary=boundary) * y).sum().backward()
    values = [t.detach().double().reshape(t.shape[-2:]).numpy() for t in (b, h, k)]
    for which, variable in enumerate((b, h, k)):
        expected = np.zeros(variable.shape[-2:])
        for index in np.ndindex(*expected.shape):
            step = np.zeros(expected.shape)
            step[index] = 1e-5
            up, down = ([x + sign * step if i == which else x for i, x in enumerate(values)] for sign in (1, -1))
            change = oracles.wiener(*up, boundary) - oracles.wiener(*down, boundary)
            expected[index] = (change * y[0, 0].numpy()).sum() / 2e-5
        close(variable.grad.reshape(expected.shape), expected, 1e-4)


@pytest.mark.parametrize("size", [(1, 1), (8, 8), (7, 13), (31, 20)])
def test_noise_free_wiener_inverts(size, generator):
    """A dominant centre keeps |H| >= 0.5: the error is lambda / (|H|^2 + lambda) <= 4e-6."""
    v = torch.rand(2, 3, *size, generator=generator)
    h = torch.rand(1, 3, *size, generator=generator)
    h = 0.25 * h / h.sum((-2, -1), keepdim=True)
    h[..., size[0] // 2, size[1] // 2] += 0.75
    b = fourier.convolve(v, h, circular=True)
    close(fourier.wiener(b, h, 1e-6, boundary="circular"), v, 2e-5)


@pytest.mark.parametrize("boundary", BOUNDARIES)
@pytest.mark.parametrize(
    ("size", "psf"),
    [
        ((1, 1), (1, 1)),
        ((6, 6), (6, 6)),
        ((7, 9), (3, 4)),
        ((13, 8), (13, 8)),
        ((5, 31), (4, 17)),
        ((2, 3), (1, 2)),
    ],
)
def test_wiener_is_equation_2(size, psf, boundary, generator):
    b, h = noise((1, 1, *size), generator), noise((1, 1, *psf), generator)
    result = fourier.wiener(b, h, 0.05, boundary=boundary)
    close(result[0, 0], oracles.wiener(b[0, 0], h[0, 0], 0.05, boundary), 2e-5)


@pytest.mark.parametrize("size", [(8, 8), (9, 12), (15, 7)])
@pytest.mark.parametrize("psf", [(3, 5), (4, 4), (7, 6)])
def test_wiener_is_scikit_images_with_a_flat_prior(size, psf, generator):
    """scikit-image multiplies lambda with |D|^2 of a Laplacian; with D a delta both formulas coincide."""
    b, h = noise((1, 1, *size), generator), noise((1, 1, *psf), generator)
    theirs = restoration.wiener(
        b[0, 0].double().numpy(), h[0, 0].double().numpy(), 0.02, reg=np.ones((1, 1)), clip=False
    )
    close(fourier.wiener(b, h, 0.02, boundary="circular")[0, 0], theirs, 1e-5)


def test_more_regularisation_dims_the_estimate(generator):
    b, h = torch.rand(1, 1, 16, 16, generator=generator), torch.rand(1, 1, 16, 16, generator=generator)
    energies = [fourier.wiener(b, h / h.sum(), k).norm().item() for k in (1e-4, 1e-3, 1e-2, 1e-1, 1.0)]
    assert energies == sorted(energies, reverse=True)


def test_weight_in_the_psf_is_the_papers_w(generator):
    """w conj(H) B / (|w H|^2 + lambda), with w = 3, is 1/3 of the filter without w at lambda / 9."""
    b, h = noise((1, 1, 9, 8), generator), noise((1, 1, 9, 8), generator)
    close(fourier.wiener(b, 3 * h, 0.9), fourier.wiener(b, h, 0.1) / 3, 1e-5)


@pytest.mark.parametrize("boundary", BOUNDARIES)
@pytest.mark.parametrize("size", [(1, 1), (1, 9), (2, 2), (17, 6), (33, 47)])
def test_every_boundary_keeps_the_size(size, boundary, generator):
    b, h = torch.rand(2, 3, *size, generator=generator), torch.rand(1, 1, *size, generator=generator)
    result = fourier.wiener(b, h, 1e-3, boundary=boundary)
    assert result.shape == b.shape
    assert result.isfinite().all()


@pytest.mark.parametrize("boundary", ["replicate", "circular"])
@pytest.mark.parametrize(("size", "psf"), [((12, 15), (12, 15)), ((9, 7), (5, 4)), ((1, 1), (1, 1))])
def test_constant_measurement_gives_a_constant_over_the_sum_of_the_psf(size, psf, boundary, generator):
    """Only frequency zero is there, so V = S B / (S^2 + lambda) exactly."""
    h = torch.rand(1, 1, *psf, generator=generator)
    S = h.sum().item()
    result = fourier.wiener(torch.full((1, 1, *size), 0.7), h, 1e-4, boundary=boundary)
    close(result, np.full((1, 1, *size), 0.7 * S / (S**2 + 1e-4)), 2e-5)


@pytest.mark.parametrize("boundary", ["zero", "replicate", "taper"])
@pytest.mark.parametrize(
    ("size", "grid"),
    [((5, 6), (8, 10)), ((5, 6), (7, 9)), ((5, 5), (6, 5)), ((4, 3), (5, 4)), ((1, 1), (2, 6))],
)
def test_pad_is_numpys_edge_padding(size, grid, boundary, generator):
    picture = noise((2, 3, *size), generator)
    result = fourier.pad(picture, grid, boundary)
    assert torch.equal(result[..., : size[0], : size[1]], picture)
    for b in range(2):
        for c in range(3):
            close(result[b, c], oracles.pad(picture[b, c].double().numpy(), grid, boundary), 1e-6)


@pytest.mark.parametrize("boundary", ["replicate", "taper"])
@pytest.mark.parametrize("size", [(40, 60), (41, 59)])
def test_padded_image_is_continuous_at_both_borders(size, boundary):
    """A smooth image has no step on the periodic grid much larger than the steps inside it."""
    rows, columns = torch.linspace(0, 1, size[0])[:, None], torch.linspace(0, 1, size[1])
    picture = (0.2 + 0.5 * rows + 0.3 * columns)[None, None]
    grid = fourier.deconvolution_grid(size, boundary)
    wide = fourier.pad(picture, grid, boundary)[0, 0]
    height, width = size
    # The taper falls by at most pi/2 / (padding / 2) a pixel, and by the square of that next to the border.
    near = {"replicate": 0.0, "taper": 0.05}[boundary]
    assert (wide[height, :width] - wide[height - 1, :width]).abs().max() <= near
    assert (wide[-1, :width] - wide[0, :width]).abs().max() <= near
    assert (wide[:height, width] - wide[:height, width - 1]).abs().max() <= near
    assert (wide[:height, -1] - wide[:height, 0]).abs().max() <= near
    if boundary == "taper":
        steps = torch.stack([(wide - wide.roll(1, 0)).abs().max(), (wide - wide.roll(1, 1)).abs().max()])
        assert steps.max() < 0.25
        assert wide.min() < 0.02


def letter_f(size=32):
    scene = torch.zeros(1, 1, size, size)
    scene[..., 7:25, 9:12] = 1
    scene[..., 7:10, 9:22] = 1
    scene[..., 14:17, 9:19] = 1
    return scene


TURNS = [(turns, flip) for turns in range(4) for flip in (False, True)]


def turned(picture, turns, flip):
    picture = np.rot90(picture, turns)
    return np.fliplr(picture) if flip else picture


@pytest.mark.parametrize("boundary", BOUNDARIES)
def test_letter_is_restored_upright_and_in_place(boundary, generator):
    """Correlated with all eight turned and mirrored letters at all shifts, the upright one unmoved wins."""
    scene = letter_f()
    h = torch.rand(1, 1, 32, 32, generator=generator) ** 8
    b = fourier.convolve(scene, h / h.sum(), circular=boundary == "circular")
    result = fourier.wiener(b, h / h.sum(), 1e-3, boundary=boundary)[0, 0].double().numpy()
    result = result - result.mean()
    best = {}
    for turn in TURNS:
        letter = turned(scene[0, 0].double().numpy(), *turn)
        letter = letter - letter.mean()
        score = np.fft.ifft2(np.fft.fft2(result) * np.fft.fft2(letter).conj()).real
        best[turn] = score.max(), np.unravel_index(score.argmax(), score.shape)
    winner = max(best, key=lambda turn: best[turn][0])
    assert winner == (0, False)
    assert best[winner][1] == (0, 0)
    runner_up = max(score for turn, (score, _) in best.items() if turn != winner)
    assert best[winner][0] > 1.1 * runner_up


@pytest.mark.parametrize("operation", OPERATIONS.values(), ids=OPERATIONS)
@pytest.mark.parametrize(
    ("psf", "message"),
    [
        ((3, 1, 5, 5), r"`psf` \(3, 1, 5, 5\) has 3 samples"),
        ((1, 2, 5, 5), "has 2 channels"),
        ((3, 5, 5), r"`psf\[None\]`"),
    ],
)
@pytest.mark.usefixtures("unchecked")
def test_psf_that_does_not_fit_is_refused(operation, psf, message):
    with pytest.raises(ShapeError, match=message) as caught:
        operation(torch.ones(2, 3, 8, 8), torch.ones(psf))
    assert len(psf) == 3 or "(2, 3, 8, 8)" in str(caught.value)
    assert isinstance(caught.value, MwdnError)
    assert isinstance(caught.value, ValueError)


@pytest.mark.parametrize("operation", OPERATIONS.values(), ids=OPERATIONS)
@pytest.mark.usefixtures("unchecked")
def test_image_without_batch_is_refused(operation):
    with pytest.raises(ShapeError, match=r"\(3, 8, 8\) .*\[None\]`"):
        operation(torch.ones(3, 8, 8), torch.ones(1, 1, 5, 5))


@pytest.mark.parametrize("operation", [fourier.convolve, fourier.correlate])
@pytest.mark.parametrize("size", [(0, 3), (3, -2)])
def test_result_without_pixels_is_refused(operation, size):
    with pytest.raises(ShapeError, match=re.escape(f"`size` {size}")):
        operation(torch.ones(1, 1, 4, 4), torch.ones(1, 1, 4, 4), size=size)


@pytest.mark.parametrize("operation", OPERATIONS.values(), ids=OPERATIONS)
@pytest.mark.parametrize("empty", [(0, 1, 4, 4), (1, 1, 0, 4)])
def test_what_is_empty_is_refused(operation, empty):
    whole = torch.ones(1, 1, 4, 4)
    for image, psf in ((torch.ones(empty), whole), (whole, torch.ones(empty))):
        with pytest.raises(ShapeError, match=re.escape(str(empty))):
            operation(image, psf)


def test_psf_larger_than_the_grid_is_refused():
    message = r"`psf` \(9 x 4\) must not be larger than the grid \(8 x 8\)"
    with pytest.raises(ShapeError, match=message):
        fourier.convolve(torch.ones(1, 1, 8, 8), torch.ones(1, 1, 9, 4), circular=True)
    with pytest.raises(ShapeError, match=message):
        fourier.wiener(torch.ones(1, 1, 8, 8), torch.ones(1, 1, 9, 4), 0.1, boundary="circular")


@pytest.mark.parametrize("value", [0.0, -1e-3, float("nan")])
def test_regularisation_must_be_positive(value):
    with pytest.raises(ParameterError, match=r"`regularisation` \(.*\).* must be (positive|finite)"):
        fourier.wiener(torch.ones(1, 1, 8, 8), torch.ones(1, 1, 8, 8), value)


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize("shape", [(3,), (7,), (2, 3), (2, 3, 1, 7), (5, 1, 1), (1, 1, 1, 1, 1, 2)])
def test_regularisation_for_other_axes_is_refused(shape):
    """A half spectrum of 12 columns has 7: one number a column would be another filter."""
    b = torch.rand(2, 3, 8, 8)
    with pytest.raises(ShapeError, match=re.escape(f"`regularisation` {shape} must broadcast")):
        fourier.wiener(b, b[:1], torch.full(shape, 0.1))
    for fits in ((), (1,), (3, 1, 1), (2, 1, 1, 1), (2, 3, 1, 1)):
        torch.testing.assert_close(fourier.wiener(b, b[:1], torch.full(fits, 0.1)), fourier.wiener(b, b[:1], 0.1))


def test_wiener_under_the_transforms_of_torch_func(generator):
    """`vmap`, `jacrev` and `jvp`: Wiener is linear in the measurement."""
    b, h = torch.rand(2, 4, 6, 7, generator=generator), torch.rand(1, 1, 6, 7, generator=generator)

    def wiener(measurement):
        return fourier.wiener(measurement[None], h, 0.1)[0]

    expected = fourier.wiener(b, h, 0.1)
    torch.testing.assert_close(torch.func.vmap(wiener)(b), expected)
    slopes = torch.func.vmap(torch.func.grad(lambda x: wiener(x).square().sum()))(b)
    x = b.clone().requires_grad_()
    fourier.wiener(x, h, 0.1).square().sum().backward()
    torch.testing.assert_close(slopes, x.grad)
    jacobian = torch.func.jacrev(wiener)(b[0])
    torch.testing.assert_close(torch.einsum("cijdkl,dkl->cij", jacobian, b[1]), expected[1], rtol=1e-4, atol=1e-5)


@pytest.mark.usefixtures("unchecked")
def test_unknown_boundary_is_refused():
    with pytest.raises(ParameterError, match="No boundary named 'mirror'"):
        fourier.wiener(torch.ones(1, 1, 8, 8), torch.ones(1, 1, 8, 8), 0.1, boundary="mirror")


@pytest.mark.parametrize("boundary", ["circular", "zero", "replicate", "taper"])
@pytest.mark.parametrize(
    ("psf_batch", "psf_channels", "channels"),
    [(1, 1, 3), (1, 3, 3), (2, 1, 3), (2, 3, 3), (1, 1, 4), (2, 1, 4), (2, 4, 4)],
)
@pytest.mark.parametrize("width", [25, 26])
def test_fast_filter_and_its_gradients_are_the_references(
    boundary, psf_batch, psf_channels, channels, width, generator
):
    """Values and both gradients, in pairs (an even number of channels) and plane by plane."""
    grid = fourier.deconvolution_grid((21, width), boundary)
    image = torch.rand(2, channels, 21, width, generator=generator)
    psf = torch.rand(psf_batch, psf_channels, 21, width, generator=generator)
    slope = torch.randn(image.shape, generator=generator)
    results = []
    for function in (reference_filter, fourier.filter_image):
        x, h = image.clone().requires_grad_(), psf.clone().requires_grad_()
        y = function(x, fourier.wiener_transfer(h, 0.1, grid), grid, boundary)
        y.backward(slope)
        results.append((y, x.grad, h.grad))
    for expected, result in zip(*results, strict=True):
        torch.testing.assert_close(result, expected, rtol=1e-4, atol=1e-5 * expected.abs().max().item())


@pytest.mark.parametrize("boundary", BOUNDARIES)
@pytest.mark.parametrize(("size", "grid"), [((5, 6), (8, 10)), ((5, 6), (7, 9)), ((5, 5), (6, 5)), ((1, 1), (2, 6))])
def test_fast_padding_is_pad_and_has_its_adjoint(size, grid, boundary, generator):
    grid = size if boundary == "circular" else grid
    image = noise((2, 4, *size), generator)
    padding = Padding(size, grid, boundary, image)
    padded = fourier.pad(image, grid, boundary)
    torch.testing.assert_close(padding(image), padded)
    torch.testing.assert_close(as_channels(torch.view_as_real(padding(as_complex(image))), padded), padded)
    y = noise((2, 4, *grid), generator)
    assert dot(padded, y) == pytest.approx(dot(image, padding.adjoint(y.clone())), rel=1e-5, abs=1e-5)


@pytest.mark.parametrize("width", [6, 7])
def test_whole_spectrum_is_numpys(width, generator):
    image = noise((1, 2, 5, width), generator)
    whole = whole_spectrum(fourier.spectrum(image, (5, width)), width)
    close(torch.view_as_real(whole), torch.view_as_real(torch.from_numpy(np.fft.fft2(image.double().numpy()))))


@pytest.mark.parametrize(("psf_batch", "psf_channels"), [(1, 1), (1, 4), (3, 1), (3, 4)])
def test_chunks_of_several_samples_as_on_a_gpu(psf_batch, psf_channels, generator, monkeypatch):
    """A GPU filters as many samples together as fit into a gigabyte, a CPU one."""
    grid = fourier.deconvolution_grid((21, 25), "taper")
    image = torch.rand(3, 4, 21, 25, generator=generator)
    psf = torch.rand(psf_batch, psf_channels, 21, 25, generator=generator)
    slope = torch.randn(image.shape, generator=generator)
    results = []
    for parts in (None, [(slice(0, 2), slice(0, 4)), (slice(2, 4), slice(0, 4))]):
        if parts:
            monkeypatch.setattr("mwdn.fourier.fast_filter.chunks", lambda *_, parts=parts: parts)
        x, h = image.clone().requires_grad_(), psf.clone().requires_grad_()
        y = fourier.filter_image(x, fourier.wiener_transfer(h, 0.1, grid), grid, "taper")
        y.backward(slope)
        results.append((y, x.grad, h.grad))
    for expected, result in zip(*results, strict=True):
        torch.testing.assert_close(result, expected, rtol=1e-4, atol=1e-5 * expected.abs().max().item())


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_filter_keeps_precision_and_memory_format(dtype, generator):
    grid = fourier.deconvolution_grid((30, 33), "taper")
    transfer = fourier.wiener_transfer(torch.rand(1, 1, 30, 33, generator=generator), 0.1, grid)
    image = torch.rand(2, 6, 30, 33, generator=generator).to(dtype)
    expected = fourier.filter_image(image.float(), transfer, grid, "taper").to(dtype)
    last = image.contiguous(memory_format=torch.channels_last)
    part = torch.cat([last, last], dim=1)[:, 6:]  # the gradient of a concatenation has this layout
    for x, form in ((image, torch.contiguous_format), (last, torch.channels_last), (part, torch.channels_last)):
        result = fourier.filter_image(x, transfer, grid, "taper")
        assert result.dtype == dtype
        assert torch.equal(result, expected)
        if x is not part:
            assert result.is_contiguous(memory_format=form)

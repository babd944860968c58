"""ADMM and FISTA against textbook equations in numpy, scipy's solvers, scikit-image, and each other."""

import math

import numpy as np
import pytest
import torch
from scipy.optimize import nnls
from skimage.restoration import denoise_tv_chambolle

import oracles
from mwdn import fourier
from mwdn.errors import ParameterError, ShapeError, UnknownNameError
from mwdn.optics import unit_sum
from mwdn.solvers import TEXTBOOK, Admm, Penalties, build, proximal, splitting
from mwdn.solvers.fista import Fista
from mwdn.solvers.pyramid import Pyramid
from mwdn.solvers.wiener import Wiener

# (sensor, PSF)
SIZES = [
    ((6, 7), (5, 5)),
    ((9, 12), (9, 12)),
    ((16, 16), (5, 4)),
    ((5, 4), (8, 11)),
    ((1, 1), (1, 1)),
    ((13, 1), (2, 3)),
]
VARIATIONS = ["anisotropic", "isotropic", "colour"]
USUAL, BRISK = TEXTBOOK, Penalties(data=0.1, gradient=0.05, sign=0.1)


def pair(sensor, psf, generator, *, channels=3, psf_channels=3, batch=1):
    """A noise-like measurement and a PSF with a few strong points, whose spectrum has no deep zero."""
    b = torch.rand(batch, channels, *sensor, generator=generator)
    return b, unit_sum(torch.rand(1, psf_channels, *psf, generator=generator) ** 4)


def capture(generator, *, noise=0.0, size=(24, 30)):
    """A letter-like scene and its measurement through a random caustic."""
    scene = torch.full((1, 3, *size), 0.05)
    scene[..., 6:18, 8:11] = torch.tensor([0.9, 0.6, 0.3])[:, None, None]
    scene[..., 6:9, 8:20] = torch.tensor([0.2, 0.8, 0.5])[:, None, None]
    h = unit_sum(torch.rand(1, 3, *size, generator=generator) ** 12)
    b = fourier.convolve(scene, h)
    return scene, b + noise * torch.randn(b.shape, generator=generator), h


# --- Gradient and proximal maps -----------------------------------------------------------------------


@pytest.mark.parametrize("size", [(1, 1), (1, 5), (2, 2), (7, 4), (13, 13)])
def test_divergence_is_the_adjoint_of_the_gradient(size, generator):
    v, y, x = torch.randn(3, 2, 3, *size, generator=generator, dtype=torch.float64)
    down, along = proximal.gradient(v)
    inner = (down * y).sum() + (along * x).sum()
    expected = (v * proximal.divergence((y, x))).sum()
    torch.testing.assert_close(inner, expected, rtol=1e-12, atol=1e-12)


def test_gradient_goes_down_the_rows_and_along_the_columns():
    v = torch.arange(12.0).reshape(1, 1, 3, 4)
    down, along = proximal.gradient(v)
    assert (down[..., :-1, :] == 4).all()
    assert (down[..., -1, :] == -8).all()
    assert (along[..., :-1] == 1).all()
    assert (along[..., -1] == -3).all()


def test_laplacian_of_the_problem_is_divergence_of_gradient(generator):
    problem = splitting.Problem.from_psf(*pair((6, 9), (5, 4), generator))
    v = torch.randn(1, 3, *problem.grid, generator=generator)
    product = fourier.spectrum(v, problem.grid) * problem.laplacian
    result = fourier.inverse_spectrum(product, problem.grid, problem.grid)
    torch.testing.assert_close(result, proximal.divergence(proximal.gradient(v)), rtol=0, atol=1e-5)


def shrunk(u, threshold, variation):
    """The proximal map of total variation."""
    return tuple(g - p for g, p in zip(u, proximal.dual_projection(u, threshold, variation), strict=True))


@pytest.mark.parametrize("threshold", [0.0, 0.3, 1.5])
def test_shrink_solves_its_minimisation(threshold):
    """argmin 1/2 (u - g)^2 + t |u| over a grid of 1e-3."""
    g = np.linspace(-2, 2, 41)
    u = np.linspace(-2.5, 2.5, 5001)
    best = u[(0.5 * (u - g[:, None]) ** 2 + threshold * abs(u)).argmin(1)]
    given = torch.from_numpy(g).reshape(1, 1, 1, -1)
    for part in shrunk((given, -given), threshold, "anisotropic"):
        result = part.flatten().numpy()
        assert abs(abs(result) - abs(best)).max() <= 1e-3
        assert abs(result * np.sign(part.numpy().flatten())).min() >= 0
    assert (shrunk((given, given), threshold, "anisotropic")[0].flatten().numpy() * g >= 0).all()


@pytest.mark.parametrize("threshold", [0.3, 1.2])
def test_shrink_isotropic_solves_its_minimisation(threshold, generator):
    """argmin 1/2 |u - g|^2 + t |u| for vectors, over a plane grid of 1e-2."""
    axis = np.linspace(-2, 2, 401)
    first, second = np.meshgrid(axis, axis, indexing="ij")
    gs = 3 * torch.rand(20, 2, generator=generator, dtype=torch.float64) - 1.5
    for g in gs:
        cost = 0.5 * ((first - g[0].item()) ** 2 + (second - g[1].item()) ** 2)
        best = np.unravel_index((cost + threshold * np.hypot(first, second)).argmin(), cost.shape)
        result = shrunk((g[0].reshape(1, 1, 1, 1), g[1].reshape(1, 1, 1, 1)), threshold, "isotropic")
        assert abs(result[0].item() - axis[best[0]]) <= 0.011
        assert abs(result[1].item() - axis[best[1]]) <= 0.011


@pytest.mark.parametrize("variation", VARIATIONS)
@pytest.mark.parametrize("threshold", [2.0, 0.1, 1e-6, 1e-12])
def test_gradients_at_zero_are_finite(variation, threshold):
    """The first iteration of every unrolled network starts there; a root of zero would turn training NaN."""
    u = (torch.zeros(1, 1, 3, 3, requires_grad=True), torch.zeros(1, 1, 3, 3, requires_grad=True))
    t = torch.tensor(threshold, requires_grad=True)
    result = shrunk(u, t, variation)
    (result[0].sum() + 2 * result[1].sum()).backward()
    assert result[0].abs().max() == 0
    for variable in (*u, t):
        assert variable.grad.isfinite().all()


# --- ADMM ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("variation", VARIATIONS)
@pytest.mark.parametrize("mu", [USUAL, BRISK, Penalties(1e-2, 1e-1, 1e-3)])
@pytest.mark.parametrize(("sensor", "psf"), SIZES)
def test_five_iterations_are_the_textbooks(sensor, psf, mu, variation, generator):
    """The copies live on the sensor here and on the whole grid in the textbook; the scenes agree."""
    for tau, psf_channels in ((1e-3, 3), (0.0, 1)):
        b, h = pair(sensor, psf, generator, psf_channels=psf_channels)
        solver = Admm(regularisation=tau, penalties=mu, iterations=5, variation=variation)
        grid = splitting.Problem.from_psf(b, h).grid
        v = oracles.admm(
            b[0].double().numpy(),
            h[0].double().numpy(),
            grid,
            mu=mu,
            tau=tau,
            iterations=5,
            variation=variation,
        )
        scale = (b.double().norm() / h.double().norm()).item()
        expected = scale * np.maximum(v[:, : sensor[0], : sensor[1]], 0)
        result = solver(b, h)[0].double().numpy()
        assert abs(result - expected).max() <= 1e-4 * abs(expected).max()


def objective(problem, v, psf, tau=0.0, variation="isotropic"):
    """Value of the minimised function for a batch of one, by numpy."""
    b, h = (x[0].double().numpy() for x in (problem.measurement, psf))
    return oracles.objective(v[0].double().numpy(), b, h, tau=tau, variation=variation)


@pytest.mark.parametrize("variation", VARIATIONS)
def test_objective_falls(variation, generator):
    _, b, h = capture(generator, noise=1e-3)
    values = []
    for iterations in (1, 60):
        solver = Admm(iterations=iterations, penalties=BRISK, variation=variation, regularisation=1e-4)
        _, (problem, state) = solver.solve(b, h)
        values.append(objective(problem, state.v, h / h.norm(), 1e-4, variation))
    # The zero scene has 1/2: the measurement is at unit norm.
    assert values[0] < 0.5
    assert values[1] < 0.01
    assert values[1] < 0.1 * values[0]


NNLS_SIZES = [((6, 7), (5, 5)), ((5, 6), (4, 7)), ((4, 5), (8, 6)), ((7, 7), (1, 1))]


def nnls_problem(sensor, psf, generator):
    """Light cannot fit the noise below zero: the least misfit is not zero, and Hv is unique."""
    h = unit_sum(torch.rand(1, 1, *psf, generator=generator) ** 3 + 0.01)
    b = torch.randn(1, 1, *sensor, generator=generator) + 0.3
    A = oracles.matrix(h[0, 0].double().numpy(), sensor)
    x, misfit = nnls(A, b[0, 0].double().numpy().ravel(), maxiter=10_000)
    return b, h, 0.5 * misfit**2, (A @ x).reshape(sensor)


@pytest.mark.parametrize(("sensor", "psf"), NNLS_SIZES)
def test_fista_reaches_the_least_squares_of_scipy(sensor, psf, generator):
    b, h, least, _ = nnls_problem(sensor, psf, generator)
    values = []
    for iterations in (1, 10, 100, 1000):
        last = Fista(iterations=iterations).solve(b, h)[1]
        values.append(objective(last.problem, last.v, h))
    assert math.isclose(values[-1], least, rel_tol=1e-3)
    assert min(values) > (1 - 1e-5) * least


@pytest.mark.parametrize("relaxation", [1.0, 1.7])
@pytest.mark.parametrize(("sensor", "psf"), NNLS_SIZES)
def test_admm_without_prior_reaches_the_least_squares_of_scipy(sensor, psf, relaxation, generator):
    b, h, least, seen = nnls_problem(sensor, psf, generator)
    problem = splitting.Problem.from_psf(b / b.norm(), h / h.norm())
    state, mu = splitting.initial_state(problem), Penalties(data=0.1, gradient=1e-3, sign=0.1)
    filters = splitting.make_filters(problem, mu)
    for _ in range(600):
        state = splitting.update_copies(state, problem, mu, 0.0, "anisotropic", relaxation)
        state = splitting.update_scene(state, problem, filters)
    value = objective(problem, state.v, h / h.norm()) * b.square().sum().item()
    assert math.isclose(value, least, rel_tol=2e-3)
    Hv = state.Hv[0, 0].double().numpy() * b.norm().item()
    assert abs(Hv - seen).max() <= 0.03 * b.abs().max().item()
    assert state.v.min() > -1e-3


def test_over_relaxation_saves_iterations(generator):
    """Against 500 iterations without: after 60 with alpha = 1.7 much less distance is left."""
    scene, h = torch.rand(1, 3, 24, 28, generator=generator), unit_sum(torch.rand(1, 3, 24, 28, generator=generator))
    problem = splitting.Problem.from_psf(fourier.convolve(scene, h), h / h.norm())
    mu = Penalties(0.05, 1.0, 0.2)
    filters = splitting.make_filters(problem, mu)

    def solution(iterations, relaxation=1.0):
        state = splitting.initial_state(problem)
        for _ in range(iterations):
            state = splitting.update_copies(state, problem, mu, 1e-3, "colour", relaxation)
            state = splitting.update_scene(state, problem, filters)
        return state.v

    least = solution(500)
    assert torch.dist(solution(60, 1.7), least) < 0.7 * torch.dist(solution(60), least)
    assert torch.dist(solution(500, 1.7), least) < 0.01 * least.norm()


def test_both_solvers_find_the_same_scene_where_it_is_unique(generator):
    """Of a well-conditioned PSF and a scene that lies within the sensor."""
    scene = torch.zeros(1, 3, 16, 18)
    scene[..., 5:11, 5:13] = torch.rand(1, 3, 6, 8, generator=generator)
    h = 0.3 * torch.rand(1, 3, 5, 5, generator=generator) / 25
    h[..., 2, 2] = 1
    h = unit_sum(h)
    b = fourier.convolve(scene, h)
    by_fista = Fista(iterations=300)(b, h)
    by_admm = Admm(regularisation=0.0, penalties=Penalties(0.5, 1e-3, 0.1), iterations=300)(b, h)
    torch.testing.assert_close(by_fista, scene, rtol=0, atol=2e-3)
    torch.testing.assert_close(by_admm, scene, rtol=0, atol=2e-3)


@pytest.mark.parametrize("weight", [0.1, 0.2])
def test_tv_with_a_delta_psf_is_scikit_images_denoising(weight, generator):
    """Both minimise 1/2 |v - b|^2 + weight TV(v), ours with b / |b|, hence weight = tau |b|.

    Compared away from the border, where ours also sees the opposite one. Chambolle's scheme has come within a
    few thousandths of the minimum; the noise that both take away reaches 0.3.
    """
    clean = torch.full((1, 1, 30, 34), 0.2)
    clean[..., 8:22, 6:16] = 0.9
    clean[..., 12:25, 19:28] = 0.5
    b = clean + 0.08 * torch.randn(clean.shape, generator=generator)
    delta = torch.zeros(1, 1, 3, 3)
    delta[..., 1, 1] = 1
    tau = weight / b.norm().item()
    solver = Admm(regularisation=tau, penalties=Penalties(0.1, 0.1, 0.1), iterations=200, variation="isotropic")
    result = solver(b, delta)[0, 0].numpy()
    expected = denoise_tv_chambolle(b[0, 0].double().numpy(), weight=weight, eps=1e-9, max_num_iter=2000)
    inside = abs(result - expected)[4:-4, 4:-4]
    assert inside.max() < 0.015
    assert inside.mean() < 0.003
    assert abs(b[0, 0].numpy() - expected).max() > 0.15


@pytest.mark.parametrize("psf", [(1, 1), (3, 3), (4, 6)])
@pytest.mark.parametrize(
    "solver",
    [Fista(iterations=3), Admm(regularisation=0.0, penalties=Penalties(1.0, 1e-3, 1.0), iterations=200)],
    ids=["fista", "admm"],
)
def test_delta_psf_without_prior_clips_the_sign_and_no_more(solver, psf, generator):
    b = torch.randn(2, 3, 7, 8, generator=generator)
    delta = torch.zeros(1, 1, *psf)
    delta[..., psf[0] // 2, psf[1] // 2] = 4
    torch.testing.assert_close(solver(b, delta), b.clamp(min=0), rtol=0, atol=1e-3)


def test_reconstruction_is_upright_and_in_place(generator):
    scene, b, h = capture(generator, noise=1e-4)
    for solver in (Admm(penalties=BRISK, regularisation=1e-5), Fista(iterations=300)):
        result = solver(b, h)
        error = (result - scene).norm() / scene.norm()
        assert error < 0.3
        for axes in ((-1,), (-2,), (-2, -1)):
            assert (result.flip(axes) - scene).norm() > 2 * (result - scene).norm()


def test_more_regularisation_is_flatter(generator):
    _, b, h = capture(generator, noise=3e-3)
    variations = []
    for tau in (1e-6, 1e-4, 1e-2):
        down, along = proximal.gradient(Admm(tau, BRISK, 60)(b, h))
        variations.append((down[..., :-1, :].abs().sum() + along[..., :-1].abs().sum()).item())
    assert variations == sorted(variations, reverse=True)
    assert variations[-1] < 0.5 * variations[0]


# --- Every solver -------------------------------------------------------------------------------------

SOLVERS = {
    "admm": Admm(iterations=15),
    "brisk": Admm(regularisation=1e-3, penalties=BRISK, iterations=15),
    "isotropic": Admm(regularisation=1e-3, penalties=BRISK, iterations=15, variation="isotropic"),
    "fista": Fista(iterations=15),
    "pyramid": Pyramid(),
    "wiener": Wiener(regularisation=1e-2),
}


@pytest.fixture(params=SOLVERS)
def solver(request):
    return SOLVERS[request.param]


@pytest.mark.parametrize(("channels", "psf_channels"), [(1, 1), (3, 1), (3, 3)])
@pytest.mark.parametrize(
    ("sensor", "psf"), [((9, 13), (9, 13)), ((11, 6), (4, 9)), ((1, 1), (1, 1)), ((17, 1), (2, 2))]
)
def test_shape_sign_and_finiteness(solver, sensor, psf, channels, psf_channels, generator):
    b, h = pair(sensor, psf, generator, channels=channels, psf_channels=psf_channels, batch=2)
    result = solver(b - 0.3, h)
    assert result.shape == b.shape
    assert result.dtype == torch.float32
    assert result.isfinite().all()
    assert result.min() >= 0


@pytest.mark.parametrize("factor", [1e-3, 4095.0])
def test_scene_scales_with_the_measurement_and_not_with_the_psf(solver, factor, generator):
    _, b, h = capture(generator)
    result = solver(b, h)
    torch.testing.assert_close(solver(factor * b, h) / factor, result, rtol=1e-3, atol=1e-4)
    torch.testing.assert_close(solver(b, factor * h), result, rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize("dtype", [torch.float16, torch.float64])
def test_scene_is_float32_in_every_precision(solver, dtype, generator):
    """The sum of the measurement's squares, 7e5, is beyond float16."""
    _, b, h = capture(generator)
    b = (100 * b).half()
    result = solver(b.to(dtype), h.to(dtype))
    assert result.dtype == torch.float32
    expected = solver(b.float(), h)
    assert (result - expected).norm() < 1e-2 * expected.norm()
    torch.testing.assert_close(solver(b.to(dtype), h), expected)


@pytest.mark.parametrize("psf_batch", [1, 3])
def test_batch_is_one_by_one(solver, psf_batch, generator):
    b = torch.rand(3, 2, 9, 12, generator=generator) * torch.tensor([1.0, 0.01, 5.0])[:, None, None, None]
    h = torch.rand(psf_batch, 2, 9, 12, generator=generator) ** 4
    together = solver(b, h)
    for i in range(3):
        alone = solver(b[i : i + 1], h[i % psf_batch][None])
        torch.testing.assert_close(together[i : i + 1], alone, rtol=1e-3, atol=1e-4 * alone.max().item())


def test_grey_psf_is_the_same_psf_for_each_colour_of_fista(generator):
    b, h = pair((9, 12), (9, 12), generator, psf_channels=1)
    torch.testing.assert_close(Fista(20)(b, h), Fista(20)(b, h.repeat(1, 3, 1, 1)), rtol=1e-4, atol=1e-4)


def test_darkness_gives_darkness(solver):
    result = solver(torch.zeros(1, 3, 9, 12), torch.rand(1, 1, 9, 12))
    assert (result == 0).all()


def test_dark_sample_does_not_spoil_its_neighbour(solver, generator):
    b, h = pair((9, 12), (9, 12), generator, batch=2)
    b[0] = 0
    result = solver(b, h)
    assert (result[0] == 0).all()
    torch.testing.assert_close(result[1:], solver(b[1:], h), rtol=1e-3, atol=1e-4)


def test_inputs_are_left_as_they_were(solver, generator):
    b, h = pair((9, 12), (9, 12), generator)
    before = b.clone(), h.clone()
    solver(b, h)
    assert torch.equal(b, before[0])
    assert torch.equal(h, before[1])


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize("psf", [(2, 3, 5, 5), (1, 2, 5, 5), (4, 1, 5, 5)])
@pytest.mark.parametrize("batch", [1, 3])
def test_psf_that_does_not_fit_is_refused(solver, psf, batch):
    with pytest.raises(ShapeError, match="`psf`"):
        solver(torch.ones(batch, 3, 8, 8), torch.ones(psf))


@pytest.mark.parametrize(
    "options",
    [
        {"regularisation": -1e-4},
        {"regularisation": math.nan},
        {"iterations": 0},
        {"penalties": Penalties(data=0.0)},
        {"penalties": Penalties(gradient=-1.0)},
        {"penalties": Penalties(sign=math.nan)},
    ],
)
def test_impossible_constants_are_refused(options):
    with pytest.raises(ParameterError, match=f"`{next(iter(options))}`"):
        Admm(**options)


@pytest.mark.usefixtures("unchecked")
def test_unknown_variation_is_refused():
    with pytest.raises(UnknownNameError, match=r"'tv'.* anisotropic, colour, isotropic"):
        Admm(variation="tv")


def test_name_in_capitals_gets_the_nearest_name():
    with pytest.raises(UnknownNameError, match="Did you mean 'admm'"):
        build("ADMM")


@pytest.mark.parametrize("name", ["admm", "fista", "pyramid", "wiener"])
@pytest.mark.usefixtures("unchecked")
def test_picture_without_batch_is_refused(name):
    picture = torch.rand(3, 16, 16)
    with pytest.raises(ShapeError, match=r"`measurement\[None\]`"):
        build(name)(picture, picture[None])
    with pytest.raises(ShapeError, match=r"`psf\[None\]`"):
        build(name)(picture[None], picture)


def test_fista_needs_one_iteration():
    with pytest.raises(ParameterError, match=r"`iterations` \(0\) must be at least 1"):
        Fista(iterations=0)


def test_unknown_option_is_refused():
    with pytest.raises(UnknownNameError, match=r"No option of the solver 'admm' named 'itterations'\. Did you mean"):
        build("admm", itterations=3)

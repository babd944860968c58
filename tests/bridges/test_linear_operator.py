"""A camera as scipy's `LinearOperator`, against sums over points, scipy's solvers and closed forms of our own."""

import sys

import numpy as np
import pytest
import torch
from scipy.optimize import minimize
from scipy.sparse.linalg import aslinearoperator, lsqr

import oracles
from mwdn import Camera, wiener
from mwdn.bridges import linear_operator
from mwdn.errors import MissingPackageError, ParameterError, ShapeError
from mwdn.fourier.transforms import inverse_spectrum, spectrum
from mwdn.optics import Aberration, FieldCamera, field_psfs, unit_sum
from mwdn.solvers import Fista

SENSOR, SCENE, PSF = (9, 12), (13, 11), (5, 6)


@pytest.fixture
def psf(generator):
    """Three different channels of a few strong points."""
    return unit_sum(torch.rand(1, 3, *PSF, generator=generator) ** 4)


def test_a_product_is_the_convolution_as_a_sum_over_points(psf, generator):
    operator = linear_operator(Camera(psf, size=SENSOR), scene_size=SCENE)
    scenes = torch.rand(2, 3, *SCENE, generator=generator).numpy()
    expected = [[oracles.convolve(v, h, SENSOR) for v, h in zip(s, psf[0].numpy(), strict=True)] for s in scenes]
    assert operator.shape == (3 * 9 * 12, 3 * 13 * 11)
    np.testing.assert_allclose(operator @ scenes[0].ravel(), np.ravel(expected[0]), atol=1e-6)
    columns = operator @ scenes.reshape(2, -1).T
    np.testing.assert_allclose(columns, np.reshape(expected, (2, -1)).T, atol=1e-6)


@pytest.mark.parametrize("channels", [1, 3])
def test_the_adjoint_passes_the_dot_product_test(channels, psf, generator):
    operator = linear_operator(Camera(psf[:, :1], size=SENSOR), scene_size=SCENE, channels=channels)
    x, y = (torch.randn(n, generator=generator, dtype=torch.float64).numpy() for n in operator.shape[::-1])
    assert y @ (operator @ x) == pytest.approx((operator.H @ y) @ x, rel=1e-5)


def test_a_camera_whose_psf_changes_over_the_field(psf, generator):
    psfs = field_psfs(psf, (2, 2), Aberration(scale=0.1, vignetting=0.3))
    operator = linear_operator(FieldCamera.from_psfs(psfs, SCENE, size=SENSOR))
    x, y = (torch.randn(n, generator=generator, dtype=torch.float64).numpy() for n in operator.shape[::-1])
    assert y @ (operator @ x) == pytest.approx((operator.H @ y) @ x, rel=1e-5)


def test_lsqr_finds_the_wiener_estimate(psf, generator):
    """Eq. (2) minimises ``|h * v - b|^2 + lambda |v|^2`` for scenes that repeat themselves.

    One period on the sensor, seen through the operator: a matrix that repeats the period three times, then the camera.
    """
    h, regularisation = psf[:, :1], 1e-2
    size, wide = (8, 10), (24, 30)
    b = torch.rand(1, 1, *size, generator=generator)
    repeat = np.tile(np.eye(80).reshape(*size, 80), (3, 3, 1)).reshape(-1, 80)
    operator = linear_operator(Camera(h, size=size), scene_size=wide) @ aslinearoperator(repeat.astype(np.float32))
    found = lsqr(operator, b.numpy().ravel(), damp=regularisation**0.5, atol=1e-7, btol=1e-7)[0]
    expected = wiener(b, h, regularisation, boundary="circular")
    np.testing.assert_allclose(found, expected.numpy().ravel(), atol=1e-5)


def test_scipys_bounded_least_squares_agree_with_fista(psf, generator):
    """``1/2 |crop(h * v) - b|^2`` over ``v >= 0``: L-BFGS-B with the operator's adjoint reaches FISTA's minimum."""
    h, size = psf[:, :1], (6, 7)
    b = torch.rand(1, 1, *size, generator=generator)
    operator = linear_operator(Camera(h, size=size), scene_size=(10, 13))  # each point that reaches the sensor

    def objective(v):
        residual = operator @ v - b.numpy().ravel()
        return 0.5 * float(residual @ residual), (operator.H @ residual).astype(float)

    bounds = [(0, None)] * operator.shape[1]
    found = minimize(objective, np.zeros(operator.shape[1]), jac=True, bounds=bounds, method="L-BFGS-B")
    problem, v, *_ = Fista(iterations=500).solve(b, h)[1]
    seen = inverse_spectrum(problem.transfer * spectrum(v, problem.grid), problem.grid, size)
    assert found.fun == pytest.approx(0.5 * float((seen - b).square().sum()), rel=0.02)  # after 500 steps of FISTA
    assert found.fun < 0.1 * objective(np.zeros(operator.shape[1]))[0]


def test_what_is_no_operator_is_refused(psf):
    with pytest.raises(ShapeError, match="2 PSFs"):
        linear_operator(Camera(psf.expand(2, -1, -1, -1)))
    with pytest.raises(ShapeError, match=r"`channels` \(2\)"):
        linear_operator(Camera(psf), channels=2)
    for wrong in ({"channels": 0}, {"scene_size": (0, 4)}):
        with pytest.raises(ShapeError, match="must be positive"):
            linear_operator(Camera(psf[:, :1]), **wrong)
    with pytest.raises(ShapeError, match=r"\(1, 2\)"):
        linear_operator(FieldCamera(psf, torch.ones(1, 1, *SCENE)), scene_size=(1, 2))
    with pytest.raises(ParameterError, match="complex64"):
        linear_operator(Camera(psf)) @ np.ones(90, np.complex64)


def test_a_missing_library_is_named_with_its_extra(psf, monkeypatch):
    monkeypatch.setitem(sys.modules, "scipy.sparse.linalg", None)
    with pytest.raises(MissingPackageError, match=r"scipy.*mwdn\[scipy\]"):
        linear_operator(Camera(psf))

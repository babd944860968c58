"""Warm starts: each frame of a stream begins at the last iterate of the one before."""

import pytest
import torch
from torch.nn import functional as F

from cameras import contour_psf
from mwdn import Camera
from mwdn.errors import ParameterError, ShapeError
from mwdn.solvers import Admm, Fista, WarmStart

SIZE = 40, 48
FRAMES = 8


@pytest.fixture
def psf(generator):
    return contour_psf(SIZE, cell=10, generator=generator).expand(1, 3, -1, -1).contiguous()


@pytest.fixture
def film(psf, generator):
    """Noisy measurements of a blotchy thing that moves to the left by 0.2 pixels a frame."""
    thing = F.interpolate(torch.rand(1, 3, 6, 8, generator=generator), (24, 32), mode="bicubic").clamp(0, 1)
    frames = []
    for number in range(FRAMES):
        part = 0.2 * number - int(0.2 * number)
        moved = (1 - part) * F.pad(thing, (1, 0)) + part * F.pad(thing, (0, 1))
        scene = F.pad(moved, (8 - int(0.2 * number), 7 + int(0.2 * number), 8, 8))
        frames.append(Camera(psf).simulate(scene, generator=generator))
    return frames


def solvers(iterations):
    return [Admm(iterations=iterations), Fista(iterations=iterations)]


def pairs_of(solvers_):
    return pytest.mark.parametrize("solver", solvers_, ids=["admm", "fista"])


@pairs_of(solvers(100))
@pytest.mark.parametrize("k", [5, 10])
def test_warm_iterations_converge_faster_than_as_many_cold_ones(solver, k, psf, film):
    warm, cold = WarmStart(solver, iterations=k), type(solver)(iterations=k)
    first, *_, last = (warm(frame, psf) for frame in film)
    assert torch.equal(first, solver(film[0], psf))
    end = type(solver)(iterations=500)(film[-1], psf)
    assert (last - end).norm() < 0.7 * (cold(film[-1], psf) - end).norm()


@pairs_of(solvers(20))
def test_constant_measurement_gives_one_long_run(solver, psf, film):
    warm = WarmStart(solver, iterations=10)
    for _ in range(5):
        result = warm(film[0], psf)
    assert torch.equal(result, type(solver)(iterations=60)(film[0], psf))


@pairs_of(solvers(100))
def test_another_scene_takes_a_few_frames(solver, psf, film):
    """And then its result is that of a stream of it alone."""
    warm, end = WarmStart(solver), type(solver)(iterations=400)(film[0].flip(-2), psf)
    warm(film[0], psf)
    errors = [(warm(film[0].flip(-2), psf) - end).norm().item() for _ in range(20)]
    assert errors[-1] < 0.3 * errors[0]
    assert errors[-1] < 1.2 * (solver(film[0].flip(-2), psf) - end).norm().item()


def test_admm_follows_an_exposure_at_once(psf, film):
    """The state is kept in units of the measurement."""
    warm, even = WarmStart(Admm(iterations=20)), WarmStart(Admm(iterations=20))
    for number, frame in enumerate(film):
        result, expected = warm(2.0**number * frame, psf), even(frame, psf)
        torch.testing.assert_close(result / 2.0**number, expected, rtol=1e-4, atol=1e-5)


@pairs_of(solvers(10))
def test_another_shape_or_psf_starts_cold(solver, psf, film):
    warm = WarmStart(solver, iterations=2)
    warm(film[0], psf)
    assert torch.equal(warm(film[1][..., :30], psf), solver(film[1][..., :30], psf))  # another shape
    assert torch.equal(warm(film[1][..., :30], psf.clone()), solver(film[1][..., :30], psf))  # another PSF
    both = torch.cat(film[:2])
    torch.testing.assert_close(warm(both, psf), solver(both, psf))


@pairs_of(solvers(10))
@pytest.mark.parametrize("bad", [torch.nan, torch.inf])
def test_frame_after_one_that_is_not_finite_starts_cold(solver, bad, psf, film):
    warm, after = WarmStart(solver, iterations=2), WarmStart(solver, iterations=2)
    warm(film[0], psf)
    broken = film[1].clone()
    broken[..., 5, 7] = bad
    assert not warm(broken, psf).isfinite().all()
    for frame in film[2:4]:
        assert torch.equal(warm(frame, psf), after(frame, psf))


@pairs_of(solvers(10))
def test_the_frame_after_a_dark_one_starts_cold(solver, psf, film, generator):
    """The noise of a dark frame, as bright as a scene in the solver's units, took more than 40 frames to go."""
    warm = WarmStart(solver, iterations=2)
    warm(film[0], psf)
    warm(1e-3 * torch.randn(film[0].shape, generator=generator), psf)
    assert torch.equal(warm(film[1], psf), solver(film[1], psf))
    assert not torch.equal(warm(film[2], psf), solver(film[2], psf))


@pairs_of(solvers(10))
def test_streams_of_a_batch_are_one_by_one(solver, psf, film):
    together, alone = WarmStart(solver), WarmStart(solver)
    for one, two in zip(film[:3], film[3:6], strict=True):
        result = together(torch.cat([one, two]), psf)
        torch.testing.assert_close(result[:1], alone(one, psf), rtol=1e-3, atol=1e-4)


def test_zero_iterations_are_refused():
    with pytest.raises(ParameterError, match=r"`iterations` \(0\) must be at least 1"):
        WarmStart(Admm(), iterations=0)


@pytest.mark.usefixtures("unchecked")
def test_what_is_no_batch_is_refused_as_by_the_solver(psf, film):
    for solve in (Admm(iterations=1), WarmStart(Admm(iterations=1))):
        with pytest.raises(ShapeError, match="must be"):
            solve(film[0][0], psf)
        with pytest.raises(ParameterError, match="`measurement`"):
            solve(film[0].numpy(), psf)

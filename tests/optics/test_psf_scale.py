"""One rule for every PSF: light, and only its shape counts."""

import pytest
import torch

from mwdn import Calibration, Camera, Reconstructor, align
from mwdn.errors import MwdnError, ParameterError, PsfError
from mwdn.evaluation import consistency
from mwdn.inference.engine import Engine
from mwdn.networks import build
from mwdn.optics import unit_sum
from mwdn.optics.psf import SUM_TOLERANCE, checked_psf
from mwdn.solvers import SOLVERS

SIZE = (16, 20)
MEASUREMENT = torch.rand(1, 3, *SIZE, generator=torch.Generator().manual_seed(1))

TAKERS = {
    "Calibration": lambda psf: Calibration(psf).psf,
    "Camera": lambda psf: Camera(psf)(MEASUREMENT),
    "Engine": lambda psf: Engine(build("wiener"), psf)(MEASUREMENT),
    "network": lambda psf: build("wiener-bank", width=2).eval()(MEASUREMENT, psf).detach(),
    "Reconstructor": lambda psf: Reconstructor("wiener", Calibration(psf), device="cpu")(MEASUREMENT),
    "align": lambda psf: align(MEASUREMENT, psf).turn_degrees,
    "consistency": lambda psf: torch.tensor(consistency(MEASUREMENT, psf, MEASUREMENT).explained),
    **{name: lambda psf, solver=solver: solver()(MEASUREMENT, psf) for name, solver in SOLVERS.items()},
}


@pytest.fixture
def psf(generator):
    return unit_sum(torch.rand(1, 3, *SIZE, generator=generator) ** 6)


@pytest.mark.parametrize("name", TAKERS)
def test_scale_of_a_psf_never_matters(name, psf):
    """Nor that of each colour: both depend on the exposure of the point source."""
    torch.manual_seed(0)
    expected = TAKERS[name](psf)
    torch.manual_seed(0)
    result = TAKERS[name](psf * torch.tensor([1000.0, 0.01, 3.0])[:, None, None])
    torch.testing.assert_close(result, expected, rtol=1e-3, atol=1e-4)


def test_gradient_of_a_psf_of_unit_sum_is_that_of_its_shape(psf):
    """Only the shape counts, so the gradient along the PSF itself is 0; the division was left out at a sum of 1."""
    for factor in (1.0, 2.0):
        scaled = (factor * psf).requires_grad_()
        (Camera(scaled)(MEASUREMENT) * MEASUREMENT).sum().backward()
        along = (scaled.grad * scaled).sum((-2, -1))
        assert along.abs().max() < 1e-4 * (scaled.grad * scaled).abs().sum()


def without_light(psf):
    dark = psf.clone()
    dark[:, 1] = 0
    return dark


BAD = {
    "NaN": lambda psf: torch.where(psf == psf.max(), torch.nan, psf),
    "infinity": lambda psf: torch.where(psf == psf.max(), torch.inf, psf),
    "negative": lambda psf: psf - psf.max() / 100,
    "dark": without_light,
}


@pytest.mark.parametrize("bad", BAD)
@pytest.mark.parametrize("name", TAKERS)
def test_what_is_no_light_is_refused(name, bad, psf):
    with pytest.raises(PsfError, match="`psf`"):
        TAKERS[name](BAD[bad](psf))


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize("name", TAKERS)
def test_integers_and_arrays_are_refused(name, psf):
    for other in ((psf * 1e6).int(), psf.numpy(), psf[0, 0].numpy(), psf.bool(), psf.cfloat(), None):
        with pytest.raises(ParameterError, match="`psf`"):
            TAKERS[name](other)
    for axes in (psf[0], psf[0, 0], psf[None]):
        with pytest.raises(MwdnError, match="`psf`"):
            TAKERS[name](axes)


def test_psf_of_unit_sum_is_unchanged(psf):
    assert torch.equal(checked_psf(psf), psf)
    nearly = psf * (1 + SUM_TOLERANCE / 2)
    assert torch.equal(checked_psf(nearly), nearly)


def test_sums_of_half_precision_do_not_overflow():
    """65,536 pixels of 1 exceed the largest float16."""
    total = checked_psf(torch.ones(1, 1, 256, 256, dtype=torch.float16)).sum()
    torch.testing.assert_close(total, torch.tensor(1.0))

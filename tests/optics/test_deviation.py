"""Cameras that differ from their calibration."""

import pytest
import torch

from cameras import contour_psf
from mwdn.errors import ParameterError
from mwdn.fourier.convolution import convolve
from mwdn.optics import Camera, Deviation

SIZE = 40, 48


def point(size, row, column, channels=3):
    psf = torch.zeros(1, channels, *size)
    psf[..., row, column] = 1
    return psf


def test_none_is_the_calibrated_camera(generator):
    psf = contour_psf(SIZE, cell=10, generator=generator)
    scene = torch.rand(2, 3, *SIZE, generator=generator)
    camera = Deviation().camera(psf)
    assert camera.rank == 1
    torch.testing.assert_close(camera.forward(scene), Camera(psf).forward(scene), rtol=1e-4, atol=1e-5)


def test_shift_is_down_and_right():
    """A delta moved by two pixels."""
    camera = Deviation(shift_px=2.0).camera(point(SIZE, 20, 24))
    torch.testing.assert_close(camera.psf_at(20, 24), point(SIZE, 22, 26), rtol=0, atol=1e-4)


def test_turn_is_clockwise():
    """A quarter turn moves a point 5 pixels to the right of the centre to 5 pixels below it. Row 0 is at the top."""
    camera = Deviation(turn_degrees=90.0).camera(point(SIZE, 20, 29))
    torch.testing.assert_close(camera.psf_at(0, 0), point(SIZE, 25, 24), rtol=0, atol=1e-4)


def test_scale_moves_points_outwards():
    camera = Deviation(scale=0.25).camera(point(SIZE, 20, 28))
    psf = camera.psf_at(0, 0)[0, 0]
    assert divmod(int(psf.argmax()), SIZE[1]) == (20, 29)
    assert psf.sum() == pytest.approx(1.0, abs=1e-4)


def test_haze_is_even_and_keeps_the_light():
    camera = Deviation(haze=0.25).camera(point(SIZE, 20, 24))
    psf = camera.psf_at(3, 3)[0, 0]
    assert psf.sum() == pytest.approx(1.0, abs=1e-4)
    assert psf[0, 0] == pytest.approx(0.25 / (40 * 48), rel=1e-3)
    assert psf[20, 24] == pytest.approx(0.75 + 0.25 / (40 * 48), rel=1e-3)


def test_off_axis_changes_the_corner_and_not_the_centre(generator):
    psf = contour_psf((41, 49), cell=10, generator=generator)
    camera = Deviation(off_axis=1.0).camera(psf)
    middle, corner = camera.psf_at(20, 24), camera.psf_at(0, 0)
    assert (middle - psf).norm() < 0.05 * psf.norm()
    assert (corner - psf).norm() > 0.2 * psf.norm()
    assert corner.sum() == pytest.approx(0.7 * float(psf.sum()), rel=0.1)  # 30 % are lost at the corner
    # The measurement is not a convolution with a single PSF.
    scene = torch.zeros(1, 3, 41, 49)
    scene[..., 1, 1] = 1
    assert (camera.forward(scene) - convolve(scene, psf)).norm() > 0.2 * convolve(scene, psf).norm()


def test_plus_changes_one_number():
    start = Deviation(turn_degrees=0.5, off_axis=1.0)
    assert start.plus("turn_degrees", 0.25) == Deviation(turn_degrees=0.75, off_axis=1.0)
    with pytest.raises(ParameterError, match="must be one of shift_px"):
        start.plus("turn", 1.0)


@pytest.mark.parametrize(
    "wrong", [{"haze": 1.0}, {"haze": -0.1}, {"scale": -1.0}, {"off_axis": -1.0}, {"off_axis": 4.0}]
)
def test_what_no_camera_can_have(wrong):
    with pytest.raises(ParameterError, match="must"):
        Deviation(**wrong)

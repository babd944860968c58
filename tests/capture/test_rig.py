"""The simulated rig against closed forms: geometry, light, noise, mosaic; what goes wrong on purpose."""

import math
from itertools import pairwise

import numpy as np
import pytest
import torch

from display_geometry import from_picture
from mwdn.capture.patterns import dot_centres, dots, grey, point
from mwdn.capture.rig import EXPOSURE_S, Rig, RigOptions, open_rig
from mwdn.capture.screen import Place, Screen, place_picture, put
from mwdn.errors import CameraError, ParameterError, ShapeError, UnknownNameError

SCREEN = Screen(width_px=240, height_px=135, width_cm=48.0, height_cm=27.0, distance_cm=20.0)
CLEAN = {"full_well": 1e9, "read_noise": 0.0, "bit_depth": 16, "black_level": 0.0, "room_light": 0.0}


def delta(height=96, width=96):
    """A pinhole: the measurement is the display as the camera sees it."""
    psf = torch.zeros(1, 3, height, width)
    psf[..., height // 2, width // 2] = 1
    return psf


def rig(psf=None, screen=SCREEN, **options):
    made = Rig(RigOptions(**{"height": 96, "width": 96, "seed": 3, **options}), screen, psf=psf)
    made.open()
    return made


def white(screen=SCREEN):
    return grey(255, (screen.height_px, screen.width_px))


def test_the_homography_is_that_of_the_frames():
    place = place_picture(SCREEN, (126, 126), 1.0)
    camera = rig(delta(), display_black=0.0, display_gamma=1.0, fill=1.2, **CLEAN)
    camera.show(put(dots((126, 126)), place, SCREEN))
    light = camera.read().array[..., 1].astype(float)
    centres = dot_centres((126, 126))
    whole = camera.homography @ from_picture(place, (126, 126))
    y, x = np.mgrid[:96, :96]
    for column, row in centres:
        u, v, w = whole @ [column, row, 1]
        near = np.hypot(x - u / w, y - v / w) < 4.5
        weight = light[near] / light[near].sum()
        assert (weight * x[near]).sum() == pytest.approx(u / w, abs=0.1)
        assert (weight * y[near]).sum() == pytest.approx(v / w, abs=0.1)


def test_a_frame_is_the_scene_convolved_with_the_true_psf():
    """A point in the middle of the display, on the axis, is the PSF."""
    screen = Screen(width_px=241, height_px=135)
    camera = rig(None, screen, offset_cm=(0.0, 0.0), display_black=0.0, fill=0.6, **CLEAN)
    camera.show(point(screen, 0.2))
    camera.configure(exposure_s=1.0)
    frame = torch.from_numpy(camera.read().array.astype(np.float32)).movedim(-1, 0)[None]
    stacked = torch.stack([frame.flatten(), camera.psf.flatten()])
    assert torch.corrcoef(stacked)[0, 1] > 0.99


def test_light_is_proportional_to_exposure_and_gain_and_saturates():
    camera = rig(white=0.4, **CLEAN | {"full_well": 1e12})  # shot noise of 1e9 electrons would be 2 counts
    camera.show(white())
    frame = camera.read()
    assert frame.array.max() == pytest.approx(0.4 * 65535, abs=2)
    assert (frame.exposure_s, frame.gain, frame.bit_depth, frame.mosaic) == (EXPOSURE_S, 1.0, 16, None)
    camera.configure(2 * EXPOSURE_S)
    assert camera.read().array.max() == pytest.approx(0.8 * 65535, abs=2)
    camera.configure(EXPOSURE_S, gain=2.0)
    assert camera.read().array.max() == pytest.approx(0.8 * 65535, abs=2)
    camera.configure(gain=4.0)
    assert camera.read().array.max() == 65535


def test_a_dark_frame_has_the_black_level_and_the_noise_of_the_sensor():
    camera = rig(room_light=0.0, display_black=0.0, full_well=1000.0, read_noise=5.0, black_level=0.1, bit_depth=12)
    camera.show(grey(0, (135, 240)))
    dark = camera.read().array.astype(float)
    step = 1000 / (4095 * 0.9)  # electrons
    assert dark.mean() == pytest.approx(0.1 * 4095, abs=0.2)
    assert dark.var() == pytest.approx((5 / step) ** 2 + 1 / 12, rel=0.05)


def test_the_display_has_its_gamma_and_its_black():
    camera = rig(display_gamma=2.0, display_black=0.01, **CLEAN)
    means = []
    for level in (0, 51, 255):
        camera.show(grey(level, (135, 240)))
        means.append(camera.read().array.mean())
    assert means[0] / means[2] == pytest.approx(0.01, rel=0.02)
    assert means[1] / means[2] == pytest.approx(0.01 + 0.99 * 0.2**2, rel=0.01)


def test_room_light_does_not_depend_on_the_display():
    camera = rig(**{**CLEAN, "room_light": 0.2}, display_black=0.0)
    camera.show(grey(0, (135, 240)))
    ambient = camera.read().array.mean()
    camera.show(white())
    assert ambient / (camera.read().array.mean() - ambient) == pytest.approx(0.2, rel=0.01)


def test_a_mosaic_passes_one_colour_a_pixel():
    colours = np.zeros((135, 240, 3), np.uint8) + np.array([255, 160, 90], np.uint8)
    plain, filtered = rig(**CLEAN), rig(mosaic="gbrg", **CLEAN)
    for camera in (plain, filtered):
        camera.show(colours)
    cells = filtered.read()
    assert (cells.array.shape, cells.mosaic) == ((192, 192, 1), "gbrg")
    frame = plain.read()
    wanted = frame.format.to_measurement(frame.array)
    assert torch.allclose(cells.format.to_measurement(cells.array), wanted, atol=5e-4)  # photon noise is 3e-5


def test_one_seed_gives_one_camera_and_one_noise():
    first, again, other = rig(hot_pixels=0.01), rig(hot_pixels=0.01), rig(hot_pixels=0.01, seed=4)
    assert torch.equal(first.psf, again.psf)
    assert np.array_equal(first.read().array, again.read().array)
    assert not torch.equal(first.psf, other.psf)


def test_lost_frames_are_counted_and_numbers_skip_them():
    camera = rig(drop=0.3)
    frames = [camera.read() for _ in range(200)]
    assert all(b.number - a.number == b.dropped + 1 for a, b in pairwise(frames))
    dropped = sum(frame.dropped for frame in frames)
    assert dropped == pytest.approx(200 * 0.3 / 0.7, abs=4 * math.sqrt(200 * 0.3 / 0.49))


def test_a_disconnected_camera_says_so_and_can_be_opened_again():
    camera = rig(disconnect_every=2)
    for _ in range(2):
        camera.read()
    with pytest.raises(CameraError, match="disconnected"):
        camera.read()
    with pytest.raises(CameraError, match="not open"):
        camera.read()
    camera.open()
    assert camera.read().number == 0


def test_frames_after_a_change_show_the_old_picture_in_part():
    camera = rig(latency=2, room_light=0.0, display_black=0.0)
    camera.show(white())
    camera.show(grey(0, (135, 240)))
    means = [camera.read().array.mean() for _ in range(3)]
    camera.show(grey(0, (135, 240)))
    assert min(means[:2]) > means[2] + 10


def test_the_exposure_drifts():
    camera = rig(drift=0.05, **CLEAN)
    camera.show(white())
    logarithms = np.log([camera.read().array.mean() for _ in range(100)])
    assert np.diff(logarithms).std() == pytest.approx(0.05, rel=0.3)


def test_frames_pass_while_nobody_reads():
    waits = []
    camera = Rig(RigOptions(height=32, width=32, fps=1e6), SCREEN, wait=waits.append)
    camera.open()
    first, second = camera.read(), camera.read()
    assert second.number - first.number == second.dropped + 1
    assert second.dropped > 0
    slow = Rig(RigOptions(height=32, width=32, fps=1e-3), SCREEN, wait=waits.append)
    slow.open()
    slow.read()
    slow.read()
    assert waits[-1] == pytest.approx(1000, abs=60)


def test_wrong_options_are_named():
    with pytest.raises(UnknownNameError, match="mosaic"):
        RigOptions(mosaic="rgb")
    with pytest.raises(ParameterError, match="drop"):
        RigOptions(drop=1.0)
    with pytest.raises(ParameterError, match="display_black"):  # white would be darker than black
        RigOptions(display_black=1.0)
    with pytest.raises(ShapeError, match="psf"):
        rig(torch.ones(1, 1, 96, 96))
    with pytest.raises(ShapeError, match="display"):
        rig().show(np.zeros((5, 5, 3), np.uint8))
    with pytest.raises(UnknownNameError, match="distance_m"):
        open_rig(distance_m=3)
    with pytest.raises(CameraError, match="exposure_s"):
        rig().configure(exposure_s=-1.0)


def test_place_is_in_pixels_of_the_display():
    assert place_picture(SCREEN, (9, 16), 0.5) == Place(60, 33, 120, 68)

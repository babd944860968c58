"""Geometry of a display against closed forms."""

import math

import numpy as np
import pytest

from display_geometry import from_picture
from mwdn.capture.screen import DisplayPose, Place, Screen, place_picture, project, put
from mwdn.errors import ParameterError

SCREEN = Screen(width_px=96, height_px=54, width_cm=48.0, height_cm=27.0, distance_cm=20.0)
SIZE, FOCAL = (80, 100), 50.0


def at(homography, x, y):
    u, v, w = homography @ [x, y, 1]
    return u / w, v / w


def test_a_display_that_faces_the_camera_is_scaled_by_focal_length_over_distance():
    h = project(SCREEN, DisplayPose(), SIZE, FOCAL)
    middle = (96 - 1) / 2, (54 - 1) / 2
    assert at(h, *middle) == pytest.approx((50, 40))  # pixel (W // 2, H // 2)
    ten_cm = 10 * 2  # 2 pixels per centimetre
    assert at(h, middle[0] + ten_cm, middle[1]) == pytest.approx((50 + FOCAL * 10 / 20, 40))
    assert at(h, middle[0], middle[1] + ten_cm) == pytest.approx((50, 40 + FOCAL * 10 / 20))


def test_a_turn_is_clockwise_and_an_offset_is_right_and_down():
    h = project(SCREEN, DisplayPose(turn_degrees=90.0, offset_cm=(2.0, 1.0)), SIZE, FOCAL)
    middle = (96 - 1) / 2, (54 - 1) / 2
    assert at(h, *middle) == pytest.approx((50 + FOCAL * 2 / 20, 40 + FOCAL * 1 / 20))
    right = at(h, middle[0] + 20, middle[1])  # what lies to the right moves downwards
    assert right == pytest.approx((50 + FOCAL * 2 / 20, 40 + FOCAL * 11 / 20))


def test_a_tilt_brings_one_edge_nearer():
    a, b = math.radians(30), math.radians(20)
    middle = (96 - 1) / 2, (54 - 1) / 2
    down = at(project(SCREEN, DisplayPose(tilt_degrees=(30.0, 0.0)), SIZE, FOCAL), middle[0], middle[1] + 20)
    assert down == pytest.approx((50, 40 + FOCAL * 10 * math.cos(a) / (20 - 10 * math.sin(a))))
    right = at(project(SCREEN, DisplayPose(tilt_degrees=(0.0, 20.0)), SIZE, FOCAL), middle[0] + 20, middle[1])
    assert right == pytest.approx((50 + FOCAL * 10 * math.cos(b) / (20 - 10 * math.sin(b)), 40))


def test_a_picture_keeps_its_proportions_in_centimetres_on_a_display_of_other_pixels():
    stretched = Screen(width_px=192, height_px=54, width_cm=48.0, height_cm=27.0)
    place = place_picture(stretched, (100, 100), 1.0)
    assert (place.height, place.width) == (54, 108)  # 27 cm x 27 cm
    assert (place.left, place.top) == (42, 0)
    with pytest.raises(ParameterError, match="fill"):
        place_picture(SCREEN, (10, 10), 1.5)


def test_a_placed_picture_and_its_matrix_agree():
    place = Place(left=10, top=7, width=30, height=20)
    picture = np.zeros((10, 10, 3), np.uint8)
    picture[3, 6] = 255
    canvas = put(picture, place, SCREEN)
    rows, columns = np.nonzero(canvas[..., 0])
    x, y = at(from_picture(place, (10, 10)), 6, 3)
    assert (columns.mean(), rows.mean()) == pytest.approx((x, y))
    assert canvas.shape == (54, 96, 3)


def test_numbers_of_a_display_are_positive():
    with pytest.raises(ParameterError, match="width_cm"):
        Screen(width_cm=0.0)

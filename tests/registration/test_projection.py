import json

import cv2
import numpy as np
import pytest
from displayed import placed

from mwdn.errors import AlignmentError, ParameterError, ShapeError
from mwdn.registration import Place, Projection, through_corners
from mwdn.registration.point_fit import correct, fit_points

SIZES = {"picture_size": (90, 120), "camera_size": (150, 200)}


@pytest.fixture
def points():
    return np.random.default_rng(0).uniform(0, [119, 89], (40, 2))


def test_without_a_radial_term_it_is_opencvs_homography(points):
    matrix = np.array([[0.9, 0.1, 20], [-0.12, 1.1, 30], [4e-4, -3e-4, 1]])
    projection = Projection.from_homography(matrix, **SIZES)
    expected = cv2.perspectiveTransform(points[:, None], matrix)[:, 0]
    assert projection.to_camera(points) == pytest.approx(expected)
    assert projection.homography == pytest.approx(matrix)


@pytest.mark.parametrize("radial", [0.0, 0.1, -0.08])
def test_there_and_back(points, radial):
    projection = placed(**SIZES, radial=radial, mirrored=True)
    assert projection.to_picture(projection.to_camera(points)) == pytest.approx(points, abs=1e-6)


def test_radial_term_moves_the_corners_by_its_value_and_the_middle_not_at_all():
    straight, bent = (
        Projection((1.0, 0.0, 0.0, 0.0, 0.75, 0.0, 0.0, 0.0, k), **SIZES).to_camera(
            np.array([[59.5, 44.5], [100.0, 20.0]])
        )
        for k in (0.0, 0.1)
    )
    centre = np.array([99.5, 74.5])
    relative = np.linalg.norm(straight[1] - centre) / np.hypot(150, 200) * 2
    assert bent[0] == pytest.approx(centre)
    assert bent[1] - centre == pytest.approx((straight[1] - centre) * (1 + 0.1 * relative**2))


def test_derivative_by_finite_differences(points):
    projection = placed(**SIZES, radial=0.05)
    _, slope = projection.project(points)
    for k in range(9):
        step = 1e-6 * np.eye(9)[k]
        difference = (projection.moved(step).to_camera(points) - projection.moved(-step).to_camera(points)) / 2e-6
        assert slope[..., k] == pytest.approx(difference, rel=1e-4, abs=1e-4)


def test_share_outside_of_the_frame():
    assert placed(**SIZES).outside == 0
    half = np.array([[1, 0, 140.0], [0, 1, 0], [0, 0, 1]])  # columns 140 to 259 of 200
    assert Projection.from_homography(half, **SIZES).outside == pytest.approx(0.5, abs=0.02)


def test_another_resolution_covers_the_same_place():
    projection = placed(**SIZES)
    assert projection.for_picture((180, 240)).corners() == pytest.approx(projection.corners())
    with pytest.raises(ParameterError, match="100 x 120"):
        projection.for_picture((100, 120))


def test_json_keeps_it():
    projection = placed(**SIZES, radial=-0.02)
    content = json.loads(json.dumps(projection.to_dict()))
    assert Projection.from_dict(content).parameters == pytest.approx(projection.parameters)


@pytest.mark.parametrize("mirrored", [False, True])
@pytest.mark.parametrize("radial", [0.0, 0.08])
def test_points_with_outliers_correct_it_and_show_a_radial_term_only_where_there_is_one(points, mirrored, radial):
    truth = placed(**SIZES, mirrored=mirrored, radial=radial)
    generator = np.random.default_rng(1)
    seen = truth.to_camera(points) + generator.normal(0, 0.05, points.shape)
    seen[:6] += 25
    fit = fit_points(points, seen, **SIZES)
    assert fit.inliers.tolist() == [False] * 6 + [True] * 34
    residuals = (seen - fit.projection.to_camera(points))[fit.inliers]
    assert (residuals**2).sum(-1).mean() ** 0.5 < (0.12 if radial == 0 else 1.0)
    off = truth.moved(np.array([0, 0, 0.02, 0, 0, 0, 0, 0, -radial]))
    found = correct(off, points, seen)
    assert found.corners() == pytest.approx(truth.corners(), abs=0.3)
    assert (found.radial != 0) == (radial != 0)


def test_errors_that_neighbours_share_are_no_radial_term():
    """Each column is displaced by its own 0.07 px, each row too, as where reconstructions are biased."""
    truth = placed(**SIZES)
    y, x = np.mgrid[:6, :6]
    points = np.stack([x.ravel() * 22 + 4.5, y.ravel() * 16 + 4.5], -1)
    bent = 0
    for seed in range(30):
        generator = np.random.default_rng(seed)
        shared = [generator.normal(0, 0.07, 6)[axis.ravel()] for axis in (x, y)]
        seen = truth.to_camera(points) + np.stack(shared, -1) + generator.normal(0, 0.05, points.shape)
        bent += correct(truth, points, seen).radial != 0
    assert bent <= 1


def test_points_that_show_nothing_new_correct_nothing(points):
    truth = placed(**SIZES)
    seen = truth.to_camera(points) + np.random.default_rng(2).normal(0, 0.3, points.shape)
    assert correct(truth, points, seen) is truth


def test_four_points_are_exact_and_three_are_refused():
    corners = np.array([[60, 40], [150, 45], [140, 120], [55.0, 110]])
    assert through_corners(corners, **SIZES).corners() == pytest.approx(corners)
    with pytest.raises(AlignmentError, match="3 were found"):
        fit_points(corners[:3], corners[:3], **SIZES)
    with pytest.raises((AlignmentError, ParameterError)):
        through_corners(np.array([[0, 0], [10, 10], [20, 20], [30.0, 30]]), **SIZES)


@pytest.mark.usefixtures("unchecked")
def test_corners_may_be_a_list_and_are_four():
    corners = [[60, 40], [150, 45], [140, 120], [55, 110]]
    assert through_corners(corners, **SIZES).corners() == pytest.approx(np.array(corners, float))
    with pytest.raises(ShapeError, match="four points"):  # OpenCV's error
        through_corners(corners[:3], **SIZES)


@pytest.mark.parametrize(("turn", "mirrored"), [(-1.3, False), (30, False), (-100, True), (170, True)])
def test_place_says_the_turn(turn, mirrored):
    c, s = np.cos(np.deg2rad(turn)), np.sin(np.deg2rad(turn))
    square = np.array([[-20, -10], [20, -10], [20, 10], [-20, 10.0]]) * [-1 if mirrored else 1, 1]
    place = Place.of(square @ np.array([[c, s], [-s, c]]) + 50)
    assert place.turn_degrees == pytest.approx(turn)
    assert place.mirrored == mirrored
    upright = abs((turn + 90) % 180 - 90) <= 45
    assert (place.width, place.height) == pytest.approx((40, 20) if upright else (20, 40))

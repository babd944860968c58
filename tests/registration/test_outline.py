import cv2
import numpy as np
import pytest

from mwdn.errors import AlignmentError
from mwdn.registration import find_outline

CORNERS = np.array([[61.3, 55.2], [150.8, 58.9], [148.1, 139.4], [58.7, 142.6]])


def drawn(size=200, *, noise=0.03, disturbed=True):
    """Square root of light: a bright quadrilateral with a dark splash over its border, and lights beside it."""
    canvas = np.zeros((size, size), np.float32)
    cv2.fillPoly(canvas, [np.round((CORNERS + 0.5) * 16 - 8).astype(np.int32)], 0.8, cv2.LINE_AA, shift=4)
    cv2.circle(canvas, (120, 90), 22, 0.2, -1, cv2.LINE_AA)
    if disturbed:
        cv2.circle(canvas, (62, 110), 14, 0.05, -1, cv2.LINE_AA)
        cv2.circle(canvas, (130, 146), 9, 0.4, -1, cv2.LINE_AA)
    cv2.circle(canvas, (20, 20), 8, 1.1, -1, cv2.LINE_AA)
    smooth = cv2.GaussianBlur(canvas, (0, 0), 1.2)
    return (smooth + noise * np.random.default_rng(0).standard_normal(smooth.shape).astype(np.float32)).clip(0)


def test_corners_within_one_and_a_half_pixels_in_spite_of_a_splash_and_lights():
    assert find_outline(drawn()) == pytest.approx(CORNERS, abs=1.5)


def test_a_side_that_the_reconstruction_lost_is_found_in_a_linear_estimate_under_haze():
    picture = drawn(noise=0, disturbed=False) ** 2
    haze = cv2.GaussianBlur(picture, (0, 0), 25) * 1.5
    noise = 0.02 * np.random.default_rng(2).standard_normal(picture.shape)
    lost = drawn()
    lost[:70] *= 0.02  # 11 to 15 px of the picture
    assert np.abs(find_outline(lost) - CORNERS).max() > 8
    assert find_outline(lost, (picture + haze + noise).astype(np.float32)) == pytest.approx(CORNERS, abs=1)


def test_a_linear_estimate_of_noise_alone_changes_nothing():
    noise = np.random.default_rng(3).random((200, 200)).astype(np.float32)
    assert (find_outline(drawn(), noise) == find_outline(drawn())).all()


def test_an_even_linear_estimate_changes_nothing():
    """It ended in numpy's error: no profile falls."""
    assert (find_outline(drawn(), np.ones((200, 200), np.float32)) == find_outline(drawn())).all()


def test_turned_a_quarter_the_corners_turn_too():
    turned = np.rot90(drawn()).copy()  # (x, y) moves to (y, 199 - x)
    expected = np.stack([CORNERS[:, 1], 199 - CORNERS[:, 0]], -1)
    assert find_outline(turned) == pytest.approx(np.roll(expected, -1, 0), abs=1.5)


@pytest.mark.parametrize("kind", ["noise", "disc", "dark", "even"])
def test_no_display_is_refused(kind):
    image = 0.3 * np.random.default_rng(1).random((160, 160)).astype(np.float32)
    if kind == "disc":
        cv2.circle(image, (80, 80), 40, 1.0, -1, cv2.LINE_AA)
    if kind == "dark":
        image[:] = 0
    if kind == "even":
        image[:] = 0.5
    with pytest.raises(AlignmentError, match="--points"):
        find_outline(image)

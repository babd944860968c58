"""The map of a picture's support, where the truth is known."""

import pytest
import torch
from torch.nn import functional as F

from cameras import capture_of_rectangles
from mwdn.diagnosis.support_map import support_map
from mwdn.io.support_picture import support_picture
from mwdn.solvers.pyramid import Pyramid


@pytest.fixture(scope="module")
def capture():
    """The object is in the middle, with darkness around."""
    return capture_of_rectangles((120, 120), count=12, corners=(40, 66), rectangle=(10, 12))


def at_parts(image, support):
    """Mean of a picture over each part of the map."""
    return F.adaptive_avg_pool2d(image.mean(1, keepdim=True), tuple(support.map.shape))[0, 0]


def ranks(values):
    return values.flatten().argsort().argsort().float()


def test_object_is_supported_and_darkness_is_not(capture):
    psf, scene, measurement = capture
    support = support_map(measurement, psf, scene)
    light = at_parts(scene, support)
    assert support.map[light > 0.2].median() > 0.9
    assert support.map[light == 0].median() < 0.05
    assert support.light > 0.8
    assert support.area > 0.8


def test_invented_blob_is_not_supported(capture):
    """Where the capture knows of no light."""
    psf, scene, measurement = capture
    invented = scene.clone()
    invented[..., 6:22, 90:106] = 0.5 * scene.max()
    support = support_map(measurement, psf, invented)
    light = at_parts(invented - scene, support)
    assert support.map[light > 0.2].max() < 0.1
    assert support.light < support_map(measurement, psf, scene).light


def test_support_predicts_the_error(capture):
    psf, scene, measurement = capture
    picture = Pyramid()(measurement, psf)
    support = support_map(measurement, psf, picture)
    error = at_parts((picture - scene).square(), support) / at_parts(picture.square(), support).clamp(min=1e-12)
    lit = at_parts(picture, support) > 0.01
    assert torch.corrcoef(torch.stack([ranks(support.map[lit]), ranks(-error[lit])]))[0, 1] > 0.6


def test_brightness_does_not_matter_and_a_black_picture_has_no_support(capture):
    psf, scene, measurement = capture
    plain, scaled = support_map(measurement, psf, scene), support_map(3e3 * measurement, psf, 0.2 * scene)
    torch.testing.assert_close(scaled.map, plain.map, rtol=1e-3, atol=1e-3)
    assert support_map(measurement, psf, torch.zeros_like(scene)).light == 0


def test_drawing_keeps_the_shape_and_holds_a_legend(capture):
    drawing = support_picture(capture[1], torch.rand(5, 6))
    assert drawing.shape == (1, 3, 320 + 44, 320)
    assert 0 <= drawing.min() < drawing.max() <= 1

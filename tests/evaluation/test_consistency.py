"""The consistency score on simulated captures, with known PSF, noise and scene."""

import pytest
import torch

from cameras import capture_of_rectangles
from mwdn.errors import ShapeError
from mwdn.evaluation.consistency import Consistency, consistency
from mwdn.optics.camera import Camera
from mwdn.solvers.alignment import fine_detail
from mwdn.solvers.pose import Pose


@pytest.fixture(scope="module")
def capture():
    return capture_of_rectangles((96, 112), count=25, corners=(18, 66), rectangle=(9, 12))


@pytest.fixture(scope="module")
def plain(capture):
    """The score of the true scene."""
    psf, scene, measurement = capture
    return consistency(measurement, psf, scene)


def test_the_true_scene_explains_all_that_is_not_noise(plain):
    assert plain.explained == pytest.approx(plain.possible, abs=0.02)


def test_possible_is_what_white_noise_leaves(capture):
    psf, scene, _ = capture
    light = Camera(psf).forward(scene)
    # A little of the finest detail counts as noise, too.
    clean = consistency(light, psf, scene)
    assert clean.possible > 0.99
    noise = 0.5 * light.std() * torch.randn(light.shape, generator=torch.Generator().manual_seed(3))
    noisy = consistency(light + noise, psf, scene)
    detail = fine_detail(light).square().sum()
    share = detail / (detail + noise.square().sum())
    assert noisy.possible == pytest.approx(float(share), abs=0.1)


def test_turned_psf_is_aligned(capture, plain):
    psf, scene, measurement = capture
    turned = Pose(torch.tensor([-0.9]), torch.tensor([0.0])).move(psf)
    result = consistency(measurement, turned, scene)
    assert result.turn_degrees == pytest.approx(0.9, abs=0.2)
    assert result.explained == pytest.approx(plain.explained, abs=0.05)
    assert "turned by" in result.sentence


def test_gain_and_even_light_do_not_matter(capture, plain):
    psf, scene, measurement = capture
    result = consistency(3 * measurement + 0.5, 7 * psf, 0.2 * scene)
    assert result.explained == pytest.approx(plain.explained, abs=5e-3)


def test_sentences():
    plain = Consistency(0.84, 0.96, 0.0, 0.0, 0.0).sentence
    assert plain == "the picture reproduces 84% of the capture's detail (96% is not noise)"
    moved = Consistency(0.84, 0.96, 0.5, 0.0, 0.07).sentence
    assert moved == f"{plain}; fits best with the PSF turned by 0.50 degrees, under 7% of haze"
    displaced = Consistency(0.84, 0.96, 0.0, 0.0, 0.0, envelope_down=0.012, envelope_right=-0.016).sentence
    assert displaced == f"{plain}; fits best with the PSF behind an aperture displaced by 2.0% of the frame"


def test_one_capture_at_a_time(capture):
    psf, scene, measurement = capture
    with pytest.raises(ShapeError, match="one shape"):
        consistency(measurement, psf, scene[..., 1:])

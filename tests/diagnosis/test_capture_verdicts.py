"""Checks of a raw frame."""

import numpy as np
import pytest
import torch

from cameras import contour_psf
from mwdn.calibration import Calibration
from mwdn.diagnosis.captures import ambient_light, darkness, examine_capture, saturation
from mwdn.diagnosis.noise import noise, noise_bounds
from mwdn.diagnosis.trust import examine_picture
from mwdn.optics.camera import Camera
from mwdn.solvers.admm import Admm
from mwdn.solvers.pyramid import Pyramid

SIZE = (96, 104)


@pytest.fixture(scope="module")
def calibration():
    return Calibration(contour_psf(SIZE, generator=torch.Generator().manual_seed(1)))


@pytest.fixture(scope="module")
def light(calibration):
    """The capture of a bright square without noise, its maximum at 0.8."""
    scene = torch.zeros(1, 1, *SIZE)
    scene[..., 40:60, 44:60] = 1.0
    light = Camera(calibration.psf).forward(scene)
    return 0.8 * light / light.amax()


def stored(light, bits=16):
    """A raw frame."""
    return (light.clamp(0, 1) * (2**bits - 1)).round()[0].movedim(0, -1).numpy().astype(f"uint{bits}")


def with_noise(light, sigma):
    return light + sigma * torch.randn(light.shape, generator=torch.Generator().manual_seed(2))


def test_good_capture(light, calibration):
    frame = stored(with_noise(light, 0.002))
    states = [check(frame, calibration).state for check in (saturation, darkness, noise)]
    assert states[:2] == ["good", "good"]
    assert states[2] != "doubt"


def test_a_frame_without_an_axis_of_channels_gives_the_same(light, calibration):
    frame = stored(with_noise(light, 0.002))
    assert examine_capture(frame[..., 0], calibration) == examine_capture(frame, calibration)


def test_noise_beyond_half_of_the_detail(light, calibration):
    verdict = noise(stored(0.2 + 0.5 * with_noise(light, 1.0).clamp(-0.4, 1.6)), calibration)
    assert (verdict.state, verdict.value) == ("doubt", "noise")


def test_correlated_noise_widens_the_bounds(light):
    """As JPEG or an interpolated mosaic makes it."""
    white = with_noise(light, 0.05)
    smooth = light + torch.nn.functional.avg_pool2d(white - light, 3, 1, 1)
    assert noise_bounds(white).high < 1.2 * noise_bounds(white).low
    assert noise_bounds(smooth).high > 2 * noise_bounds(smooth).low


def test_dark_capture_and_lower_bits(light, calibration):
    assert darkness(stored(0.02 * light), calibration).state == "doubt"
    assert darkness(np.float32(0.02 / 65535) * stored(light).astype(np.float32), calibration).state == "unknown"


def test_more_was_subtracted_than_the_sensor_saw(light, calibration):
    """A capture that is half negative was accepted without a word."""
    frame = (light - light.mean())[0].movedim(0, -1).numpy()
    verdict = darkness(frame, calibration)
    assert (verdict.state, "more was subtracted" in verdict.text) == ("doubt", True)
    assert darkness(stored(light), Calibration(calibration.psf, dark=light + 0.2)).state == "doubt"


def test_bit_depth_is_advised_only_where_it_can_be_given(light, calibration):
    """`--bit-depth 12` was advised for 8-bit files, which refuse it."""
    ten, twelve, eight = 500 / 65535 * light, 1500 / 65535 * light, 0.02 * light
    frames = stored(ten), stored(twelve), stored(eight, 8)
    assert [darkness(f, calibration).options for f in frames] == ["--bit-depth 10", "--bit-depth 12", ""]


def test_even_light_is_bounded(light, calibration):
    """One capture cannot tell it from bright surroundings."""
    verdict = ambient_light(stored(0.5 * light + 0.2), calibration)
    assert (verdict.state, verdict.options) == ("unknown", "--ambient FILE")


def test_noise_is_no_capture(calibration):
    """Neither its PSF nor its picture can be judged."""
    measurement = torch.rand(1, 1, *SIZE, generator=torch.Generator().manual_seed(3))
    trust = examine_picture(measurement, calibration.psf, Pyramid()(measurement, calibration.psf))
    assert [verdict.state for verdict in trust.verdicts] == ["unknown", "unknown"]
    assert not trust.doubtful
    assert trust.sentence.startswith("the picture cannot be judged: only ")
    assert trust.sentence.endswith("; this capture cannot judge the PSF")
    assert trust.content["possible"] < 0.03


@pytest.mark.parametrize("levels", [0, 3])
def test_a_frame_of_few_levels_does_not_doubt_the_psf(levels, light, calibration):
    """Saturated everywhere, or dark: its PSF, the right one, was another camera's."""
    measurement = (light * levels / light.max()).round() if levels else torch.ones_like(light)
    assert noise_bounds(measurement).high == 1
    assert examine_picture(measurement, calibration.psf, measurement).verdicts[0].state != "doubt"


def test_the_verdict_on_the_psf_does_not_depend_on_the_regularisation(light, calibration):
    measurement = with_noise(light, 0.002)
    smooth, sharp = (
        examine_picture(
            measurement, calibration.psf, Admm(regularisation=tau, iterations=5)(measurement, calibration.psf)
        )
        for tau in (1e-2, 1e-6)
    )
    assert smooth.consistency.explained < 0.9 * sharp.consistency.explained
    assert smooth.orientation == sharp.orientation


def test_picture_of_something_else_is_doubted(light, calibration):
    trust = examine_picture(with_noise(light, 0.002), calibration.psf, torch.rand(1, 1, *SIZE))
    assert trust.doubtful
    assert trust.verdicts[1].topic == "little-explained"

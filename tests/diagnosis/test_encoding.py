from dataclasses import replace

import numpy as np
import pytest
import torch

from cameras import contour_psf
from mwdn import Calibration
from mwdn.diagnosis.encoding import gamma, misfits, noise_slope
from mwdn.io.images import srgb_encode
from mwdn.optics import Camera, Sensor

SIDE = 128
CODES = {"linear": lambda light: light, "srgb": srgb_encode, "2.2": lambda light: light.clamp(min=0) ** (1 / 2.2)}


@pytest.fixture(scope="module")
def psf():
    return contour_psf((SIDE, SIDE), generator=torch.Generator().manual_seed(5))


@pytest.fixture(scope="module")
def light(psf):
    """Two bright squares in a dark room, seen by the camera."""
    scene = torch.zeros(1, 1, SIDE, SIDE)
    scene[..., 40:56, 40:56], scene[..., 70:90, 60:75] = 1.0, 0.4
    measurement = Camera(psf).forward(scene)
    return 0.9 * measurement / measurement.amax()


def file(measurement, code, bits=16):
    numbers = CODES[code](measurement.clamp(0, 1)) * (2**bits - 1)
    return numbers[0].movedim(0, -1).round().numpy().astype(np.uint8 if bits == 8 else np.uint16)


def exposed(light, generator):
    return Sensor(full_well=4000.0, read_noise=3.0, bit_depth=16, black_level=0.0).expose(light, generator=generator)


@pytest.mark.parametrize("code", CODES)
def test_noise_grows_with_the_level_to_the_power_of_its_encoding(psf, generator, code):
    """Shot noise: level^1 when linear, level^(2 - 2.2) after a power of 1 / 2.2."""
    ramp = torch.linspace(0.1, 0.9, 256).expand(1, 1, 256, 256)
    slope = noise_slope(file(exposed(ramp, generator), code), Calibration(psf))
    assert slope.slope == pytest.approx({"linear": 1.0, "srgb": -0.3, "2.2": -0.2}[code], abs=0.15)
    assert slope.error < 0.2


def test_rounding_hides_the_noise(psf):
    ramp = torch.linspace(0.1, 0.9, 256).expand(1, 1, 256, 256)
    assert noise_slope(file(ramp, "linear", 8), Calibration(psf)).error > 1


@pytest.mark.parametrize("code", CODES)
def test_a_scene_explains_linear_light(psf, light, code):
    """Without noise, in 8 bits: the misfit alone decides."""
    fits = misfits(file(light, code, 8), Calibration(psf))
    assert (fits.stored < fits.decoded) == (code == "linear")
    assert fits.change > 0.05


@pytest.mark.parametrize("code", CODES)
@pytest.mark.parametrize("bits", [8, 16])
@pytest.mark.parametrize("ambient", [0.0, 0.1])
def test_encoding_is_detected(psf, light, generator, code, bits, ambient):
    frame = file(exposed(0.9 * light + ambient, generator), code, bits)
    linear = gamma(frame, Calibration(psf))
    decoded = gamma(frame, replace(Calibration(psf), frames=replace(Calibration(psf).frames, gamma="srgb")))
    if code == "linear":
        assert (linear.state, linear.value, linear.options) == ("good", "linear", "")
        assert (decoded.state, decoded.value) == ("doubt", "linear")
    else:
        assert (linear.state, linear.value, linear.options) == ("doubt", "srgb", "--gamma srgb")
        assert (decoded.state, decoded.value) == ("good", "srgb")


@pytest.mark.parametrize("code", ["linear", "srgb"])
def test_low_contrast_without_noise_cannot_tell(psf, light, code):
    verdict = gamma(file(0.5 + 0.02 * light, code, 8), Calibration(psf))
    assert (verdict.state, verdict.value) == ("unknown", "")


def test_the_file_type_decides_where_the_evidence_is_weak(psf, light):
    """Six of eight DiffuserCam captures as sRGB JPEG stayed open. Clear evidence of a linear one counts for more."""
    weak = file(light + 0.03, "srgb", 8)
    assert gamma(weak, Calibration(psf)).state == "unknown"
    verdict = gamma(weak, Calibration(psf), for_viewing=True)
    assert (verdict.state, verdict.options) == ("doubt", "--gamma srgb")
    linear = gamma(file(light, "linear", 8), Calibration(psf), for_viewing=True)
    assert linear.value == "linear"
    assert "unexplained" in linear.text  # it gave no reason
    assert gamma(file(0.5 + 0.02 * light, "srgb", 8), Calibration(psf), for_viewing=True).state == "unknown"


def test_an_empty_frame_cannot_tell(psf):
    assert gamma(np.zeros((SIDE, SIDE, 1), np.uint8), Calibration(psf)).state == "unknown"


def test_a_capture_with_numbers_below_0_is_not_coded(psf, light):
    """`--gamma srgb` was advised for floats of which too much had been subtracted."""
    frame = (light - light.mean())[0].movedim(0, -1).contiguous().numpy()
    verdict = gamma(frame, Calibration(psf))
    assert (verdict.state, verdict.value, verdict.options) == ("good", "linear", "")

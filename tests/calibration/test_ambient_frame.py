"""The ambient frame loses its noise, and nothing else."""

import numpy as np
import pytest
import torch

from cameras import contour_psf
from mwdn import Calibration, convolve
from mwdn.calibration.ambient_frame import denoise_ambient
from mwdn.optics.room_light import sloping_light, spot_light

SIZE = 144, 160
ELECTRONS = 15_000


def exposed(light, generator, *, read_noise=3.0):
    """A frame with photon and read noise; 1 is saturation."""
    electrons = torch.poisson(ELECTRONS * light, generator=generator)
    return (electrons + read_noise * torch.randn(light.shape, generator=generator)) / ELECTRONS


def error(image, truth):
    return float((image - truth).square().mean().sqrt())


LIGHTS = {
    "even": torch.full((1, 3, *SIZE), 0.1),
    "slope": 0.1 * sloping_light(SIZE, 0.6).expand(1, 3, *SIZE),
    "wide spot": 0.2 * spot_light(SIZE, (0.4, 0.6), 0.4).expand(1, 3, *SIZE),
    "narrow spot": 0.1 * spot_light(SIZE, (0.4, 0.6), 0.15).expand(1, 3, *SIZE),
}


@pytest.fixture
def mosaic():
    """Light of a slope behind a colour filter array."""
    light = LIGHTS["slope"][:, :1].clone()
    light[..., ::2, 1::2] *= 0.4
    light[..., 1::2, ::2] *= 0.7
    return light


@pytest.mark.parametrize("name", LIGHTS)
def test_smooth_light_loses_five_sixths_of_its_noise(name, generator):
    frame = exposed(LIGHTS[name], generator)
    assert error(denoise_ambient(frame), LIGHTS[name]) < error(frame, LIGHTS[name]) / 6


def test_light_without_noise_stays_as_it_is():
    for light in LIGHTS.values():
        torch.testing.assert_close(denoise_ambient(light), light, atol=2e-4, rtol=0)


def test_colours_of_a_mosaic_stay(mosaic, generator):
    """Each kind of pixel sees the room through its own filter."""
    frame = exposed(mosaic, generator)
    assert error(denoise_ambient(frame, cell=2), mosaic) < error(frame, mosaic) / 4


def test_a_window_seen_through_the_mask_stays(generator):
    """Its pattern on the sensor has detail, which a plain low-pass would remove."""
    psf = contour_psf(SIZE, cell=24, generator=generator)
    scene = torch.zeros(1, 1, *SIZE)
    scene[..., 50:62, 80:90] = 1.0
    light = convolve(scene, psf).clamp(min=0)
    light = 0.8 * light / light.max()
    frame = exposed(light, generator)
    denoised = denoise_ambient(frame)
    assert error(denoised, light) < error(frame, light)
    detail = light - torch.nn.functional.avg_pool2d(light, 9, 1, 4, count_include_pad=False)
    kept = float(((denoised - denoised.mean()) * detail).sum() / detail.square().sum())
    assert kept == pytest.approx(float(((light - light.mean()) * detail).sum() / detail.square().sum()), rel=0.01)


def test_hot_pixels_stay(generator):
    frame = exposed(LIGHTS["slope"], generator)
    places = torch.randperm(SIZE[0] * SIZE[1], generator=generator)[:20]
    hot = frame.clone()
    hot.flatten(-2)[..., places] += 0.4
    denoised = denoise_ambient(hot)
    torch.testing.assert_close(denoised.flatten(-2)[..., places], hot.flatten(-2)[..., places])
    assert error(denoised, LIGHTS["slope"] + hot - frame) < error(frame, LIGHTS["slope"]) / 6


def test_with_a_dark_frame_all_of_its_pattern_stays(generator):
    dark = 0.02 * torch.rand(1, 1, *SIZE, generator=generator)
    frame = exposed(LIGHTS["slope"], generator) + dark
    assert error(denoise_ambient(frame, dark) - dark, LIGHTS["slope"]) < 1e-3


def test_hot_pixels_of_a_longer_dark_frame_do_not_become_dark(generator):
    hot = torch.zeros(1, 1, *SIZE)
    hot.flatten()[torch.randperm(SIZE[0] * SIZE[1], generator=generator)[:20]] = 0.05
    frame = exposed(LIGHTS["slope"], generator) + hot
    found = denoise_ambient(frame, 4 * hot + 0.001 * torch.randn(1, 1, *SIZE, generator=generator))
    torch.testing.assert_close(found[(hot > 0).expand_as(found)], frame[(hot > 0).expand_as(frame)])


def test_a_coloured_dark_frame_of_a_grey_frame(generator):
    dark = torch.tensor([0.01, 0.02, 0.03])[None, :, None, None].expand(1, 3, *SIZE)
    frame = exposed(LIGHTS["slope"][:, :1], generator) + 0.02
    assert denoise_ambient(frame, dark).shape == (1, 3, *SIZE)
    assert torch.equal(denoise_ambient(frame, dark[..., :-2]), denoise_ambient(frame))  # of another camera


@pytest.mark.parametrize("drift", [0.0, -0.0005])
def test_light_on_a_small_part_of_the_frame_stays(drift, generator):
    """Where there is no light, the ratio of noise to light says nothing; the dark level may have drifted."""
    light = 0.1 * spot_light(SIZE, (0.4, 0.6), 0.08).expand(1, 3, *SIZE)
    frame = exposed(light, generator) + drift
    assert error(denoise_ambient(frame), light) < error(frame, light)


def test_a_mosaic_that_was_not_named_stays(mosaic, generator):
    frame = exposed(mosaic, generator)
    assert error(denoise_ambient(frame), mosaic) < 0.6 * error(frame, mosaic)


@pytest.mark.parametrize("count", [1, 16])
def test_sharp_lines_of_a_lamp_are_no_noise(count, generator):
    """One frame, or the mean of some, whose noise is a quarter."""
    psf = contour_psf(SIZE, cell=24, generator=generator)
    light = 0.8 * psf / psf.max()
    frame = sum(exposed(light, generator) for _ in range(count)) / count
    assert error(denoise_ambient(frame), light) < 1.1 * error(frame, light)


@pytest.mark.parametrize("size", [(1, 1), (63, 80), (145, 160)])
def test_frames_too_small_or_odd_for_their_cells_stay(size, generator):
    frame = exposed(torch.full((1, 1, *size), 0.1), generator)
    assert torch.equal(denoise_ambient(frame, cell=2), frame)


@pytest.mark.parametrize("level", [0.0, -0.01])
def test_a_frame_without_light_stays(level):
    frame = torch.full((1, 3, *SIZE), level)
    assert torch.equal(denoise_ambient(frame), frame)


def test_light_beside_the_whole_parts_stays():
    """150 rows are nine parts of 16 pixels, and six rows that belong to none."""
    frame = torch.zeros(1, 1, 150, 160)
    frame[..., 144:, :] = 0.1
    assert torch.equal(denoise_ambient(frame), frame)


def test_one_pixel_that_is_not_a_number_stays_one(generator):
    frame = exposed(LIGHTS["slope"], generator)
    frame[0, 0, 3, 4] = torch.nan
    assert denoise_ambient(frame).isnan().sum() == 1


def test_other_floats(generator):
    frame = exposed(LIGHTS["slope"], generator)
    torch.testing.assert_close(denoise_ambient(frame.double()).float(), denoise_ambient(frame))


def test_a_capture_keeps_only_its_own_noise(generator):
    """One frame of the room's light would otherwise add its noise to each capture: sqrt(2) of it."""
    psf = contour_psf(SIZE, cell=24, generator=generator)
    light = 0.5 * psf / psf.max()
    room = LIGHTS["slope"][:, :1]
    frames = [exposed(part, generator)[0, 0].clamp(min=0).numpy().astype(np.float32) for part in (room, light + room)]
    calibration = Calibration.from_array(light[0, 0].numpy(), ambient=frames[0], background=0.0, bit_depth=None)
    noise = error(torch.from_numpy(frames[1]), (light + room)[0, 0])
    assert error(calibration.correct(frames[1]), light) == pytest.approx(noise, rel=0.03)

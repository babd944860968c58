"""A PSF from a file, and raw frames to measurements."""

import re
from dataclasses import replace
from typing import get_args

import cv2
import numpy as np
import pytest
import tifffile
import torch
from PIL import Image

from cameras import contour_psf
from mwdn.calibration import Calibration, FrameFormat
from mwdn.calibration.corrections import Corrections
from mwdn.calibration.psf_levels import estimate_background
from mwdn.errors import ImageError, ParameterError, PsfError, ShapeError, UnknownNameError
from mwdn.fourier.convolution import convolve
from mwdn.io.images import srgb_encode
from mwdn.optics.orientation import Orientation, turn
from mwdn.optics.saturation import saturated_pixels

SIZE = 48, 40


@pytest.fixture
def caustic(generator):
    """(H, W) in [0, 0.9], dark at the border."""
    psf = contour_psf(SIZE, cell=12, generator=generator)[0, 0]
    return (0.9 * psf / psf.max()).numpy()


def store(path, frame):
    """Write (H, W, C) numbers in RGB order, by the file's suffix."""
    frame = frame[..., 0] if frame.shape[-1] == 1 else frame
    if path.suffix == ".npy":
        np.save(path, frame)
    elif path.suffix == ".tif":
        tifffile.imwrite(path, frame)
    else:
        assert cv2.imwrite(str(path), frame if frame.ndim == 2 else frame[..., ::-1])
    return path


def coloured(caustic):
    return np.stack([caustic, 0.5 * caustic, 0.7 * caustic[::-1, ::-1]], -1)


@pytest.mark.parametrize("channels", [1, 3])
@pytest.mark.parametrize("dtype", ["u1", "u2"])
@pytest.mark.parametrize("suffix", [".png", ".tif", ".npy"])
def test_psf_of_any_file(tmp_path, caustic, suffix, dtype, channels):
    light = coloured(caustic) if channels == 3 else caustic[..., None]
    frame = (light * np.iinfo(dtype).max).round().astype(dtype)
    calibration = Calibration.from_file(store(tmp_path / f"psf{suffix}", frame), background=0.0)
    assert calibration.psf.shape == (1, channels, *SIZE)
    assert calibration.size == SIZE
    expected = frame.astype(float) / frame.sum((0, 1), dtype=float)
    np.testing.assert_allclose(calibration.psf[0].movedim(0, -1), expected, rtol=1e-5)
    torch.testing.assert_close(calibration.psf.sum((-2, -1)), torch.ones(1, channels))
    assert calibration.background == (0,) * channels


def test_psf_of_floats(tmp_path, caustic):
    np.save(tmp_path / "psf.npy", 3 * caustic)
    psf = Calibration.from_file(tmp_path / "psf.npy", background=0.0).psf[0, 0]
    np.testing.assert_allclose(psf, caustic / caustic.sum(), rtol=1e-5, atol=1e-9)


def test_bgr_and_upside_down_are_undone(tmp_path, caustic):
    frame = (coloured(caustic) * 65535).astype(np.uint16)
    straight = Calibration.from_file(store(tmp_path / "a.npy", frame))
    twisted = Calibration.from_file(store(tmp_path / "b.npy", frame[::-1, :, ::-1]), bgr=True, upside_down=True)
    # Rows of an even height turn about row H / 2, so they are one row lower than those of the first file.
    torch.testing.assert_close(twisted.psf, straight.psf.roll(1, -2))
    back = twisted.correct(frame[::-1])
    torch.testing.assert_close(back, straight.correct(frame))


@pytest.mark.parametrize("size", [(9, 9), (10, 10), (11, 8), (8, 11)])
@pytest.mark.parametrize("crop", [None, (7, 7), (6, 8)])
@pytest.mark.parametrize("binning", [1, 2, 3])
@pytest.mark.parametrize("upside_down", [False, True])
def test_centre_of_the_file_is_the_centre_of_the_psf(tmp_path, size, crop, binning, upside_down):
    frame = np.zeros((*size, 1), np.uint16)
    frame[size[0] // 2, size[1] // 2] = 60000
    options = {"crop": crop, "bin": binning, "upside_down": upside_down, "background": 0.0}
    calibration = Calibration.from_file(store(tmp_path / "psf.npy", frame), **options)
    height, width = (n // binning for n in crop or size)
    expected = torch.zeros(1, 1, height, width)
    expected[..., height // 2, width // 2] = 1
    torch.testing.assert_close(calibration.psf, expected)
    assert calibration.correct(frame).shape[-2:] == calibration.size


@pytest.mark.parametrize("size", [(16, 12), (15, 12)])
def test_turned_scene_through_a_turned_psf_is_the_turned_measurement(size, generator):
    scene = torch.rand(1, 3, *size, generator=generator)
    psf = torch.rand(1, 1, *size, generator=generator)
    psf[..., 0, :] = 0  # the row that an even height rolls from one border to the other
    torch.testing.assert_close(convolve(scene.flip(-2), turn(psf, "flip-top-bottom")), convolve(scene, psf).flip(-2))


def test_captures_of_an_upside_down_camera_are_turned_whole(tmp_path, generator):
    """Row for row, without a row of the opposite border: a ground truth turned by its reader stays aligned."""
    frame = np.random.default_rng(0).integers(1, 200, (6, 4, 1)).astype(np.uint8)
    calibration = Calibration(torch.ones(1, 1, 6, 4), FrameFormat(upside_down=True))
    np.testing.assert_allclose(calibration.correct(frame)[0, 0], frame[::-1, :, 0] / 255, rtol=1e-6)


# --- Levels -------------------------------------------------------------------------------------------


def noisy(caustic, level, sigma=0.002):
    noise = sigma * np.random.default_rng(1).standard_normal(caustic.shape)
    return ((0.8 * caustic + level + noise).clip(0, 1) * 65535).astype(np.uint16)[..., None]


def test_given_background_is_subtracted(tmp_path, caustic):
    path = store(tmp_path / "psf.tif", noisy(caustic, 0.1, sigma=0))
    calibration = Calibration.from_file(path, background=0.1)
    assert calibration.background == (0.1,)
    np.testing.assert_allclose(calibration.psf[0, 0], caustic / caustic.sum(), atol=1e-5)


@pytest.mark.parametrize("level", [0.02, 0.1])
def test_uniform_light_is_estimated(tmp_path, caustic, level):
    calibration = Calibration.from_file(store(tmp_path / "psf.tif", noisy(caustic, level)))
    assert calibration.background[0] == pytest.approx(level, abs=0.005)
    clean = caustic / caustic.sum()
    left = np.abs(calibration.psf[0, 0].numpy() - clean).sum()
    kept = np.abs(Calibration.from_file(tmp_path / "psf.tif", background=0.0).psf[0, 0].numpy() - clean).sum()
    assert left < 0.1  # what the noise of 1,920 pixels adds once it is clipped at zero
    assert left < kept / 3


def test_dark_frame_is_subtracted_from_psf_and_captures(tmp_path, caustic):
    pattern = np.random.default_rng(2).integers(500, 4000, (*SIZE, 1)).astype(np.uint16)
    light = (caustic * 50000).astype(np.uint16)[..., None]
    dark = store(tmp_path / "dark.tif", pattern)
    calibration = Calibration.from_file(store(tmp_path / "psf.tif", light + pattern), dark=dark, background=0.0)
    np.testing.assert_allclose(calibration.psf[0, 0], light[..., 0] / light.sum(), atol=1e-7)
    np.testing.assert_allclose(calibration.correct(light // 2 + pattern)[0, 0], light[..., 0] // 2 / 65535, atol=1e-6)


@pytest.mark.parametrize("name", ["dark", "ambient"])
def test_a_subtracted_frame_on_another_scale_is_refused(caustic, name):
    """An average of 8-bit frames, saved as it is, made every pixel of a capture darker than the dark frame."""
    picture, average = (200 * caustic).astype(np.uint8), np.full(SIZE, 12.25, np.float32)
    with pytest.raises(ParameterError, match=rf"`{name}`.* 12\.25\b.*`bit_depth`"):
        Calibration.from_array(picture, **{name: average})
    by_hand = Calibration.from_array(picture, **{name: average / 255})
    given = Calibration.from_array(picture, bit_depth=8, **{name: average})
    torch.testing.assert_close(given.correct(picture), by_hand.correct(picture))


@pytest.mark.parametrize("name", ["psf", "dark", "ambient"])
def test_too_many_bits_name_their_frame(caustic, name):
    frames = dict.fromkeys(("psf", "dark", "ambient"), (1000 * caustic).astype(np.uint16))
    frames[name] = frames[name] * 9
    with pytest.raises(ParameterError, match=rf"`bit_depth` \(12\) .* 4,095, but `{name}` holds 8,091: .* 13 bits"):
        Calibration.from_array(frames.pop("psf"), bit_depth=12, **frames)


def test_a_dark_frame_needs_the_scale_of_a_psf_of_floats(caustic):
    with pytest.raises(ParameterError, match=r"`psf`.*`dark`.* 180\b"):
        Calibration.from_array(200 * caustic, dark=np.full(SIZE, 5, np.uint8))
    assert Calibration.from_array(200 * caustic).psf.sum() == pytest.approx(1)


def test_dark_frame_is_cropped_and_binned_with_the_frame(tmp_path, caustic):
    pattern = np.random.default_rng(2).integers(500, 4000, (*SIZE, 1)).astype(np.uint16)
    light = (caustic * 50000).astype(np.uint16)[..., None]
    options = {"background": 0.0, "crop": (32, 24), "bin": 2}
    clean = Calibration.from_file(store(tmp_path / "clean.npy", light), **options)
    dark = store(tmp_path / "dark.npy", pattern)
    calibration = Calibration.from_file(store(tmp_path / "psf.npy", light + pattern), dark=dark, **options)
    assert calibration.size == (16, 12)
    torch.testing.assert_close(calibration.psf, clean.psf, rtol=1e-4, atol=1e-7)


def test_twelve_bits_in_a_file_of_sixteen(tmp_path, caustic):
    frame = (caustic * 4095).astype(np.uint16)[..., None]
    calibration = Calibration.from_file(store(tmp_path / "psf.png", frame), bit_depth=12)
    capture = np.full((*SIZE, 1), 1365, np.uint16)
    torch.testing.assert_close(calibration.correct(capture), torch.full((1, 1, *SIZE), 1 / 3))
    with pytest.raises(ParameterError, match="at least 13 bits"):
        calibration.correct(4 * capture)


def test_correct_by_hand():
    """(200 - 50) / 250 and so on, then the mean of the middle 2 x 2 of a 4 x 4 frame, last row first."""
    frame = np.zeros((4, 4, 1), np.float32)
    frame[1:3, 1:3, 0] = [[0.8, 0.4], [0.2, 0.6]]
    dark = torch.full((1, 1, 4, 4), 0.1)
    whole = Calibration(torch.ones(1, 1, 1, 1), FrameFormat(crop=(2, 2), bin=2), dark)
    assert whole.correct(frame).item() == pytest.approx((0.7 + 0.3 + 0.1 + 0.5) / 4)
    rows = Calibration(torch.ones(1, 1, 2, 2), FrameFormat(crop=(2, 2), upside_down=True), dark)
    torch.testing.assert_close(rows.correct(frame), torch.tensor([[[[0.1, 0.5], [0.7, 0.3]]]]))


def test_colour_capture_of_a_grey_psf_keeps_its_colours():
    calibration = Calibration(torch.ones(1, 1, 4, 4))
    assert calibration.correct(np.zeros((4, 4, 3), np.uint8)).shape == (1, 3, 4, 4)


def test_background_is_the_5th_percentile_of_each_channel(generator):
    ramp = torch.linspace(0, 1, 400)
    image = torch.stack([ramp[torch.randperm(400, generator=generator)], 3 + ramp]).reshape(1, 2, 20, 20)
    torch.testing.assert_close(estimate_background(image).flatten(), torch.tensor([ramp[20], 3 + ramp[20]]))
    assert estimate_background(image).shape == (1, 2, 1, 1)


def test_ambient_light_is_subtracted_from_captures_alone(tmp_path, caustic):
    """The frame of the room's light holds the dark level, too."""
    rng = np.random.default_rng(2)
    dark = rng.integers(500, 4000, (*SIZE, 1)).astype(np.uint16)
    room = np.linspace(500, 4000, SIZE[1]).round().astype(np.uint16)[:, None] * np.ones((*SIZE, 1), np.uint16)
    light = (caustic * 40000).astype(np.uint16)[..., None]
    calibration = Calibration.from_file(
        store(tmp_path / "psf.tif", light + dark),
        dark=store(tmp_path / "dark.tif", dark),
        ambient=store(tmp_path / "ambient.tif", room + dark),
        background=0.0,
    )
    np.testing.assert_allclose(calibration.psf[0, 0], light[..., 0] / light.sum(), atol=1e-7)
    measurement = calibration.correct(light + room + dark)
    np.testing.assert_allclose(measurement[0, 0], light[..., 0] / 65535, atol=1e-6)
    with pytest.raises(ShapeError, match=r"`ambient` \(1, 24, 40\), must have the size of the frame \(1, 48, 40\)"):
        Calibration.from_array(light, ambient=room[:24]).correct(light)


@pytest.mark.parametrize("correction", ["ambient", "flat"])
def test_saturated_pixels_stay_a_bound_after_a_correction(correction, generator):
    """An uneven room, or an uneven response, would spread their values, and solvers would take each for the light."""
    size = 144, 160
    psf = contour_psf(size, cell=24, generator=generator)
    light = 2.5 * psf / psf.max()
    slope, even = torch.linspace(0.7, 1.3, size[1]).expand(1, 1, *size), torch.ones(1, 1, *size)
    room, flat = (0.1 * slope, even) if correction == "ambient" else (0 * even, slope)
    frame = (65535 * (flat * light + room).clamp(max=1)).round()[0, 0].numpy().astype(np.uint16)
    calibration = replace(
        Calibration.from_array(psf[0, 0].numpy(), background=0.0), ambient=room, corrections=Corrections(flat)
    )
    measurement, was = calibration.correct(frame), torch.from_numpy(frame == 65535)[None, None]
    now = saturated_pixels(measurement)
    assert was.sum() > 200
    assert now[was].all()
    assert (measurement[now] <= light[now] + 2e-5).all()
    torch.testing.assert_close(measurement[~now], light[~now], atol=2e-5, rtol=0)


def test_a_hot_pixel_that_is_replaced_is_no_bound_of_saturated_ones(generator):
    """It is as bright as they are; what replaces it says nothing of their light."""
    psf = contour_psf((144, 160), cell=24, generator=generator)
    frame = (65535 * (2.5 * psf / psf.max() + 0.6).clamp(max=1)).round()[0, 0].numpy().astype(np.uint16)
    row, column = np.unravel_index(cv2.blur(frame, (9, 9)).argmin(), frame.shape)
    hot, defects = frame.copy(), torch.zeros(1, 1, 144, 160, dtype=torch.bool)
    hot[row, column], defects[..., row, column] = 65535, True
    calibration = Calibration.from_array(psf[0, 0].numpy(), background=0.0)
    calibration = replace(calibration, corrections=Corrections(defects=defects))
    assert calibration.correct(hot)[0, 0, row, column] < 0.7
    torch.testing.assert_close(calibration.correct(hot), calibration.correct(frame), atol=0.1, rtol=0)


@pytest.mark.parametrize("gamma", ["srgb", 2.2])
def test_psf_has_a_gamma_of_its_own(gamma, caustic):
    linear = caustic[..., None].astype(np.float32)
    light = torch.from_numpy(linear)
    coded = (srgb_encode(light) if gamma == "srgb" else light ** (1 / gamma)).numpy()
    expected = Calibration.from_array(linear, background=0.0).psf
    psf = Calibration.from_array(coded, background=0.0, psf_gamma=gamma)
    torch.testing.assert_close(psf.psf, expected, atol=1e-6, rtol=1e-4)
    assert torch.equal(Calibration.from_array(linear, background=0.0, gamma=gamma).psf, expected)


def test_light_of_the_point_source_is_kept(caustic):
    """Its colour, which the normalised PSF has lost."""
    red, green, blue = Calibration.from_array(coloured(caustic).astype(np.float32), background=0.0).light
    assert (green / red, blue / red) == pytest.approx((0.5, 0.7), rel=1e-4)


# --- Orientation --------------------------------------------------------------------------------------


@pytest.mark.parametrize("orientation", get_args(Orientation))
def test_turned_psf_file_is_turned_back(orientation, generator):
    """The file holds the inverse turn; crop and binning are those of the captures."""
    psf = torch.zeros(1, 3, 12, 16)
    psf[..., 4:8, 6:11] = torch.rand(1, 3, 4, 5, generator=generator)
    inverse = {"rotate-90": "rotate-270", "rotate-270": "rotate-90"}.get(orientation, orientation)
    expected, calibration = (
        Calibration.from_array(image[0].movedim(0, -1).numpy(), background=0.0, crop=(8, 12), psf_orientation=name)
        for image, name in ((psf, None), (turn(psf, inverse), orientation))
    )
    assert calibration.size == (8, 12)
    torch.testing.assert_close(calibration.psf, expected.psf)


@pytest.mark.parametrize("orientation", get_args(Orientation))
def test_orientations_are_those_of_pillow(orientation, generator):
    """On odd sides, where the centre is the middle."""
    psf = torch.rand(1, 1, 5, 7, generator=generator)
    picture = Image.fromarray(psf[0, 0].numpy()).transpose(Image.Transpose[orientation.upper().replace("-", "_")])
    np.testing.assert_array_equal(turn(psf, orientation)[0, 0], np.asarray(picture))


@pytest.mark.parametrize("orientation", get_args(Orientation))
def test_centre_stays_the_centre_when_turned(orientation):
    for height, width in ((8, 6), (7, 6), (8, 5)):
        psf = torch.zeros(1, 1, height, width)
        psf[..., height // 2, width // 2] = 1
        turned = turn(psf, orientation)
        assert turned[..., turned.shape[-2] // 2, turned.shape[-1] // 2] == 1


@pytest.mark.usefixtures("unchecked")
def test_unknown_orientation_names_the_nearest(caustic):
    with pytest.raises(UnknownNameError, match=r"'rotate90'.*'rotate-90'"):
        Calibration.from_array(caustic.astype(np.float32), psf_orientation="rotate90")


# --- Colours ------------------------------------------------------------------------------------------


def mosaicked(image, mosaic):
    """What a sensor under a colour filter array stores of (1, 3, H, W): (H, W) numbers."""
    raw = np.zeros(image.shape[-2:], np.float32)
    for place, letter in enumerate(mosaic):
        row, column = divmod(place, 2)
        raw[row::2, column::2] = image[0, "rgb".index(letter), row::2, column::2]
    return raw


@pytest.mark.parametrize("mosaic", ["rggb", "gbrg"])
def test_raw_mosaics_become_a_psf_and_measurements_in_colour(tmp_path, generator, mosaic):
    """A bright point in another place of the scene casts the PSF there, whatever cells it falls on."""
    light = contour_psf((64, 64), cell=16, generator=generator) * torch.tensor([0.9, 0.6, 0.3])[:, None, None]
    light = torch.nn.functional.pad(light / light.max(), (8, 8, 8, 8))
    dark = np.full((80, 80), 0.1, np.float32)
    np.save(tmp_path / "psf.npy", mosaicked(light, mosaic) + dark)
    np.save(tmp_path / "dark.npy", dark)
    options = {"dark": tmp_path / "dark.npy", "background": 0.0, "mosaic": mosaic}
    calibration = Calibration.from_file(tmp_path / "psf.npy", **options)
    assert calibration.psf.shape == (1, 3, 40, 40)
    measurement = calibration.correct((mosaicked(light.roll((4, -6), (-2, -1)), mosaic) + dark)[..., None])
    expected = calibration.psf.roll((2, -3), (-2, -1))
    torch.testing.assert_close(measurement / measurement.sum((-2, -1), keepdim=True), expected, atol=1e-7, rtol=1e-4)
    with pytest.raises(ShapeError, match=r"`grey=True`.*`mosaic='rggb'`"):
        Calibration(calibration.psf).correct(np.ones((40, 40, 1), np.float32))
    with pytest.raises(ShapeError, match="mosaic"):
        Calibration(calibration.psf, FrameFormat(mosaic=mosaic)).correct(np.ones((80, 80, 3), np.float32))


def test_grey_averages_psf_and_captures(tmp_path, caustic):
    np.save(tmp_path / "psf.npy", coloured(caustic))
    calibration = Calibration.from_file(tmp_path / "psf.npy", background=0.0, grey=True)
    mean = coloured(caustic).mean(-1)
    np.testing.assert_allclose(calibration.psf[0, 0], mean / mean.sum(), rtol=1e-5)
    frame = np.random.default_rng(0).random((*SIZE, 3), np.float32)
    for capture in (frame, frame.mean(-1, keepdims=True)):
        np.testing.assert_allclose(calibration.correct(capture)[0, 0], frame.mean(-1), rtol=1e-5)


def test_psf_that_was_subtracted_before_gets_no_light_added(tmp_path, caustic):
    noise = np.random.default_rng(0).normal(0, 0.01, caustic.shape)
    np.save(tmp_path / "psf.npy", (caustic + noise).astype(np.float32))
    assert Calibration.from_file(tmp_path / "psf.npy").background == (0.0,)


# --- Hash ---------------------------------------------------------------------------------------------


def test_hash_is_that_of_the_content(tmp_path, caustic):
    frame = (caustic * 65535).astype(np.uint16)[..., None]
    one = Calibration.from_file(store(tmp_path / "a.png", frame)).psf_hash
    assert re.fullmatch(r"[0-9a-f]{16}", one)
    assert one == Calibration.from_file(store(tmp_path / "b.tif", frame)).psf_hash
    frame[20, 20] += 1
    assert one != Calibration.from_file(store(tmp_path / "a.png", frame)).psf_hash


def test_hash_is_the_same_in_every_process_and_knows_the_shape():
    psf = torch.tensor([1, 1, 1, 2, 1, 1, 2, 3, 1, 1, 1, 1]).reshape(1, 1, 3, 4) / 16
    assert Calibration(psf).psf_hash == "841544b6ce2c67ae"
    assert Calibration(psf.reshape(1, 1, 4, 3)).psf_hash != "841544b6ce2c67ae"
    assert Calibration(psf.movedim(-1, -2).contiguous().movedim(-1, -2)).psf_hash == "841544b6ce2c67ae"


# --- Refusals -----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("dtype", "top", "bit_depth", "bits"),
    [
        ("u1", 255, None, 8),
        ("u2", 65535, None, 16),
        ("u2", 4095, 12, 12),
        ("u2", 65520, None, 16),
        ("u2", 4095, None, 12),
        ("u2", 1023, None, 10),
    ],
    ids=["8", "16", "12 of 16", "12 in the upper bits", "12 in the lower bits, unsaid", "10 likewise"],
)
def test_saturated_psf(tmp_path, caustic, dtype, top, bit_depth, bits):
    frame = (1.5 * caustic * top).clip(0, top).astype(dtype)[..., None]
    full = (frame == top).sum()
    assert full > 2
    message = f"PSF is saturated: {full:,} of 1,920 pixels are at the {bits}-bit maximum {top}. Lower the exposure"
    with pytest.raises(PsfError, match=re.escape(message)):
        Calibration.from_file(store(tmp_path / "psf.png", frame), bit_depth=bit_depth)


def test_one_saturated_channel_is_enough(tmp_path, caustic):
    light = coloured(caustic) * np.array([1, 2.5, 1])
    with pytest.raises(PsfError, match="PSF is saturated"):
        Calibration.from_file(store(tmp_path / "psf.png", (light.clip(0, 1) * 255).astype(np.uint8)))


def test_a_hot_pixel_is_no_saturation(tmp_path, caustic):
    frame = (caustic * 200).astype(np.uint8)[..., None]
    frame[3, 3] = 255
    assert Calibration.from_file(store(tmp_path / "psf.png", frame)).size == SIZE


@pytest.mark.parametrize("background", ["estimate", 0.0, 0.5])
def test_empty_psf(tmp_path, background):
    frame = np.full((8, 8, 3), 100, np.uint8)
    frame[..., 1] = 0
    with pytest.raises(PsfError, match=r"PSF is empty: no light is left in .*green.*Expose longer"):
        Calibration.from_file(store(tmp_path / "psf.png", frame), background=background)


def test_empty_psf_says_which_colour_and_why(tmp_path):
    frame = np.zeros((8, 8, 3), np.uint8)
    frame[2, 2] = 100, 100, 0
    store(tmp_path / "psf.png", frame)
    with pytest.raises(PsfError, match=r"no light is left in blue .* Expose longer\.$"):
        Calibration.from_file(tmp_path / "psf.png")
    with pytest.raises(PsfError, match=r"Expose longer, or take the dark frame without light\.$"):
        Calibration.from_file(tmp_path / "psf.png", dark=tmp_path / "psf.png")


def test_nan_in_the_file(tmp_path, caustic):
    caustic[3, 4] = np.nan
    with pytest.raises(ImageError, match="holds NaN or infinity"):
        Calibration.from_file(store(tmp_path / "psf.npy", caustic[..., None]))


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_nan_in_the_tensor(value):
    with pytest.raises(PsfError, match="`psf` holds NaN or infinity"):
        Calibration(torch.full((1, 1, 4, 4), value))


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize("shape", [(1, 2, 4, 4), (1, 4, 4, 4), (2, 1, 4, 4), (3, 4, 4), (1, 3), (4,)])
def test_wrong_axes(shape):
    with pytest.raises(PsfError, match=re.escape(f"`psf` {shape} must be (1, 1 or 3, H, W): grey or RGB.")):
        Calibration(torch.ones(shape))


def test_negative_or_dark_psf():
    with pytest.raises(PsfError, match=r"`psf` \(smallest value -1, .*must not be negative"):
        Calibration(-torch.ones(1, 1, 4, 4))
    dark = torch.ones(1, 3, 4, 4)
    dark[:, 1] = 0
    with pytest.raises(PsfError, match="must hold light in each channel"):
        Calibration(dark)


def test_two_channels_in_the_file(tmp_path):
    np.save(tmp_path / "psf.npy", np.ones((8, 8, 2), np.uint8))
    with pytest.raises(ImageError, match=r"has the shape \(8 x 8 x 2\)"):
        Calibration.from_file(tmp_path / "psf.npy")


@pytest.mark.parametrize("background", [-0.1, 1.0, float("nan")])
def test_background_out_of_range(tmp_path, caustic, background):
    path = store(tmp_path / "psf.png", (caustic * 255).astype(np.uint8)[..., None])
    with pytest.raises(ParameterError, match=r"`background` \(.*\).* must be (in \[0, 1\)|finite)"):
        Calibration.from_file(path, background=background)


def test_dark_frame_of_another_size(tmp_path, caustic):
    path = store(tmp_path / "psf.png", (caustic * 255).astype(np.uint8)[..., None])
    dark = store(tmp_path / "dark.png", np.zeros((24, 20, 1), np.uint8))
    with pytest.raises(ShapeError, match=r"`dark` .*\(1, 24, 20\), must have the size of the frame \(1, 48, 40\)"):
        Calibration.from_file(path, dark=dark)


@pytest.mark.parametrize(
    ("psf", "binning", "capture", "way_out"),
    [
        ((24, 16), 1, (48, 32), "The capture is 2 times as large: bin it by 2, `bin=2, psf_bin=1`."),
        ((64, 60), 1, (16, 15), "The PSF is 4 times as large: bin it by 4, `psf_bin=4`."),
        ((16, 12), 1, (4, 3), "Use the PSF that belongs to this camera."),  # nothing is left to be seen
        ((8, 6), 1, (9, 12), "Crop the capture around its centre: `crop=(8, 6)`."),
        ((8, 6), 2, (18, 14), "Crop the capture around its centre: `crop=(16, 12)`."),  # in raw pixels
        ((8, 6), 1, (7, 12), "Use the PSF that belongs to this camera."),
    ],
)
def test_capture_of_another_size(psf, binning, capture, way_out):
    height, width = (n // binning for n in capture)
    message = f"`psf` ({psf[0]} x {psf[1]}) and the capture ({height} x {width}) must have the same height and width. "
    with pytest.raises(ShapeError, match=re.escape(message + way_out)):
        Calibration(torch.ones(1, 1, *psf), FrameFormat(bin=binning)).correct(np.zeros((*capture, 1), np.uint8))


def test_grey_capture_of_a_colour_psf():
    with pytest.raises(ShapeError, match="The capture is grey, but `psf` has colours"):
        Calibration(torch.ones(1, 3, 4, 4)).correct(np.zeros((4, 4, 1), np.uint8))


def test_psf_of_another_resolution_than_the_captures(tmp_path, generator):
    """The captures were binned by 4 in the camera, the PSF was not: crop and dark frame belong to the captures."""
    raw = 0.2 * torch.rand(48, 64, 1, generator=generator).numpy()
    small = raw.reshape(12, 4, 16, 4, 1).mean((1, 3))
    np.save(tmp_path / "raw.npy", raw)
    np.save(tmp_path / "small.npy", small)
    np.save(tmp_path / "dark.npy", np.zeros_like(small))
    options = {"background": 0.0, "crop": (8, 10)}
    calibration = Calibration.from_file(tmp_path / "raw.npy", psf_bin=4, dark=tmp_path / "dark.npy", **options)
    torch.testing.assert_close(calibration.psf, Calibration.from_file(tmp_path / "small.npy", **options).psf)
    assert calibration.correct(small).shape == (1, 1, 8, 10)
    with pytest.raises(ParameterError, match=r"`bin` \(0\) must be at least 1"):
        Calibration.from_file(tmp_path / "raw.npy", bin=0, psf_bin=4)


def test_fields_of_the_format_are_keywords(tmp_path, caustic):
    path = store(tmp_path / "psf.npy", (caustic * 255).astype(np.uint8)[..., None])
    calibration = Calibration.from_file(path, FrameFormat(bin=2, grey=True), bin=4)
    assert calibration.frames == FrameFormat(bin=4, grey=True)
    with pytest.raises(UnknownNameError, match=r"'bitdepth'.*'bit_depth'"):
        Calibration.from_file(path, bitdepth=8)


def test_old_keywords_work_and_name_the_new_ones(tmp_path, caustic):
    path = store(tmp_path / "psf.npy", (caustic * 255).astype(np.uint8)[..., None])
    with pytest.warns(DeprecationWarning, match="`bin=2`"), pytest.warns(DeprecationWarning, match="`psf_bin=4`"):
        old = Calibration.from_file(path, binning=2, psf_binning=4)
    assert (old.frames.bin, old.psf_hash) == (2, Calibration.from_file(path, bin=2, psf_bin=4).psf_hash)


def test_the_psf_may_have_other_bits_than_the_captures():
    """`--bit-depth 12` for the captures was refused with a PSF of 8 bits, and there was no other way."""
    psf = np.zeros((20, 24, 3), np.uint8)
    psf[8:12, 9:14] = 200
    with pytest.raises(ParameterError, match=r"`bit_depth` \(12\) must be at most 8.*`psf_bit_depth`"):
        Calibration.from_array(psf, bit_depth=12)
    calibration = Calibration.from_array(psf, bit_depth=12, psf_bit_depth=8, background=0.0)
    torch.testing.assert_close(calibration.psf, Calibration.from_array(psf, background=0.0).psf)
    assert calibration.correct(np.full((20, 24, 3), 4095, np.uint16)).max() == 1
    for bits in (0, 17):
        with pytest.raises(ParameterError, match=rf"`psf_bit_depth` \({bits}\)"):
            Calibration.from_array(psf, psf_bit_depth=bits)


def test_fractions_of_saturation_are_no_numbers_of_the_sensor(caustic):
    """Floats up to 1 were divided by 4,095, and the capture was called dark."""
    frame = (0.9 * caustic / caustic.max())[..., None].astype(np.float32)
    calibration = Calibration.from_array((frame * 4095).astype(np.uint16), bit_depth=12)
    with pytest.raises(ParameterError, match=r"floats up to 0\.9, but `bit_depth` \(12\).*by 4,095"):
        calibration.correct(frame)
    assert calibration.correct(frame * 4095).max() == pytest.approx(0.9, rel=1e-3)

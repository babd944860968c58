"""From raw frames to measurements: levels, gamma, and the steps in their order."""

import numpy as np
import pytest
import torch

from mwdn.calibration import FrameFormat
from mwdn.calibration.frame_operations import crop_centre
from mwdn.errors import ParameterError, UnknownNameError
from mwdn.io.images import srgb_encode


@pytest.mark.parametrize(
    ("dtype", "bit_depth", "expected"),
    [("u1", None, 255), ("u2", None, 65535), ("f4", None, 1), ("u2", 12, 4095), ("u2", 16, 65535), ("u1", 1, 1)],
)
def test_full_scale(dtype, bit_depth, expected):
    assert FrameFormat(bit_depth=bit_depth).full_scale(np.ones((2, 2, 1), dtype)) == expected


@pytest.mark.parametrize("bit_depth", [0, -1, 17])
def test_bit_depth_is_1_to_16(bit_depth):
    with pytest.raises(ParameterError, match=rf"`bit_depth` \({bit_depth}\) must be 1 to 16"):
        FrameFormat(bit_depth=bit_depth)


def test_frame_of_more_bits_than_said():
    frame = np.full((2, 2, 1), 5000, np.uint16)
    with pytest.raises(ParameterError, match=r"`bit_depth` \(12\) allows .* 4,095, .* holds 5,000: .* least 13 bits"):
        FrameFormat(bit_depth=12).full_scale(frame)


def test_file_of_fewer_bits_than_said():
    with pytest.raises(ParameterError, match=r"`bit_depth` \(12\) must be at most 8"):
        FrameFormat(bit_depth=12).full_scale(np.ones((2, 2, 1), np.uint8))


def test_normalise_moves_the_channels_first():
    frame = np.arange(24, dtype=np.uint8).reshape(2, 4, 3)
    image = FrameFormat().normalise(frame)
    assert image.shape == (1, 3, 2, 4)
    assert image[0, 2, 1, 3].item() == pytest.approx(23 / 255)
    assert image[0, 0, 1, 0].item() == pytest.approx(12 / 255)


@pytest.mark.usefixtures("unchecked")
def test_wrong_numbers():
    with pytest.raises(ParameterError, match=r"`bin` \(0\)"):
        FrameFormat(bin=0)
    with pytest.raises(UnknownNameError, match="'rgbg'"):
        FrameFormat(mosaic="rgbg")


def test_steps_in_their_order():
    """16 - 1 at the colours' offsets, twice as wide as the crop and binned; row 0 of the file comes last."""
    frame = np.full((16, 24, 1), 1, np.uint8)
    frame[4:8, 8:16] += 4  # row 2 to 3 and column 4 to 7 of 8 x 12 cells
    frames = FrameFormat(bit_depth=4, mosaic="rggb", grey=True, crop=(8, 8), bin=2, upside_down=True)
    dark = torch.full((1, 1, 16, 24), 1 / 15)
    expected = torch.tensor([[[[0.0, 0.0], [4 / 15, 4 / 15]]]])
    torch.testing.assert_close(frames.to_measurement(frame, dark), expected)


@pytest.mark.parametrize("size", [(16, 24), (18, 22)])
@pytest.mark.parametrize("mosaic", ["rggb", "gbrg"])
def test_crop_is_in_raw_pixels_with_and_without_a_mosaic(size, mosaic, generator):
    frame = torch.rand(*size, 1, generator=generator).numpy()
    cropped = FrameFormat(mosaic=mosaic, crop=(8, 12)).to_measurement(frame)
    whole = FrameFormat(mosaic=mosaic).to_measurement(frame)
    assert cropped.shape[-2:] == (4, 6)
    assert torch.equal(cropped, crop_centre(whole, (4, 6)))
    assert FrameFormat(crop=(8, 12)).to_measurement(frame).shape[-2:] == (8, 12)
    with pytest.raises(ParameterError, match=r"`crop` \(9 x 12\) must be even.*`crop=\(8, 12\)`"):
        FrameFormat(mosaic=mosaic, crop=(9, 12))


def test_crop_of_a_mosaic_stays_even_at_another_resolution():
    frames = FrameFormat(mosaic="rggb", crop=(10, 20), bin=2).with_bin(3)
    assert frames == FrameFormat(mosaic="rggb", crop=(14, 30), bin=3)  # 7.5 cells are not


@pytest.mark.parametrize("gamma", ["srgb", 2.2, 1.0, None])
def test_gamma_is_decoded_to_linear_light(gamma, generator):
    """A step of 16 bits is at most 2.4 / 65535 of the light."""
    light = torch.rand(1, 3, 5, 6, generator=generator)
    coded = srgb_encode(light) if gamma == "srgb" else light ** (1 / (gamma or 1))
    frame = (coded[0].movedim(0, -1) * 65535).round().numpy().astype(np.uint16)
    torch.testing.assert_close(FrameFormat(gamma=gamma).normalise(frame), light, atol=2.4 / 65535, rtol=0)


@pytest.mark.parametrize("gamma", [0.9, 4.1, float("nan"), "rgb"])
@pytest.mark.usefixtures("unchecked")
def test_gamma_is_srgb_or_a_number(gamma):
    with pytest.raises(ParameterError, match=rf"`gamma` \('?{gamma}'?\).* must be ('?srgb'?,( or)? a number|finite)"):
        FrameFormat(gamma=gamma)


def test_dark_frame_of_a_gamma_coded_camera_is_decoded_too(generator):
    """Light adds up before the encoding: dark level and scene are subtracted in linear light."""
    light, dark = 0.7 * torch.rand(4, 6, 1, generator=generator), torch.full((4, 6, 1), 0.2)
    frames = FrameFormat(gamma=2.2)
    coded, coded_dark = ((image ** (1 / 2.2)).numpy() for image in (light + dark, dark))
    measurement = frames.to_measurement(coded, frames.normalise(coded_dark))
    torch.testing.assert_close(measurement[0].movedim(0, -1), light, atol=1e-6, rtol=0)


def test_another_resolution_scales_the_crop():
    assert FrameFormat(bin=2, crop=(100, 60)).with_bin(4) == FrameFormat(bin=4, crop=(200, 120))
    assert FrameFormat(bin=2).with_bin(4) == FrameFormat(bin=4)


def test_a_stated_mosaic_is_taken_or_must_be_the_same():
    assert FrameFormat().with_mosaic("gbrg", of="the camera") == FrameFormat(mosaic="gbrg")
    for stated in (None, "rggb"):
        assert FrameFormat(mosaic="rggb").with_mosaic(stated, of="the camera") == FrameFormat(mosaic="rggb")
    with pytest.raises(ParameterError, match=r"rggb.*the camera.*gbrg"):
        FrameFormat(mosaic="rggb").with_mosaic("gbrg", of="the camera")

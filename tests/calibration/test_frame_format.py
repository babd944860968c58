"""From raw frames to measurements: levels, mosaic, crop, binning."""

import numpy as np
import pytest
import torch

from mwdn.calibration import FrameFormat
from mwdn.calibration.frame_format import bin_pixels, crop_centre, demosaic
from mwdn.errors import ParameterError, ShapeError, UnknownNameError


def delta(height, width):
    image = torch.zeros(1, 1, height, width)
    image[..., height // 2, width // 2] = 1
    return image


def place(image):
    """Row and column of the largest pixel."""
    return divmod(int(image.flatten().argmax()), image.shape[-1])


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


@pytest.mark.parametrize("size", [(9, 9), (8, 9), (9, 8), (8, 8)])
@pytest.mark.parametrize("crop", [(1, 1), (2, 2), (3, 4), (5, 6), (8, 7), (8, 8)])
def test_centre_stays_the_centre_under_a_crop(size, crop):
    cropped = crop_centre(delta(*size), crop)
    assert cropped.shape[-2:] == crop
    assert place(cropped) == (crop[0] // 2, crop[1] // 2)


@pytest.mark.parametrize("crop", [(10, 4), (4, 9), (0, 3), (3, -2)])
def test_crop_must_be_within_the_frame(crop):
    with pytest.raises(ShapeError, match=rf"`crop` \({crop[0]} x {crop[1]}\) must be within the frame \(8 x 8\)"):
        crop_centre(torch.zeros(1, 1, 8, 8), crop)


@pytest.mark.parametrize("factor", [1, 2, 3, 4, 5])
def test_centre_stays_the_centre_under_binning(factor):
    for length in range(factor, 31):
        binned = bin_pixels(delta(length, 30), factor)
        blocks = length // factor, 30 // factor
        assert binned.shape[-2:] == blocks
        assert place(binned) == (blocks[0] // 2, blocks[1] // 2), f"{length} by {factor}"
        assert binned.sum().item() == pytest.approx(1 / factor**2)


def test_binning_averages_blocks(generator):
    image = torch.rand(1, 3, 6, 4, generator=generator)
    expected = image.reshape(1, 3, 3, 2, 2, 2).mean((-3, -1))
    torch.testing.assert_close(bin_pixels(image, 2), expected)
    assert bin_pixels(image, 1) is image


@pytest.mark.parametrize("factor", [0, -1, 5])
def test_binning_factor_is_within_the_frame(factor):
    with pytest.raises(ParameterError, match=rf"`bin` \({factor}\) must be at least 1 and at most 4"):
        bin_pixels(torch.zeros(1, 1, 9, 4), factor)


@pytest.mark.parametrize("mosaic", ["rggb", "bggr", "grbg", "gbrg"])
def test_cells_of_a_mosaic_become_pixels(mosaic):
    """Against a picture of known colours, sampled by the filters."""
    colours = torch.rand(2, 3, 4, 6)
    image = torch.zeros(2, 1, 8, 12)
    for place, letter in enumerate(mosaic):
        row, column = divmod(place, 2)
        image[:, 0, row::2, column::2] = colours[:, "rgb".index(letter)] + (0.1 * row if letter == "g" else 0)
    colours[:, 1] += 0.05  # the two greens differ by their row
    torch.testing.assert_close(demosaic(image, mosaic), colours)


def test_a_mosaic_has_one_channel_and_even_sides():
    for shape, said in (((1, 3, 8, 8), "3 x 8 x 8"), ((1, 1, 7, 8), "1 x 7 x 8")):
        with pytest.raises(ShapeError, match=rf"A raw mosaic \({said}\) must have one channel and even sides"):
            demosaic(torch.zeros(shape), "rggb")


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
    frames = FrameFormat(bit_depth=4, mosaic="rggb", grey=True, crop=(4, 4), bin=2, upside_down=True)
    dark = torch.full((1, 1, 16, 24), 1 / 15)
    expected = torch.tensor([[[[0.0, 0.0], [4 / 15, 4 / 15]]]])
    torch.testing.assert_close(frames.to_measurement(frame, dark), expected)


def test_another_resolution_scales_the_crop():
    assert FrameFormat(bin=2, crop=(100, 60)).with_bin(4) == FrameFormat(bin=4, crop=(200, 120))
    assert FrameFormat(bin=2).with_bin(4) == FrameFormat(bin=4)

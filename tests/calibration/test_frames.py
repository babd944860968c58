"""Levels, crop and binning of frames; where the centre goes under them."""

import numpy as np
import pytest
import torch

from mwdn.calibration.frames import as_image, bin_pixels, crop_centre, demosaiced, estimate_background, full_scale
from mwdn.errors import ParameterError, ShapeError


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
    assert full_scale(np.ones((2, 2, 1), dtype), bit_depth) == expected


@pytest.mark.parametrize("bit_depth", [0, -1, 17])
def test_bit_depth_is_1_to_16(bit_depth):
    with pytest.raises(ParameterError, match=rf"`bit_depth` \({bit_depth}\) must be 1 to 16"):
        full_scale(np.ones((2, 2, 1), np.uint16), bit_depth)


def test_frame_of_more_bits_than_said():
    frame = np.full((2, 2, 1), 5000, np.uint16)
    with pytest.raises(ParameterError, match=r"`bit_depth` \(12\) allows .* 4,095, .* holds 5,000: .* least 13 bits"):
        full_scale(frame, 12)


def test_file_of_fewer_bits_than_said():
    with pytest.raises(ParameterError, match=r"`bit_depth` \(12\) must be at most 8"):
        full_scale(np.ones((2, 2, 1), np.uint8), 12)


def test_as_image_moves_the_channels_first():
    frame = np.arange(24, dtype=np.uint8).reshape(2, 4, 3)
    image = as_image(frame, 255.0)
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
    with pytest.raises(ParameterError, match=rf"`binning` \({factor}\) must be at least 1 and at most 4"):
        bin_pixels(torch.zeros(1, 1, 9, 4), factor)


def test_background_is_the_5th_percentile_of_each_channel(generator):
    ramp = torch.linspace(0, 1, 400)
    image = torch.stack([ramp[torch.randperm(400, generator=generator)], 3 + ramp]).reshape(1, 2, 20, 20)
    torch.testing.assert_close(estimate_background(image).flatten(), torch.tensor([ramp[20], 3 + ramp[20]]))
    assert estimate_background(image).shape == (1, 2, 1, 1)


@pytest.mark.parametrize("mosaic", ["rggb", "bggr", "grbg", "gbrg"])
def test_cells_of_a_mosaic_become_pixels(mosaic):
    """Against a picture of known colours, sampled by the filters."""
    colours = torch.rand(2, 3, 4, 6)
    image = torch.zeros(2, 1, 8, 12)
    for place, letter in enumerate(mosaic):
        row, column = divmod(place, 2)
        image[:, 0, row::2, column::2] = colours[:, "rgb".index(letter)] + (0.1 * row if letter == "g" else 0)
    colours[:, 1] += 0.05  # the two greens differ by their row
    torch.testing.assert_close(demosaiced(image, mosaic), colours)


def test_what_is_no_mosaic():
    for shape, said in (((1, 3, 8, 8), "3 x 8 x 8"), ((1, 1, 7, 8), "1 x 7 x 8")):
        with pytest.raises(ShapeError, match=rf"A raw mosaic \({said}\) must have one channel and even sides"):
            demosaiced(torch.zeros(shape), "rggb")

"""The steps from a raw frame to a measurement: crop, binning, mosaic, and interpolation back to the frame's size."""

import pytest
import torch

from cameras import gaussian_psf
from mwdn import Camera
from mwdn.calibration.frame_operations import bin_pixels, crop_centre, demosaic, enlarge_binned
from mwdn.errors import ParameterError, ShapeError
from mwdn.solvers import Wiener


def delta(height, width):
    image = torch.zeros(1, 1, height, width)
    image[..., height // 2, width // 2] = 1
    return image


def place(image):
    """Row and column of the largest pixel."""
    return divmod(int(image.flatten().argmax()), image.shape[-1])


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
    for shape, said in (((1, 3, 8, 8), r"\(8 x 8\) has 3"), ((1, 1, 7, 8), "7 x 8")):
        with pytest.raises(ShapeError, match=rf"`mosaic` \(rggb\).*{said}"):
            demosaic(torch.zeros(shape), "rggb")


def centroid(image):
    """Row and column, of what is brighter than a tenth of the maximum."""
    light = (image - 0.1 * image.max()).clamp(min=0)[0, 0]
    return [float((light.sum(1 - axis) * torch.arange(n)).sum() / light.sum()) for axis, n in enumerate(light.shape)]


@pytest.mark.parametrize(("size", "factor"), [((120, 130), 2), ((121, 135), 3), ((124, 133), 5)])
def test_reconstruction_of_binned_frames_enlarges_to_its_place(size, factor):
    """A spot through a spot, binned and deconvolved: without the shift by half a block it would lie elsewhere."""
    spot = size[0] // 2 + 7, size[1] // 2 - 9
    psf, scene = gaussian_psf(size, 1.5 * factor), gaussian_psf(size, 2.5 * factor, spot)
    binned_psf, measurement = bin_pixels(psf, factor), bin_pixels(Camera(psf).forward(scene), factor)
    small = Wiener(regularisation=1e-3)(measurement, binned_psf / binned_psf.sum())
    full = enlarge_binned(small, factor, size)
    assert full.shape[-2:] == size
    assert centroid(full) == pytest.approx(spot, abs=0.1)
    assert small.amin() <= full.amin() <= full.amax() <= small.amax()

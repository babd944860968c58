"""The distortion of recorded pairs, measured from reconstructions with noise, blur and shading of their own."""

import numpy as np
import pytest
import torch
from displayed import natural_pictures
from torch.nn import functional as F

from mwdn.optics.distortion import distort
from mwdn.optics.polynomials import polynomials
from mwdn.registration.distortion import measure_distortion

SIZE = 120, 120
TRUE = torch.tensor([[0.02, 0.0, 0.01, 0.015, -0.01, 0.01], [-0.01, 0.01, -0.01, 0.0, 0.02, -0.02]])


def pairs(coefficients, *, noise=0.02, shading=0.4, count=4):
    """Scenes, and reconstructions of them: distorted, blurred, shaded differently, noisy, of another scale."""
    generator = torch.Generator().manual_seed(5)
    scenes = [torch.from_numpy(picture).movedim(-1, 0) for picture in natural_pictures(count, SIZE[0])]
    pictures = []
    for scene in scenes:
        seen = F.avg_pool2d(F.pad(distort(scene[None], coefficients), (1,) * 4, mode="reflect"), 3, 1)[0]
        slope = shading * (2 * torch.rand(3, generator=generator) - 1)
        field = 1 + torch.einsum("k,khw->hw", slope.double(), polynomials(1, SIZE)).float()
        pictures.append(7 * (seen * field + noise * torch.randn(seen.shape, generator=generator)))
    return pictures, scenes


def error_px(found, coefficients):
    """Largest distance of the two displacements over the frame without its rim, in pixels."""
    difference = torch.einsum("ck,khw->chw", found - coefficients, polynomials(2, SIZE)) * (SIZE[0] - 1) / 2
    return float(difference.norm(dim=0)[12:-12, 12:-12].max())


@pytest.mark.parametrize("shading", [0.0, 0.4])
def test_the_distortion_is_found_to_a_fraction_of_a_pixel(shading):
    assert error_px(torch.zeros(2, 6).double(), TRUE.double()) > 2
    assert error_px(measure_distortion(*pairs(TRUE, shading=shading), 2), TRUE.double()) < 0.25


def test_pairs_without_distortion_have_none():
    assert error_px(measure_distortion(*pairs(torch.zeros(2, 6)), 2), torch.zeros(2, 6).double()) < 0.1


def test_pairs_that_do_not_belong_together_have_none():
    pictures, scenes = pairs(torch.zeros(2, 6))
    assert not measure_distortion([pictures[n] for n in (1, 2, 3, 0)], scenes, 2).any()
    dark = [torch.zeros(3, *SIZE)] * 4
    assert not measure_distortion(dark, dark, 2).any()
    assert not measure_distortion(pictures[:1], scenes[:1], 2).any()  # nothing to check it with


def test_scale_and_number_of_colours_do_not_matter():
    pictures, scenes = pairs(TRUE, count=2)
    found = measure_distortion(pictures, scenes, 2)
    scaled = measure_distortion([100 * each for each in pictures], [each / 100 for each in scenes], 2)
    np.testing.assert_allclose(scaled, found, atol=1e-5)
    grey = measure_distortion(
        [each.mean(0, keepdim=True) for each in pictures], [s.mean(0, keepdim=True) for s in scenes], 2
    )
    np.testing.assert_allclose(grey, found, atol=1e-5)

"""The shading of recorded pairs, measured from reconstructions with noise, blur, gains and offsets of their own."""

import pytest
import torch
from displayed import natural_pictures
from torch.nn import functional as F

from mwdn.optics.shading import shade, shading
from mwdn.registration.shading import measure_shading

SIZE = 120, 120
TRUE = torch.tensor(
    [[0.1, -0.2, 0.1, 0.3, 0.1, 0.2], [0.0, -0.2, 0.1, 0.3, 0.0, 0.2], [-0.1, -0.1, 0.2, 0.3, 0.0, 0.2]]
)


def pairs(coefficients=TRUE, *, noise=0.02, offset=0.1, count=4, size=SIZE):
    """Scenes with gains and offsets of their own, and reconstructions of them: of other light, blurred, noisy."""
    generator = torch.Generator().manual_seed(5)
    scenes = [
        torch.from_numpy(picture).movedim(-1, 0)[:, : size[0], : size[1]] for picture in natural_pictures(count, 120)
    ]
    pictures = []
    for number, scene in enumerate(scenes):
        seen = F.avg_pool2d(F.pad(shade(scene[None], -coefficients), (1,) * 4, mode="reflect"), 3, 1)[0]
        pictures.append((7 + number) * (seen + noise * torch.randn(seen.shape, generator=generator)))
    return pictures, [(1 + number) * scene + offset * number for number, scene in enumerate(scenes)]


def ratio(found, true, size=SIZE):
    """Least and largest ratio of two shadings over the frame, up to a common gain."""
    quotient = shading(found, size) / shading(true.double(), size)
    return (quotient / quotient.mean()).aminmax()


@pytest.mark.parametrize("noise", [0.0, 0.02])
def test_the_shading_is_found_to_a_tenth(noise):
    assert min(ratio(torch.zeros(3, 6).double(), TRUE)) < 0.6
    least, most = ratio(measure_shading(*pairs(noise=noise), 2), TRUE)
    assert least > 0.9
    assert most < 1.1


def test_a_gain_of_each_colour_is_the_order_0():
    gains = torch.tensor([[0.2], [0.0], [-0.2]])
    least, most = ratio(measure_shading(*pairs(gains), 0), gains)
    assert least > 0.97
    assert most < 1.03


def test_pairs_that_fit_have_none():
    least, most = ratio(measure_shading(*pairs(torch.zeros(3, 6)), 2), torch.zeros(3, 6))
    assert least > 0.95
    assert most < 1.05


def test_pairs_that_do_not_belong_together_have_little_or_none():
    pictures, scenes = pairs(torch.zeros(3, 6))
    dark = [torch.zeros(3, *SIZE)] * 4
    assert not measure_shading(dark, dark, 2).any()
    assert not measure_shading(pictures[:1], scenes[:1], 2).any()  # nothing to check it with
    broken = [torch.full_like(picture, torch.nan) for picture in pictures]
    assert not measure_shading(broken, scenes, 2).any()


def test_scale_and_size_do_not_matter():
    pictures, scenes = pairs()
    found = measure_shading(pictures, scenes, 2)
    scaled = measure_shading([100 * each for each in pictures], [each / 100 for each in scenes], 2)
    torch.testing.assert_close(scaled, found)
    assert measure_shading(*pairs(size=(9, 11)), 2).shape == (3, 6)


def test_shading_is_a_positive_gain_and_its_inverse_the_negative():
    generator = torch.Generator().manual_seed(1)
    coefficients = torch.randn(3, 6, generator=generator)
    picture = torch.rand(2, 3, 9, 12, generator=generator)
    shaded = shade(picture, coefficients)
    assert (shaded >= 0).all()
    torch.testing.assert_close(shade(shaded, -coefficients), picture)
    torch.testing.assert_close(shade(picture, torch.zeros(3, 1)), picture)
    grey = shade(picture[:, :1], coefficients)
    torch.testing.assert_close(grey, (shaded / picture).prod(1, keepdim=True) ** (1 / 3) * picture[:, :1])
    corner = coefficients @ torch.tensor([1.0, -1, -1, 1, 1, 1])  # 1, y, x, y^2, y x, x^2 at the top left
    torch.testing.assert_close(shaded[..., 0, 0], picture[..., 0, 0] * corner.exp())

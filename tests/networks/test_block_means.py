import pytest
import torch
from torch.nn import functional as F

from mwdn.networks.block_means import block_means


@pytest.mark.parametrize(("size", "block"), [((48, 64), 16), ((37, 50), 8), ((5, 7), 16)])
def test_block_means_are_interpolated_bilinearly(generator, size, block):
    picture = torch.rand(2, 3, *size, generator=generator, dtype=torch.float64)
    padded = F.pad(picture, (0, -size[1] % block, 0, -size[0] % block), mode="replicate")
    expected = F.interpolate(F.avg_pool2d(padded, block), scale_factor=block, mode="bilinear")
    torch.testing.assert_close(block_means(picture, block), expected[..., : size[0], : size[1]])

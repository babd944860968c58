"""How planes are laid out in memory, against torch's own operations."""

import pytest
import torch
from torch.nn import functional as F

from mwdn.fourier import memory_format


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16, torch.float16])
@pytest.mark.parametrize("block", [1, 2, 4])
@pytest.mark.parametrize("shape", [(1, 1, 4, 8), (2, 3, 12, 4), (3, 5, 8, 20)])
def test_folded_is_torchs_unshuffling(shape, block, dtype, generator):
    image = torch.rand(shape, generator=generator).to(dtype)
    for given in (image, image.contiguous(memory_format=torch.channels_last), image.mT):
        found = memory_format.pixel_unshuffle(given, block)
        assert torch.equal(found, F.pixel_unshuffle(given, block))
        assert found.is_contiguous(memory_format=torch.channels_last)


def test_folded_passes_gradients_on(generator):
    image = torch.rand((2, 3, 8, 4), generator=generator, requires_grad=True)
    memory_format.pixel_unshuffle(image, 2).square().sum().backward()
    torch.testing.assert_close(image.grad, 2 * image.detach())

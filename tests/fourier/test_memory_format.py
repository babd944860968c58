"""Memory layouts against torch's own operations."""

import pytest
import torch
from torch.nn import functional as F

from mwdn.fourier import memory_format


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16, torch.float16])
@pytest.mark.parametrize("block", [1, 2, 4])
@pytest.mark.parametrize("shape", [(1, 1, 4, 8), (2, 3, 12, 4), (3, 5, 8, 20)])
def test_pixel_unshuffle_is_torchs(shape, block, dtype, generator):
    image = torch.rand(shape, generator=generator).to(dtype)
    for layout in (image, image.contiguous(memory_format=torch.channels_last), image.mT):
        result = memory_format.pixel_unshuffle(layout, block)
        assert torch.equal(result, F.pixel_unshuffle(layout, block))
        assert result.is_contiguous(memory_format=torch.channels_last)


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
@pytest.mark.parametrize("block", [1, 2, 4])
@pytest.mark.parametrize("shape", [(1, 16, 3, 2), (2, 48, 5, 7), (2, 16, 1, 1)])
def test_pixel_shuffle_is_torchs(shape, block, dtype, generator):
    image = torch.rand(shape, generator=generator).to(dtype)
    for layout in (image, image.contiguous(memory_format=torch.channels_last), image.mT):
        result = memory_format.pixel_shuffle(layout, block)
        assert torch.equal(result, F.pixel_shuffle(layout, block))
        assert result.is_contiguous()


@pytest.mark.parametrize("function", [memory_format.pixel_unshuffle, memory_format.pixel_shuffle])
def test_pixel_shuffles_have_a_gradient(function, generator):
    image = torch.rand((2, 4, 8, 4), generator=generator).contiguous(memory_format=torch.channels_last)
    image.requires_grad_()
    function(image, 2).square().sum().backward()
    torch.testing.assert_close(image.grad, 2 * image.detach())


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
@pytest.mark.parametrize("shape", [(1, 2, 4, 8), (2, 6, 5, 3)])
def test_planes_and_pairs_keep_the_numbers(shape, dtype, generator):
    image = torch.rand(shape, generator=generator).to(dtype)
    for layout in (image, image.contiguous(memory_format=torch.channels_last)):
        planes, pairs = memory_format.contiguous_planes(layout), memory_format.as_complex(layout)
        assert planes.is_contiguous()
        assert torch.equal(planes, image)
        assert torch.equal(pairs, torch.stack([image[:, 0::2], image[:, 1::2]], dim=-1))
        for restored in (memory_format.match_format(layout, planes), memory_format.as_channels(pairs, layout)):
            assert torch.equal(restored, image)
            assert restored.stride() == layout.stride()

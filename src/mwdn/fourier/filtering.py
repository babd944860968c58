"""Filters in the Fourier domain, of one picture or of hundreds of features at once."""

from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from mwdn.fourier.memory_format import as_channels, as_complex, chunked, chunks, contiguous_planes, match_format
from mwdn.fourier.padding import Boundary, Padding, pad
from mwdn.fourier.transforms import (
    filter_field,
    inverse_spectrum,
    plane_spectrum,
    spectrum,
)
from mwdn.types import Size, Spectrum


def filter_image(image: Tensor, transfer: Tensor, grid: Size, boundary: Boundary) -> Tensor:
    """Multiply a picture's spectrum with a transfer function: the picture continued to ``grid``, the result cropped.

    On a CPU a few channels at a time, whose planes stay in its cache: fresh memory for a whole spectrum costs more
    than the transforms. The gradient transforms the picture again rather than keep its spectrum.

    Args:
        image: (B, C, H, W), also in half precision.
        transfer: (1 or B, 1 or C, height, width // 2 + 1), complex.
        grid: (height, width), at least (H, W).
        boundary: see `Boundary`.

    Returns:
        Of the shape, the precision and the memory format of ``image``; computed in float32.
    """
    if torch.compiler.is_compiling():  # also an export: one transform of everything is simpler to write down
        spread = spectrum(pad(image.float(), grid, boundary), grid)
        return inverse_spectrum(transfer * spread, grid, (image.shape[-2], image.shape[-1])).to(image.dtype)
    return _Filter.apply(image, transfer, grid, boundary)  # type: ignore[no-untyped-call]


class _Filter(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, image: Tensor, transfer: Tensor, grid: Size, boundary: Boundary) -> Tensor:  # noqa: ANN401
        ctx.save_for_backward(image, transfer)
        ctx.grid, ctx.boundary = grid, boundary
        function = _filtered
        if transfer.shape[1] == 1 and image.shape[1] % 2 == 0:
            function, transfer = _filtered_pairs, _whole(transfer, grid[1])
        return chunked(lambda few, own: function(few, own, grid, boundary), image, transfer)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, Tensor | None, None, None]:  # noqa: ANN401
        image, transfer = ctx.saved_tensors
        (to_image, to_transfer, *_), grid, size = ctx.needs_input_grad, ctx.grid, (image.shape[-2], image.shape[-1])
        slopes, planes = contiguous_planes(gradient), contiguous_planes(image) if to_transfer else image
        image_slope = torch.empty_like(slopes) if to_image else None
        transfer_slope = torch.zeros_like(transfer) if to_transfer else None
        continued = Padding(size, grid, ctx.boundary, slopes)
        for part in chunks(slopes, grid):
            G = plane_spectrum(slopes[part], grid)
            if transfer_slope is not None:
                of_part = _of(transfer_slope, part)
                product = plane_spectrum(continued(planes[part]), grid).conj().resolve_conj().mul_(G)
                of_part.add_(product.sum_to_size(of_part.shape))
            if image_slope is not None:
                G.mul_(_of(transfer, part).conj())
                image_slope[part] = continued.adjoint(inverse_spectrum(G, grid, grid))
        if transfer_slope is not None:
            # Half a spectrum: a column stands for itself and its mirror image, but for the first and, of an even
            # width, the last; and the inverse transform divides by the number of pixels.
            transfer_slope.div_(grid[0] * grid[1])[..., 1 : (grid[1] + 1) // 2].mul_(2)
        slope = None if image_slope is None else match_format(image, image_slope).to(image.dtype)
        return slope, transfer_slope, None, None


def _filtered(image: Tensor, transfer: Tensor, grid: Size, boundary: Boundary) -> Tensor:
    planes, size = contiguous_planes(image), (image.shape[-2], image.shape[-1])
    result = torch.empty_like(planes)
    continued = Padding(size, grid, boundary, planes)
    for part in chunks(planes, grid):
        V = plane_spectrum(continued(planes[part]), grid).mul_(_of(transfer, part))
        result[part] = inverse_spectrum(V, grid, size)
    return match_format(image, result)


def _filtered_pairs(image: Tensor, transfer: Tensor, grid: Size, boundary: Boundary) -> Tensor:
    """What one filter with a real kernel does to two channels, it does to both at once as a complex plane.

    Its ``transfer`` is the whole spectrum (`_whole`).

    A complex transform of two axes is one call of MKL, there and back; back to real numbers it takes several, with
    copies between them.
    """
    pairs, (height, width) = as_complex(image), (image.shape[-2], image.shape[-1])
    result = torch.empty(pairs.shape, dtype=image.dtype, device=image.device)
    continued = Padding((height, width), grid, boundary, image)
    for part in chunks(pairs, grid):
        both = filter_field(continued(pairs[part]), _of(transfer, part))
        result[part] = torch.view_as_real(both[..., :height, :width])
    return as_channels(result, image)


def _whole(half: Spectrum, width: int) -> Tensor:
    """The spectrum of a real picture of this width, from its half."""
    mirrored = half[..., 1 : (width + 1) // 2].flip((-2, -1)).roll(1, -2).conj()
    return torch.cat([half, mirrored], dim=-1)


def _of(transfer: Tensor, part: tuple[slice, slice]) -> Tensor:
    """What of a transfer function belongs to some channels of a sample."""
    sample, channels = part
    own = transfer[sample] if len(transfer) > 1 else transfer
    return own[:, channels] if own.shape[1] > 1 else own

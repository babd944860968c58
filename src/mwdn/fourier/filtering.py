"""Filtering in the Fourier domain: multiply the spectrum of an image with a transfer function."""

import torch
from torch import Tensor

from mwdn.fourier.fast_filter import FastFilter
from mwdn.fourier.padding import Boundary, pad
from mwdn.fourier.transforms import inverse_spectrum, spectrum
from mwdn.types import Size, size_of


def filter_image(image: Tensor, transfer: Tensor, grid: Size, boundary: Boundary) -> Tensor:
    """Pad an image to ``grid``, multiply its spectrum with a transfer function, invert and crop.

    Runs as `mwdn.fourier.fast_filter`, with `reference_filter` as its definition.

    Args:
        image: (B, C, H, W), also in half precision.
        transfer: (1 or B, 1 or C, height, width // 2 + 1), complex.
        grid: (height, width), at least (H, W).
        boundary: see `Boundary`.

    Returns:
        Shape, precision and memory format of ``image``; computed in float32.
    """
    # `torch.compile` and export trace one transform more easily than a loop. `torch.func` (vmap, jvp, jacrev) cannot
    # follow the loop's writing in place.
    if torch.compiler.is_compiling() or torch._C._are_functorch_transforms_active():
        return reference_filter(image, transfer, grid, boundary)
    return FastFilter.apply(image, transfer, grid, boundary)  # type: ignore[no-untyped-call]


def reference_filter(image: Tensor, transfer: Tensor, grid: Size, boundary: Boundary) -> Tensor:
    """`filter_image` by its definition, ``y = C F^-1(T F(P x))``, for tests and for compilers."""
    V = transfer * spectrum(pad(image.float(), grid, boundary), grid)
    return inverse_spectrum(V, grid, size_of(image)).to(image.dtype)

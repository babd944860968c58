"""The noise of a measurement, estimated from the measurement alone."""

import numpy as np
import torch
from torch import Tensor

from mwdn.arguments import check_batch
from mwdn.types import Image

SAMPLED = 2**15
"""Pixels used for the estimate."""


def noise_level(image: Image, *, parts: int = 16) -> Tensor:
    """Standard deviation of white noise in each channel, (B, C, 1, 1): root mean square over the picture.

    A measurement is smooth from pixel to pixel, so the mixed second difference of 2 x 2 pixels,
    ``d = b[i+1, j+1] - b[i, j+1] - b[i+1, j] + b[i, j]``, is nearly pure noise with twice the standard deviation, and
    ``sigma = median(|d|) / (2 * 0.6745)``; the median ignores the few sharp edges. Shot noise grows with the light, so
    the median over a whole measurement would give the noise of its darker half. The picture is therefore divided into
    parts, whose variances are averaged. About `SAMPLED` pixels are used, evenly spread.

    Args:
        image: (B, C, H, W).
        parts: number of parts along each side, at most; a part has at least 16 x 16 pixels. Use 1 for a PSF, whose
            sharp lines can fill a part.

    Raises:
        ShapeError: the axes are not (B, C, H, W).
        ParameterError: not a tensor of floats.

    References:
        D. L. Donoho and I. M. Johnstone, Biometrika 81, 425 (1994), for the median of the finest detail.
    """
    check_batch(image, "image")
    b = image.float()
    detail = b[..., 1:, 1:] - b[..., :-1, 1:] - b[..., 1:, :-1] + b[..., :-1, :-1]
    if not detail.numel():
        return b.new_zeros((*b.shape[:2], 1, 1))
    rows, columns = (max(1, min(parts, length // 16)) for length in detail.shape[-2:])
    height, width = detail.shape[-2] // rows, detail.shape[-1] // columns
    corner = detail[..., : rows * height, : columns * width]
    pixels = corner.reshape(*b.shape[:2], rows, height, columns, width).transpose(-3, -2).flatten(-2)
    sample = pixels[..., :: max(1, rows * columns * height * width // SAMPLED)]
    deviation = median(sample.abs()) / (2 * 0.6745)
    return deviation.square().mean((-2, -1), keepdim=True).sqrt()


def median(values: Tensor) -> Tensor:
    """``values.median(dim=-1).values``. In inference mode on a CPU numpy takes a fifth of torch's time."""
    plain = type(values) is Tensor and values.is_inference() and not torch.compiler.is_compiling()
    if not plain or values.device.type != "cpu" or values.isnan().any():  # numpy's NaN are the largest values
        return values.median(dim=-1).values
    middle = (values.shape[-1] - 1) // 2
    return torch.from_numpy(np.partition(values.numpy(), middle)[..., middle])

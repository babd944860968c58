"""The noise of a measurement, estimated from the measurement alone."""

from torch import Tensor

from mwdn.types import Image

SAMPLED = 2**15
"""Pixels from which the noise is told."""


def noise_level(image: Image, *, parts: int = 16) -> Tensor:
    """Standard deviation of the noise of each channel, (B, C, 1, 1), if it is white: root mean square over the picture.

    A caustic pattern is smooth from pixel to pixel, so the mixed second difference of 2 x 2 pixels holds nothing
    but noise, with twice its standard deviation; the median of its size keeps the few sharp edges out. The noise of
    light grows with the light: the median of a whole measurement tells that of its darker half, half of the mean and
    less where wide places are dark. So each part is looked at alone. Of a large picture some `SAMPLED` pixels, evenly
    spread, are looked at.

    Args:
        image: (B, C, H, W).
        parts: at most, along each side, of 16 pixels at least. 1 for a PSF, whose sharp lines fill some parts.

    References:
        D. L. Donoho and I. M. Johnstone, Biometrika 81, 425 (1994), for the median of the finest detail.
    """
    b = image.float()
    detail = b[..., 1:, 1:] - b[..., :-1, 1:] - b[..., 1:, :-1] + b[..., :-1, :-1]
    if not detail.numel():
        return b.new_zeros((*b.shape[:2], 1, 1))
    rows, columns = (max(1, min(parts, length // 16)) for length in detail.shape[-2:])
    height, width = detail.shape[-2] // rows, detail.shape[-1] // columns
    corner = detail[..., : rows * height, : columns * width]
    pixels = corner.reshape(*b.shape[:2], rows, height, columns, width).transpose(-3, -2).flatten(-2)
    sample = pixels[..., :: max(1, rows * columns * height * width // SAMPLED)]
    deviation = sample.abs().median(dim=-1).values / (2 * 0.6745)
    return deviation.square().mean((-2, -1), keepdim=True).sqrt()

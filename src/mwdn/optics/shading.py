"""Shading of pictures: gains over the frame in each colour, as exponentials of polynomials, so positive."""

from torch import Tensor

from mwdn.optics.polynomials import frame_places, polynomial
from mwdn.types import Image, Size, size_of


def shading(coefficients: Tensor, size: Size) -> Tensor:
    """Gains (C, height, width) of a frame: ``S(p) = exp(sum_k c_k P_k(p))``, p from -1 to 1 over the frame.

    Args:
        coefficients: c, (C, K).
        size: of the frame.
    """
    return polynomial(coefficients, *frame_places(size)).exp()


def shade(picture: Image, coefficients: Tensor) -> Image:
    """The picture (B, C, H, W) times `shading`; a grey picture times the geometric mean of the colours'."""
    if picture.shape[1] == 1:
        coefficients = coefficients.mean(0, keepdim=True)
    return picture * shading(coefficients, size_of(picture)).to(picture)

"""Fourier transforms as products with real matrices, for runtimes without fast transforms or complex numbers.

onnxruntime's own transform takes 20 to 50 times as long as `mwdn.fourier`, and loses two digits unless the length is a
power of two. A product with a matrix of cosines and sines takes 2 to 3 times as long, and loses none. Rows are real and
take one product. Columns take two smaller ones (N = N1 N2, after Cooley and Tukey), with a tenth of the arithmetic.

Scaling is that of `mwdn.fourier`. The angles are float64, the matrices float32.

References:
    J. W. Cooley and J. W. Tukey, An algorithm for the machine calculation of complex Fourier series, Mathematics of
    Computation 19, 297 (1965).
"""

import math
from functools import cache
from typing import NamedTuple

import torch
from torch import Tensor


class Columns(NamedTuple):
    """Two matrices that transform columns of N1 N2 points, from point n = n1 N2 + n2 to frequency k = k1 + N1 k2.

    exp(-2 pi i n k / N) = exp(-2 pi i n1 k1 / N1) exp(-2 pi i n2 k / N), as n1 N2 N1 k2 is a multiple of N. ``first``
    sums over n1 for each k1 and n2, ``second`` sums over n2 for each k.

    Attributes:
        first: (2 N1, 2 rows); its columns are the real, then the imaginary values of n1, its rows the real and the
            imaginary sum of each k1.
        second: (N1, 2 k2, 2 N2), one matrix for each k1; its columns are the real, then the imaginary sums of n2, its
            rows the real, then the imaginary frequencies of k2.
    """

    first: Tensor
    second: Tensor

    @property
    def parts(self) -> int:
        """N1."""
        return self.second.shape[0]

    @property
    def points(self) -> int:
        """N2."""
        return self.second.shape[2] // 2

    @property
    def rows(self) -> int:
        """Number of values of n1; the points beyond are zero."""
        return self.first.shape[1] // 2


@cache
def row_matrix(given: int, length: int) -> Tensor:
    """From ``given`` points, zero-padded to ``length``, to half their spectrum: (given, 2 (length // 2 + 1))."""
    angle = _angle(torch.arange(given)[:, None] * torch.arange(length // 2 + 1), length)
    return torch.cat([angle.cos(), -angle.sin()], dim=1).float()


@cache
def inverse_row_matrix(length: int, kept: int) -> Tensor:
    """From half a spectrum to the first ``kept`` of ``length`` points: (2 (length // 2 + 1), kept)."""
    # Each frequency also stands for its mirror image, except the first and, for an even length, the last.
    half = torch.arange(length // 2 + 1)[:, None]
    weight = torch.where((half == 0) | (2 * half == length), 1.0, 2.0).double() / length
    angle = _angle(half * torch.arange(kept), length)
    return torch.cat([weight * angle.cos(), -weight * angle.sin()]).float()


@cache
def column_matrices(length: int, given: int, kept: int, *, inverse: bool) -> Columns:
    """Matrices for columns of ``given`` points, zero-padded to ``length``, and their first ``kept`` frequencies.

    Args:
        length: of the transform; a prime length has no factors and takes one full product.
        given: number of points, at most ``length``.
        kept: number of frequencies, at most ``length``.
        inverse: make the inverse transform, divided by ``length``.
    """
    parts = _factor(length, given, kept)
    points, sign = length // parts, 1 if inverse else -1
    n1, k2 = torch.arange(-(-given // points)), torch.arange(-(-kept // parts))
    k1, n2 = torch.arange(parts), torch.arange(points)
    first = _complex(sign * _angle(k1[:, None] * n1, parts))
    frequency = k1[:, None, None] + parts * k2[:, None]
    second = _complex(sign * _angle(frequency * n2, length)) / (length if inverse else 1)
    return Columns(first.reshape(2 * parts, -1).float(), second.flatten(3).movedim(2, 1).flatten(1, 2).float())


def _factor(length: int, given: int, kept: int) -> int:
    """The cheapest N1. Copying a number takes as long as about 100 multiplications."""

    def cost(parts: int) -> int:
        points = length // parts
        rows, frequencies = -(-given // points), -(-kept // parts)
        copied = (rows * points > given) * given + (frequencies * parts > kept) * kept
        return 4 * parts * points * (rows + frequencies) + 100 * copied

    return min((n for n in range(1, length + 1) if length % n == 0), key=cost)


def _angle(steps: Tensor, length: int) -> Tensor:
    """2 pi steps / length, without whole turns, which would cost digits."""
    return (steps % length).double() * (2 * math.pi / length)


def _complex(angle: Tensor) -> Tensor:
    """Multiplication by exp(i angle) as real 2 x 2 matrices: (..., rows, columns) to (..., rows, 2, 2, columns)."""
    c, s = angle.cos(), angle.sin()
    return torch.stack([torch.stack([c, -s], dim=-2), torch.stack([s, c], dim=-2)], dim=-3)

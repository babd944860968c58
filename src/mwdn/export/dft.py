"""Matrices of Fourier transforms, in real numbers: for programs that know neither transforms nor complex numbers.

onnxruntime's own transform takes 20 to 50 times as long as `mwdn.fourier`, and loses two digits unless the length is a
power of two. A product with a matrix of cosines and sines takes 2 to 3 times as long, and loses none. Rows take one
product, which knows that they are real; columns two small ones (N = N1 N2, after Cooley and Tukey), a tenth of the
arithmetic.

Scaled as `mwdn.fourier` does. The angles are float64, the matrices float32.

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
    """What transforms columns of N1 N2 points: point n = n1 N2 + n2 to frequency k = k1 + N1 k2.

    ``first``, (2 N1, 2 rows), is multiplied with the values of n1, real ones before imaginary ones, for all n2; it
    gives N1 times a real and an imaginary row. ``second``, (N1, 2 k2, 2 N2), is multiplied with these, and gives N1
    times the real ones of k2 before the imaginary ones.
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
        """How many values of n1 there are; beyond them all is zero."""
        return self.first.shape[1] // 2


@cache
def row_matrix(given: int, length: int) -> Tensor:
    """Half the spectrum of rows of ``given`` points, continued with zeros: (given, 2 (length // 2 + 1))."""
    angle = _angle(torch.arange(given)[:, None] * torch.arange(length // 2 + 1), length)
    return torch.cat([angle.cos(), -angle.sin()], dim=1).float()


@cache
def inverse_row_matrix(length: int, kept: int) -> Tensor:
    """From half a spectrum to the first ``kept`` of ``length`` points: (2 (length // 2 + 1), kept)."""
    # A frequency stands for itself and its mirror image, but for the first and, of an even length, the last.
    half = torch.arange(length // 2 + 1)[:, None]
    weight = torch.where((half == 0) | (2 * half == length), 1.0, 2.0).double() / length
    angle = _angle(half * torch.arange(kept), length)
    return torch.cat([weight * angle.cos(), -weight * angle.sin()]).float()


@cache
def column_matrices(length: int, given: int, kept: int, *, inverse: bool) -> Columns:
    """For columns of ``given`` points, continued with zeros to ``length``, and the first ``kept`` frequencies.

    Args:
        length: any; a prime one takes a single product of its size.
        given: at most ``length``.
        kept: at most ``length``.
        inverse: the inverse transform, divided by ``length``.
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
    """N1 that costs least: about 100 multiplications take as long as a number that is copied."""

    def cost(parts: int) -> int:
        points = length // parts
        rows, found = -(-given // points), -(-kept // parts)
        copied = (rows * points > given) * given + (found * parts > kept) * kept
        return 4 * parts * points * (rows + found) + 100 * copied

    return min((n for n in range(1, length + 1) if length % n == 0), key=cost)


def _angle(steps: Tensor, length: int) -> Tensor:
    """2 pi steps / length; whole turns are left out before they cost digits."""
    return (steps % length).double() * (2 * math.pi / length)


def _complex(angle: Tensor) -> Tensor:
    """What multiplies pairs with exp(i angle): (..., rows, columns) to (..., rows, 2, 2, columns), out before in."""
    c, s = angle.cos(), angle.sin()
    return torch.stack([torch.stack([c, -s], dim=-2), torch.stack([s, c], dim=-2)], dim=-3)

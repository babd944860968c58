"""Fit the terms of a `Refinement` to aligned pairs of a measurement and its scene.

For picture i and colour c, with polynomials P_j over the sensor, R_m over the PSF and Q_k over the scene,

    b_ic = S sum_mk g_cmk (h_c R_m) * (Q_k (a_ic v_ic + e_ic)) + o_ic + B_c,    S = sum_j s_j P_j

A gain a and offsets of each picture and colour are free: e of the scene, which may have units of its own, and o of the
measurement, for rooms differ. They are eliminated by projection in each Gauss-Newton step on the common unknowns g, s
and B (variable projection). Scenes and kernels are convolved at full size; fits use their means over blocks, since all
unknowns are smooth.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from torch import Tensor
from torch.nn import functional as F

from mwdn.calibration.refinement import Refinement, displaced
from mwdn.fourier.convolution import convolve
from mwdn.optics.polynomials import coefficient_count, polynomials
from mwdn.types import Measurement, Psf, Scene, Size

BLOCKS = 32
"""Blocks along the shorter side in which means are compared."""

RIDGE = 1e-4
"""Of the normal equations, over the mean of their diagonal."""

DISPLACEMENT_STEP = 0.01
"""Displacement of the envelope for finite differences, over the shorter side."""


@dataclass(frozen=True)
class Terms:
    """Orders of the polynomials of each term; 0 for none.

    Args:
        psf_gain: g over the PSF, for each colour.
        sensor_field: S, common to all colours.
        stray_light: B for each colour, without the part that is even over the sensor, which is in o.
        field_dependence: g that changes linearly over the scene: 1 for its sum, 2 also over the PSF.
        envelope: 1 for a displaced aperture, 2 for one that moves on from the displacement of the model's PSF.
    """

    psf_gain: int = 0
    sensor_field: int = 0
    stray_light: int = 0
    field_dependence: int = 0
    envelope: int = 0

    @property
    def kernels(self) -> list[tuple[int, int]]:
        """(m, k) of each kernel but the first, (0, 0)."""
        over_psf = [(m, 0) for m in range(1, coefficient_count(self.psf_gain))]
        over_scene = [(m, k) for k in (1, 2) for m in range((0, 1, 3)[self.field_dependence])]
        return over_psf + over_scene


@dataclass(frozen=True, eq=False)
class Fit:
    """Common unknowns of `Terms`.

    Args:
        terms: that were fitted.
        gain: (C, kernels), g.
        field: (J,), s without the first, which is 1.
        stray: (C, J), B without the first.
        shift: d of the envelope.
    """

    terms: Terms
    gain: Tensor
    field: Tensor
    stray: Tensor
    shift: tuple[float, float] | None = None

    @property
    def displacement(self) -> tuple[float, float]:
        """Displacement of the envelope, mean of the colours: the gains of the last two kernels."""
        down, right = self.gain[:, -2:].mean(0).tolist()
        return round(down, 5), round(right, 5)

    def refinement(self) -> Refinement:
        """Without the field dependence, which no solver uses."""
        over_psf = coefficient_count(self.terms.psf_gain) - 1
        return Refinement(
            psf_gain=_rows(1.0, self.gain[:, :over_psf]) if over_psf else (),
            envelope_shift=self.shift,
            sensor_field=_rows(1.0, self.field[None]) if len(self.field) else (),
            stray_light=_rows(0.0, self.stray) if self.stray.shape[1] else (),
        )


class PairModel:
    """Pairs of one camera, reduced to what fits need.

    Args:
        psf: of the calibration.
        pairs: read once.
        shift: of the envelope, applied to the PSF.
        kernels: (m, k) for which to convolve, besides (0, 0) and those of the envelope's displacement.
        moves: whether to convolve for the envelope's displacement, without which `Terms.envelope` cannot be fitted.
    """

    def __init__(
        self,
        psf: Psf,
        pairs: Iterable[tuple[Measurement, Scene]],
        *,
        kernels: Sequence[tuple[int, int]] = (),
        shift: tuple[float, float] | None = None,
        moves: bool = True,
    ) -> None:
        size = psf.shape[-2], psf.shape[-1]
        self.block = max(1, min(size) // BLOCKS)
        self.shift = shift
        moved = psf if shift is None else displaced(psf, shift)
        over_frame = polynomials(3, size)[:, None].float()
        bases = [((0, 0), moved), *(((m, k), moved * over_frame[m]) for m, k in kernels)]
        steps = {(-1, 0): (DISPLACEMENT_STEP, 0.0), (-2, 0): (0.0, DISPLACEMENT_STEP)} if moves else {}
        for name, (down, right) in steps.items():
            ahead, back = (displaced(moved, (sign * down, sign * right)) for sign in (1, -1))
            bases.append((name, ahead / (2 * DISPLACEMENT_STEP) - back / (2 * DISPLACEMENT_STEP)))
        self.kernels = [name for name, _ in bases]
        ones = torch.ones(1, psf.shape[1], *size)
        self.even = self._reduce(ones, ones, bases, over_frame)[1]
        reduced = [self._reduce(b, v, bases, over_frame) for b, v in pairs]
        self.b = torch.stack([b for b, _ in reduced])
        self.parts = torch.stack([parts for _, parts in reduced])
        self.scale = self.b.square().mean((1, 2)).sqrt().clamp(min=1e-12)
        self.small = self.size_of_blocks(size)

    def size_of_blocks(self, size: Size) -> Size:
        """Height and width in blocks."""
        return size[0] // self.block, size[1] // self.block

    def __len__(self) -> int:
        return len(self.b)

    @cached_property
    def over_sensor(self) -> Tensor:
        """P, (K, pixels)."""
        return polynomials(3, self.small).flatten(1)

    def _reduce(
        self, b: Measurement, v: Scene, bases: list[tuple[tuple[int, int], Psf]], over_frame: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Measurement b (C, pixels) and the images (C, kernels, pixels) of one pair, as means over blocks."""
        images = [convolve(v * over_frame[k] if k else v, kernel) for (_, k), kernel in bases]
        b, *images = (F.avg_pool2d(image.double(), self.block)[0].flatten(1) for image in (b, *images))
        return b, torch.stack(images, 1)

    def start(self, terms: Terms) -> Fit:
        """The start of a fit: no change of the calibration."""
        colours, zeros = self.b.shape[1], torch.zeros
        field, stray = (coefficient_count(order) - 1 for order in (terms.sensor_field, terms.stray_light))
        kernels = zeros(colours, len(self._columns(terms)), dtype=torch.float64)
        return Fit(terms, kernels, zeros(field).double(), zeros(colours, stray).double(), self.shift)

    def _columns(self, terms: Terms) -> list[int]:
        moves = terms.envelope > (self.shift is not None)
        wanted = terms.kernels + ([(-1, 0), (-2, 0)] if moves else [])
        return [self.kernels.index(name) for name in wanted]

    def fit(self, terms: Terms, pairs: Sequence[int], *, start: Fit | None = None, steps: int = 4) -> Fit:
        """Gauss-Newton on the pairs of these numbers, from an earlier fit of the same terms."""
        fit = start or self.start(terms)
        for _ in range(steps):
            fit = self._step(fit, list(pairs))
        return fit

    def _step(self, fit: Fit, pairs: list[int]) -> Fit:
        colours, kernels = fit.gain.shape
        field, stray = len(fit.field), fit.stray.shape[1]
        count = colours * kernels + field + colours * stray
        if not count:
            return fit
        A, y = torch.zeros(count, count).double(), torch.zeros(count).double()
        for c in range(colours):
            own = [*range(c * kernels, (c + 1) * kernels), *range(colours * kernels, colours * kernels + field)]
            first = colours * kernels + field + c * stray
            own += range(first, first + stray)
            for i in pairs:
                J, r = self._linear(fit, i, c)
                A[torch.tensor(own)[:, None], torch.tensor(own)] += J @ J.T
                y[own] += J @ r
        step = torch.linalg.solve(A + RIDGE * A.diagonal().mean() * torch.eye(count).double(), y)
        gain, s, light = step.split([colours * kernels, field, colours * stray])
        return replace(
            fit,
            gain=fit.gain + gain.view(colours, kernels),
            field=fit.field + s,
            stray=fit.stray + light.view(colours, stray),
        )

    def _linear(self, fit: Fit, i: int, c: int) -> tuple[Tensor, Tensor]:
        """Derivatives (unknowns of this colour, pixels) and residual of a picture's colour, without a, e and o."""
        columns, P = self._columns(fit.terms), self.over_sensor
        S, images, light = self._forward(fit, i, c)
        free, inverse, residual = self._eliminate(self.b[i, c] - light, S * images)
        e, a = (inverse @ (free @ (self.b[i, c] - light)))[1:]
        field, stray = P[1 : 1 + len(fit.field)], P[1 : 1 + fit.stray.shape[1]]
        parts = a * self.parts[i, c, columns] + e * self.even[c, columns]
        J = torch.cat([S * parts, field * (a * images[1] + e * images[0]), stray])
        J = J - (J @ free.T) @ inverse @ free
        return J / self.scale[i], residual / self.scale[i]

    def _forward(self, fit: Fit, i: int, c: int) -> tuple[Tensor, Tensor, Tensor]:
        """S, the images (2, pixels) of an even scene and of the pair's scene, and B."""
        columns, P = self._columns(fit.terms), self.over_sensor
        both = torch.stack([self.even[c], self.parts[i, c]])
        images = both[:, 0] + torch.einsum("k,nkp->np", fit.gain[c], both[:, columns])
        S = 1 + fit.field @ P[1 : 1 + len(fit.field)]
        return S, images, fit.stray[c] @ P[1 : 1 + fit.stray.shape[1]]

    @staticmethod
    def _eliminate(b: Tensor, images: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Rows whose factors are o, e and a, the inverse of their Gram matrix, and the residual without them."""
        free = torch.cat([torch.ones_like(b)[None], images])
        inverse = torch.linalg.pinv(free @ free.T, hermitian=True)
        return free, inverse, b - (inverse @ (free @ b)) @ free

    def unexplained(self, fit: Fit, pair: int) -> float:
        """Root mean square residual of a pair over the standard deviation of its measurement."""
        square, total = 0.0, 0.0
        for c in range(self.b.shape[1]):
            S, images, light = self._forward(fit, pair, c)
            _, _, residual = self._eliminate(self.b[pair, c] - light, S * images)
            square += float(residual.square().sum())
            total += float((self.b[pair, c] - self.b[pair, c].mean()).square().sum())
        return (square / max(total, 1e-30)) ** 0.5


def _rows(first: float, rest: Tensor) -> tuple[tuple[float, ...], ...]:
    return tuple((first, *(round(value, 6) for value in row)) for row in rest.tolist())

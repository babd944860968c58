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
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional as F

from mwdn.calibration.refinement import Refinement, displaced
from mwdn.fourier.convolution import convolve
from mwdn.optics.polynomials import coefficient_count, polynomials
from mwdn.types import Image, Measurement, Psf, Scene, size_of

BLOCKS = 32
"""Blocks along the shorter side in which means are compared."""

RIDGE = 1e-4
"""Of the normal equations, over the mean of their diagonal."""

DISPLACEMENT_STEP = 0.01
"""Displacement of the envelope for finite differences, over the shorter side."""

DOWN, RIGHT = (-1, 0), (-2, 0)
"""Stand for (m, k) of two kernels without a polynomial: derivatives of the PSF by the envelope's displacement."""


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


class _Explained(NamedTuple):
    """One colour of a picture, with the best o, e and a for given common unknowns."""

    field: Tensor  # S, (pixels,)
    images: Tensor  # (2, pixels), of ones and of the scene: the factors of S e and S a
    free: Tensor  # (3, pixels), whose factors are o, e and a: ones, and S times the images
    inverse: Tensor  # (3, 3), of the Gram matrix of `free`
    factors: Tensor  # o, e and a
    residual: Tensor  # of the measurement, (pixels,)


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
        size = size_of(psf)
        self.shift, self.block = shift, max(1, min(size) // BLOCKS)
        psf = psf if shift is None else displaced(psf, shift)
        P = polynomials(3, size)[:, None].float()  # P[0] is 1
        psfs = {(m, k): psf * P[m] for m, k in ((0, 0), *kernels)}
        if moves:
            psfs |= {DOWN: _derivative(psf, DISPLACEMENT_STEP, 0.0), RIGHT: _derivative(psf, 0.0, DISPLACEMENT_STEP)}
        self.kernels = [*psfs]

        def images(scene: Scene) -> Tensor:
            """(C, kernels, pixels)."""
            return torch.stack([self._means(convolve(scene * P[k], kernel)) for (_, k), kernel in psfs.items()], 1)

        self.even = images(torch.ones(1, psf.shape[1], *size))
        reduced = [(self._means(b), images(v)) for b, v in pairs]
        self.measurements = torch.stack([b for b, _ in reduced])
        self.images = torch.stack([seen for _, seen in reduced])
        self.scale = self.measurements.square().mean((1, 2)).sqrt().clamp(min=1e-12)
        self.over_sensor = polynomials(3, (size[0] // self.block, size[1] // self.block)).flatten(1)  # (J, pixels)

    def _means(self, image: Image) -> Tensor:
        """(C, pixels), over blocks."""
        return F.avg_pool2d(image.double(), self.block)[0].flatten(1)

    def __len__(self) -> int:
        return len(self.measurements)

    def start(self, terms: Terms) -> Fit:
        """The start of a fit: no change of the calibration."""
        colours, zeros = self.measurements.shape[1], torch.zeros
        field, stray = (coefficient_count(order) - 1 for order in (terms.sensor_field, terms.stray_light))
        kernels = zeros(colours, len(self._columns(terms)), dtype=torch.float64)
        return Fit(terms, kernels, zeros(field).double(), zeros(colours, stray).double(), self.shift)

    def _columns(self, terms: Terms) -> list[int]:
        """Numbers of the terms' kernels; a displacement that is in the PSF already needs none."""
        moves = terms.envelope > (self.shift is not None)
        wanted = [*terms.kernels, *((DOWN, RIGHT) if moves else ())]
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
        parts = [colours * kernels, field, colours * stray]
        count = sum(parts)
        if not count:
            return fit
        of_gain, of_field, of_stray = torch.split(torch.arange(count), parts)
        A, y = torch.zeros(count, count).double(), torch.zeros(count).double()
        for c in range(colours):
            own = torch.cat([of_gain.view(colours, kernels)[c], of_field, of_stray.view(colours, stray)[c]])
            for pair in pairs:
                J, r = self._linear(fit, pair, c)
                A[own[:, None], own] += J @ J.T
                y[own] += J @ r
        step = torch.linalg.solve(A + RIDGE * A.diagonal().mean() * torch.eye(count).double(), y)
        gain, s, light = torch.split(step, parts)
        gain, light = gain.view_as(fit.gain), light.view_as(fit.stray)
        return replace(fit, gain=fit.gain + gain, field=fit.field + s, stray=fit.stray + light)

    def _linear(self, fit: Fit, pair: int, colour: int) -> tuple[Tensor, Tensor]:
        """Derivatives (unknowns of this colour, pixels) and residual of a picture's colour, without o, e and a."""
        columns, P = self._columns(fit.terms), self.over_sensor
        S, images, free, inverse, (_, e, a), residual = self._explained(fit, pair, colour)
        by_gain = S * (a * self.images[pair, colour, columns] + e * self.even[colour, columns])
        by_field = P[1 : 1 + len(fit.field)] * (a * images[1] + e * images[0])
        J = torch.cat([by_gain, by_field, P[1 : 1 + fit.stray.shape[1]]])
        J = J - (J @ free.T) @ inverse @ free
        return J / self.scale[pair], residual / self.scale[pair]

    def _explained(self, fit: Fit, pair: int, colour: int) -> _Explained:
        """Least squares for o, e and a: b - B = o + S (e image of ones + a image of v)."""
        columns, P = self._columns(fit.terms), self.over_sensor
        both = torch.stack([self.even[colour], self.images[pair, colour]])
        images = both[:, 0] + torch.einsum("k,nkp->np", fit.gain[colour], both[:, columns])
        S = 1 + fit.field @ P[1 : 1 + len(fit.field)]
        b = self.measurements[pair, colour] - fit.stray[colour] @ P[1 : 1 + fit.stray.shape[1]]
        free = torch.cat([torch.ones_like(b)[None], S * images])
        inverse = torch.linalg.pinv(free @ free.T, hermitian=True)
        factors = inverse @ (free @ b)
        return _Explained(S, images, free, inverse, factors, b - factors @ free)

    def unexplained(self, fit: Fit, pair: int) -> float:
        """Root mean square residual of a pair over the standard deviation of its measurement."""
        square, total = 0.0, 0.0
        for colour, measurement in enumerate(self.measurements[pair]):
            square += float(self._explained(fit, pair, colour).residual.square().sum())
            total += float((measurement - measurement.mean()).square().sum())
        return (square / max(total, 1e-30)) ** 0.5


def _derivative(psf: Psf, down: float, right: float) -> Psf:
    """Central difference of a PSF by a step of its envelope's displacement."""
    ahead, back = displaced(psf, (down, right)), displaced(psf, (-down, -right))
    return ahead / (2 * DISPLACEMENT_STEP) - back / (2 * DISPLACEMENT_STEP)


def _rows(first: float, rest: Tensor) -> tuple[tuple[float, ...], ...]:
    return tuple((first, *(round(value, 6) for value in row)) for row in rest.tolist())

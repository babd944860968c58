"""FISTA with non-negativity: accelerated projected gradient, the cross-check of ADMM."""

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from mwdn.arguments import check_at_least, checked
from mwdn.fourier.transforms import inverse_spectrum, spectrum
from mwdn.optics.psf import checked_psf
from mwdn.runtime.iterations import iterations
from mwdn.solvers.splitting import Problem
from mwdn.types import Measurement, Psf, Scene

MAX_MOMENTUM = 50.0
"""Largest momentum at the start of a stream's next frame: that of about 100 iterations. It follows a slowly moving
scene best; with unlimited momentum the old scene would persist for longer and longer."""


class Iterate(NamedTuple):
    """The last iterate for one measurement, from which the iterations for the next one can start."""

    problem: Problem
    v: Tensor
    extrapolated: Tensor
    momentum: float


@checked
@dataclass(frozen=True)
class Fista:
    """Accelerated projected gradient steps to a non-negative scene that explains the measurement.

    Minimises ``1/2 |crop(h * v) - b|^2`` over scenes ``v >= 0``.

    Called with a measurement (B, C, H, W) and a PSF, it returns the part (B, C, H, W) of the scene that faces the
    sensor. There is no prior but the sign: the number of iterations is the regularisation. Few give a smooth image,
    many a sharp and noisy one.

    Args:
        iterations: how many gradient steps.

    Raises:
        ParameterError: ``iterations`` is below 1.

    References:
        A. Beck and M. Teboulle, SIAM J. Imaging Sciences 2, 183 (2009).
    """

    iterations: int = 200

    def __post_init__(self) -> None:
        check_at_least(1, iterations=self.iterations)

    def __call__(self, measurement: Measurement, psf: Psf) -> Scene:
        """Reconstruct a batch."""
        return self.solve(measurement, psf)[0]

    @torch.no_grad()
    def solve(self, measurement: Measurement, psf: Psf, start: Iterate | None = None) -> tuple[Scene, Iterate]:
        """Reconstruct a batch, and return the last iterate as the ``start`` for the next one.

        Args:
            measurement: (B, C, H, W).
            psf: (1 or B, 1 or C, h, w), centred.
            start: of a measurement of this shape, through this PSF. Scene and momentum continue, so a constant
                measurement gives the result of all iterations so far, noise included, until the momentum reaches
                `MAX_MOMENTUM`.
        """
        if start is None:
            problem = Problem.from_psf(measurement, checked_psf(psf))
            v = extrapolated = problem.measurement.new_zeros((*measurement.shape[:2], *problem.grid))
            momentum = 1.0
        else:
            problem = start.problem._replace(measurement=measurement.float())
            v, extrapolated, momentum = start.v, start.extrapolated, min(start.momentum, MAX_MOMENTUM)
        b, H = problem.measurement, problem.transfer
        # The gradient's Lipschitz constant L is at most max |H|^2; a step of 1/L cannot overshoot.
        step = 1 / H.abs().square().amax((-2, -1), keepdim=True)
        for _ in iterations(self.iterations):
            residual = inverse_spectrum(H * spectrum(extrapolated, problem.grid), problem.grid, problem.sensor) - b
            slope = inverse_spectrum(H.conj() * spectrum(residual, problem.grid), problem.grid, problem.grid)
            new_v = (extrapolated - step * slope).clamp(min=0)
            new_momentum = (1 + (1 + 4 * momentum**2) ** 0.5) / 2
            extrapolated = new_v + (momentum - 1) / new_momentum * (new_v - v)
            v, momentum = new_v, new_momentum
        height, width = problem.sensor
        return v[..., :height, :width], Iterate(problem, v, extrapolated, momentum)

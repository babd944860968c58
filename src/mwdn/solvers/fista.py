"""FISTA with non-negativity: accelerated projected gradient, the cross-check of ADMM."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from mwdn.errors import ParameterError
from mwdn.fourier.transforms import inverse_spectrum, spectrum
from mwdn.solvers.splitting import Problem
from mwdn.types import Measurement, Psf, Scene

INERTIA = 50.0
"""Momentum with which the next frame of a stream begins, at most: that of about 100 iterations. With it a slowly moving
scene is followed best; one that grows without end would draw the old scene along for ever longer."""


class Reached(NamedTuple):
    """Where the iterations for one measurement ended, and those for the next one may begin."""

    problem: Problem
    v: Tensor
    ahead: Tensor
    momentum: float


@dataclass(frozen=True)
class Fista:
    """Minimise ``1/2 |crop(h * v) - b|^2`` over scenes ``v >= 0`` by accelerated projected gradient steps.

    Called with a measurement (B, C, H, W) and a PSF, it returns the part (B, C, H, W) of the scene that faces the
    sensor. There is no prior but the sign: the number of iterations is what regularises. Few give a smooth
    picture, many a sharp and noisy one.

    Args:
        iterations: how many gradient steps.

    References:
        A. Beck and M. Teboulle, SIAM J. Imaging Sciences 2, 183 (2009).
    """

    iterations: int = 200

    def __post_init__(self) -> None:
        if self.iterations < 1:
            raise ParameterError(f"`iterations` ({self.iterations}) must be at least 1.")

    @torch.no_grad()
    def __call__(
        self, measurement: Measurement, psf: Psf, *, callback: Callable[[int, Tensor], None] | None = None
    ) -> Scene:
        """Reconstruct a batch; ``callback`` is told each iteration's number and objectives (B,)."""
        return self.follow(measurement, psf, callback=callback)[0]

    @torch.no_grad()
    def follow(
        self,
        measurement: Measurement,
        psf: Psf,
        last: Reached | None = None,
        *,
        callback: Callable[[int, Tensor], None] | None = None,
    ) -> tuple[Scene, Reached]:
        """Reconstruct a batch from where the iterations for the ``last`` one ended: of this shape, by this PSF.

        Scene and momentum go on, so a scene that stands still is that of all iterations so far, noise and all, until
        the momentum reaches `INERTIA`.
        """
        problem = (
            Problem.from_psf(measurement, psf)
            if last is None
            else last.problem._replace(measurement=measurement.float())
        )
        b, H = problem.measurement, problem.transfer
        # The gradient's Lipschitz constant is at most max |H|^2, a step of 1/L can never overshoot.
        step = 1 / H.abs().square().amax((-2, -1), keepdim=True)
        zero = b.new_zeros((*b.shape[:2], *problem.grid))
        _, v, ahead, momentum = last or Reached(problem, zero, zero, 1.0)
        momentum = momentum if last is None else min(momentum, INERTIA)
        for iteration in range(1, self.iterations + 1):
            residual = inverse_spectrum(H * spectrum(ahead, problem.grid), problem.grid, problem.sensor) - b
            slope = inverse_spectrum(H.conj() * spectrum(residual, problem.grid), problem.grid, problem.grid)
            new = (ahead - step * slope).clamp(min=0)
            following = (1 + (1 + 4 * momentum**2) ** 0.5) / 2
            ahead = new + (momentum - 1) / following * (new - v)
            v, momentum = new, following
            if callback:
                Hv = inverse_spectrum(H * spectrum(v, problem.grid), problem.grid, problem.sensor)
                callback(iteration, 0.5 * (Hv - b).square().sum((1, 2, 3)))
        height, width = problem.sensor
        return v[..., :height, :width], Reached(problem, v, ahead, momentum)

"""ADMM with total variation and non-negativity, the classical reconstruction of a lensless camera."""

from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import torch
from torch import Tensor

from mwdn.arguments import check_at_least, check_not_negative, checked
from mwdn.errors import ParameterError
from mwdn.fourier.convolution import check_fit
from mwdn.optics.psf import checked_psf
from mwdn.runtime.iterations import repeat
from mwdn.solvers.proximal import Variation
from mwdn.solvers.splitting import (
    Penalties,
    Problem,
    State,
    initial_state,
    make_filters,
    update_copies,
    update_scene,
)
from mwdn.types import TINY, Measurement, Psf, Scene


class Iterate(NamedTuple):
    """The last iterate for one measurement, from which the iterations for the next one can start."""

    problem: Problem
    state: State


@checked
@dataclass(frozen=True)
class Admm:
    """ADMM with total variation and non-negative light: the classical reference.

    Minimises ``1/2 |crop(h * v) - b|^2 + tau |Psi v|_1`` over scenes ``v >= 0``.

    Called with a measurement (B, C, H, W) and a PSF, it returns the part (B, C, H, W) of the scene that faces the
    sensor, in the units of the measurement; the scale of the PSF does not matter. PSF and measurement are scaled to
    unit L2 norm first, each sample separately, so that the constants below mean the same for every camera and exposure.
    The iteration is written out in `mwdn.solvers.splitting`.

    Args:
        regularisation: tau, weight of the total variation. As it grows, noise disappears first, then texture, until
            the image is flat patches.
        penalties: mu of the data, the gradient and the sign constraint. They change the speed of convergence, not the
            limit.
        iterations: number of iterations.
        variation: kind of total variation, see `mwdn.solvers.proximal.Variation`.

    Raises:
        ParameterError: a penalty is not positive, ``regularisation`` is negative, ``iterations`` is below 1, or an
            option is of another type.
        ShapeError: batch or channels of PSF and measurement do not fit.

    References:
        N. Antipa et al., DiffuserCam: lensless single-exposure 3D imaging, Optica 5, 1 (2018); S. Boyd et al.,
        Distributed Optimization and Statistical Learning via ADMM (2011).
    """

    regularisation: float = 4e-5
    penalties: Penalties = Penalties()  # noqa: RUF009
    iterations: int = 100
    variation: Variation = "colour"

    def __post_init__(self) -> None:
        check_not_negative(regularisation=self.regularisation)
        check_at_least(1, iterations=self.iterations)
        if not all((torch.as_tensor(mu) > 0).all() for mu in self.penalties):
            raise ParameterError(f"`penalties` {tuple(self.penalties)} must be positive.")

    def __call__(self, measurement: Measurement, psf: Psf) -> Scene:
        """Reconstruct a batch."""
        return self.solve(measurement, psf)[0]

    @torch.no_grad()
    def solve(self, measurement: Measurement, psf: Psf, start: Iterate | None = None) -> tuple[Scene, Iterate]:
        """Reconstruct a batch, and return the last iterate as the ``start`` for the next one.

        Args:
            measurement: (B, C, H, W).
            psf: (1 or B, 1 or C, h, w), centred.
            start: of a measurement of this shape, through this PSF. Scene and multipliers continue, so a constant
                measurement gives the result of all iterations so far.
        """
        check_fit(measurement, psf, "measurement")
        measurement, psf = measurement.float(), checked_psf(psf).float()  # squares in half precision end at 65,504
        b_norm = _norm(measurement).clamp(min=TINY)
        h_norm = _norm(psf)
        b = measurement / b_norm
        problem = start.problem._replace(measurement=b) if start else Problem.from_psf(b, psf / h_norm)
        updates = (
            partial(
                update_copies, problem=problem, mu=self.penalties, tau=self.regularisation, variation=self.variation
            ),
            partial(update_scene, problem=problem, filters=make_filters(problem, self.penalties)),
        )
        state = repeat(updates, start.state if start else initial_state(problem), self.iterations)
        height, width = problem.sensor
        scene = state.v[..., :height, :width].clamp(min=0) * (b_norm / h_norm)
        return scene, Iterate(problem, state)


def _norm(image: Tensor) -> Tensor:
    """L2 norm of each sample, (B, 1, 1, 1)."""
    return image.square().sum((1, 2, 3), keepdim=True).sqrt()

"""ADMM with total variation and non-negativity, the classical reconstruction of a lensless camera."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from mwdn.errors import ParameterError
from mwdn.solvers.proximal import Variation, gradient
from mwdn.solvers.splitting import (
    Penalties,
    Problem,
    State,
    initial_state,
    make_filters,
    objective,
    rescale,
    update_copies,
    update_scene,
)
from mwdn.types import Measurement, Psf, Scene


class Residuals(NamedTuple):
    """How far the copies are from the scene (primal), and how far they moved (dual); three numbers a sample.

    Both are relative, as in Boyd et al. (2011), section 3.3: to the larger of copy and original, and to the
    multiplier.
    """

    primal: tuple[Tensor, Tensor, Tensor]
    dual: tuple[Tensor, Tensor, Tensor]


def _norm(*parts: Tensor) -> Tensor:
    return torch.stack([p.square().sum((1, 2, 3)) for p in parts]).sum(0).sqrt()


def residuals(old: State, new: State) -> Residuals:
    """Relative primal and dual residuals of the iteration from ``old`` to ``new``.

    A copy is as far from the scene as its multiplier moved. The dual residual is written with the scene in place of
    its copies, which saves keeping two generations of them.
    """
    tiny = torch.finfo(torch.float32).tiny
    primal, dual = [], []
    for last, last_pull, value, pull in (
        ((old.Hv,), (old.at_sensor,), (new.Hv,), (new.at_sensor,)),
        (gradient(old.v), old.slope, gradient(new.v), new.slope),
        ((old.v,), (old.sign,), (new.v,), (new.sign,)),
    ):
        multiplier = [a - b for a, b in zip(value, pull, strict=True)]
        gap = [a - (b - c) for a, b, c in zip(multiplier, last, last_pull, strict=True)]
        copy = [a - b for a, b in zip(value, gap, strict=True)]
        primal.append(_norm(*gap) / torch.maximum(_norm(*copy), _norm(*value)).clamp(min=tiny))
        moved = _norm(*(a - b for a, b in zip(value, last, strict=True)))
        dual.append(moved / _norm(*multiplier).clamp(min=tiny))
    return Residuals((primal[0], primal[1], primal[2]), (dual[0], dual[1], dual[2]))


def balance(mu: Penalties, found: Residuals, *, ratio: float = 5.0, factor: float = 2.0) -> Penalties:
    """Raise a penalty whose primal residual lags, lower one whose dual residual does.

    References:
        S. Boyd et al., Distributed Optimization and Statistical Learning via ADMM (2011), eq. (3.13); relative
        residuals after B. Wohlberg, arXiv:1704.06209.
    """

    def adapt(m: float | Tensor, primal: Tensor, dual: Tensor) -> Tensor:
        up = torch.where(primal > ratio * dual, factor, 1.0)
        down = torch.where(dual > ratio * primal, factor, 1.0)
        return m * (up / down)[:, None, None, None]

    return Penalties(*(adapt(*each) for each in zip(mu, found.primal, found.dual, strict=True)))


@dataclass(frozen=True)
class Progress:
    """What a callback is told: one number a sample where it is a tensor."""

    iteration: int
    objective: Tensor
    primal: Tensor
    dual: Tensor
    penalties: Penalties


class Reached(NamedTuple):
    """Where the iterations for one measurement ended, and those for the next one may begin."""

    problem: Problem
    state: State
    penalties: Penalties


@dataclass(frozen=True)
class Admm:
    """Minimise ``1/2 |crop(h * v) - b|^2 + tau |Psi v|_1`` over scenes ``v >= 0``.

    Called with a measurement (B, C, H, W) and a PSF, it returns the part (B, C, H, W) of the scene that faces the
    sensor, in the units of the measurement over those of the PSF. PSF and measurement are brought to unit L2 norm
    first, a sample at a time, so that the constants below mean the same for every camera and exposure.

    Args:
        regularisation: tau, weight of the total variation. As it grows, noise goes first, then texture, until
            the picture is flat patches.
        penalties: mu of the data, gradient and sign constraint. They change the way, not the destination.
        iterations: at most this many.
        variation: which total variation, see `mwdn.solvers.proximal.Variation`.
        tolerance: stop once every relative residual of every sample is below this, looked at every tenth iteration;
            0 never stops early.
        balance_every: adapt the penalties each this many iterations (residual balancing); 0 keeps them.

    Raises:
        ParameterError: a penalty is not positive, another constant is negative, or no iteration is asked for.
        ShapeError: batch or channels of PSF and measurement do not fit.

    References:
        N. Antipa et al., DiffuserCam: lensless single-exposure 3D imaging, Optica 5, 1 (2018); S. Boyd et al.,
        Distributed Optimization and Statistical Learning via ADMM (2011).
    """

    regularisation: float = 4e-5
    penalties: Penalties = Penalties()  # noqa: RUF009
    iterations: int = 100
    variation: Variation = "colour"
    tolerance: float = 0.0
    balance_every: int = 0

    def __post_init__(self) -> None:
        for name in ("regularisation", "tolerance", "balance_every"):
            if not getattr(self, name) >= 0:
                raise ParameterError(f"`{name}` ({getattr(self, name)}) must not be negative.")
        if self.iterations < 1:
            raise ParameterError(f"`iterations` ({self.iterations}) must be at least 1.")
        if not all((torch.as_tensor(mu) > 0).all() for mu in self.penalties):
            raise ParameterError(f"`penalties` {tuple(self.penalties)} must be positive.")

    @torch.no_grad()
    def __call__(
        self, measurement: Measurement, psf: Psf, *, callback: Callable[[Progress], None] | None = None
    ) -> Scene:
        """Reconstruct a batch; ``callback`` is told of each iteration."""
        return self.follow(measurement, psf, callback=callback)[0]

    @torch.no_grad()
    def follow(
        self,
        measurement: Measurement,
        psf: Psf,
        last: Reached | None = None,
        *,
        callback: Callable[[Progress], None] | None = None,
    ) -> tuple[Scene, Reached]:
        """Reconstruct a batch from where the iterations for the ``last`` one ended: of this shape, by this PSF.

        Scene and multipliers go on, so a scene that stands still is that of all iterations so far.
        """
        b_norm, h_norm = _norm(measurement)[:, None, None, None], _norm(psf)[:, None, None, None]
        b_norm = b_norm.clamp(min=torch.finfo(torch.float32).tiny)
        b, tau = measurement / b_norm, self.regularisation
        if last is None:
            problem = Problem.from_psf(b, psf / h_norm)
            state, mu = initial_state(problem), self.penalties
        else:
            problem, state, mu = last.problem._replace(measurement=b.float()), last.state, last.penalties
        filters = make_filters(problem, mu)
        for iteration in range(1, self.iterations + 1):
            balancing = self.balance_every and iteration % self.balance_every == 0
            checking = self.tolerance and iteration % 10 == 0
            watched = balancing or checking or callback
            old = state if watched else None  # the last state's memory, unless it is compared
            state = update_copies(state, problem, mu, tau, self.variation)
            state = update_scene(state, problem, mu, filters)
            if old is None:
                continue
            found = residuals(old, state)
            if callback:
                value = objective(state, problem, tau, self.variation)
                primal, dual = (torch.stack(each).amax(0) for each in found)
                callback(Progress(iteration, value, primal, dual, mu))
            if checking and all((r < self.tolerance).all() for r in (*found.primal, *found.dual)):
                break
            if balancing:
                balanced = balance(mu, found)
                state, mu, filters = rescale(state, mu, balanced), balanced, make_filters(problem, balanced)
        height, width = problem.sensor
        scene = state.v[..., :height, :width].clamp(min=0) * (b_norm / h_norm)
        return scene, Reached(problem, state, mu)

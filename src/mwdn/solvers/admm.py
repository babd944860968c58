"""ADMM with total variation and non-negativity, the classical reconstruction of a lensless camera."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from mwdn.errors import ParameterError
from mwdn.fourier import Size, check_fit, fast_length, inverse_spectrum, spectrum, transfer_function
from mwdn.solvers.proximal import Gradient, Variation, divergence, gradient, shrink, total_variation
from mwdn.types import Measurement, Psf, Scene, Spectrum


class Penalties(NamedTuple):
    """Weights mu of the three constraints; numbers, or tensors that broadcast against (B, C, H, W).

    The usual ones of the literature, `TEXTBOOK`, have ratios much like these, but are so small that 100 iterations
    never feel tau: stopping early is then what regularises. With these the iterations converge, and tau means
    something.
    """

    data: float | Tensor = 0.005
    gradient: float | Tensor = 20.0
    sign: float | Tensor = 0.06


TEXTBOOK = Penalties(1e-6, 1e-5, 4e-5)
"""DiffuserCam's constants, used there with tau = 1e-4."""


class Problem(NamedTuple):
    """What stays fixed during the iterations. The grid holds every scene point that reaches the sensor."""

    measurement: Measurement
    transfer: Spectrum
    adjoint: Spectrum
    power: Tensor
    laplacian: Tensor
    grid: Size

    @property
    def sensor(self) -> Size:
        """Height and width of the measurement, the top left of the grid."""
        return self.measurement.shape[-2], self.measurement.shape[-1]


class State(NamedTuple):
    """The scene v, what the sensor sees of it, and what pulls at the scene: each copy minus its multiplier.

    A multiplier is how far the scene stays away from its pull, over its penalty: xi = H v - at_sensor, eta = Psi v -
    slope, rho = v - sign. A problem without total variation has no slope: it is empty.
    """

    v: Tensor
    V: Spectrum
    Hv: Measurement
    at_sensor: Measurement
    slope: Gradient | tuple[()]
    sign: Tensor


def pose(measurement: Measurement, psf: Psf) -> Problem:
    """Set the problem up on the grid of a linear convolution, sensor at the top left.

    Raises:
        ShapeError: batch or channels of the PSF are neither 1 nor the measurement's.
    """
    check_fit(measurement, psf, "measurement")
    height, width = (fast_length(s + p) for s, p in zip(measurement.shape[-2:], psf.shape[-2:], strict=True))
    return posed(measurement.float(), transfer_function(psf, (height, width)))


def posed(measurement: Tensor, transfer: Tensor) -> Problem:
    """The same from the PSF's transfer function, (B, C, height, width // 2 + 1) on a grid of even width."""
    height, width = transfer.shape[-2], 2 * (transfer.shape[-1] - 1)
    # |Psi|^2 of periodic forward differences is 4 sin^2 along each axis.
    rows = torch.arange(height, device=transfer.device)[:, None] * (math.pi / height)
    columns = torch.arange(width // 2 + 1, device=transfer.device) * (math.pi / width)
    laplacian = 4 * rows.sin().square() + 4 * columns.sin().square()
    adjoint = transfer.conj().resolve_conj()  # a lazy conjugate would be copied at each use
    return Problem(measurement, transfer, adjoint, transfer.abs().square(), laplacian, (height, width))


def start(problem: Problem, scene: Tensor | None = None, *, smooth: bool = True) -> State:
    """Zero multipliers, and a zero scene unless one of the grid's size is given; ``smooth`` for total variation."""
    b = problem.measurement
    v = b.new_zeros((*b.shape[:2], *problem.grid)) if scene is None else scene
    V = spectrum(v, problem.grid)
    Hv = inverse_spectrum(problem.transfer * V, problem.grid, problem.sensor)
    return State(v, V, Hv, at_sensor=Hv, slope=gradient(v) if smooth else (), sign=v)


def split(state: State, problem: Problem, mu: Penalties, tau: float | Tensor, variation: Variation) -> State:
    """Update the copies u = Psi v, x = H v and w = v: shrink the gradient, fit the sensor, clip the sign.

    What a copy is made of, value plus multiplier, is the pull reflected at the value; the new pull is copy minus
    multiplier, of which the reflection knows enough. Outside the sensor nothing is measured and the textbook's x obeys
    ``mu1 x - xi = mu1 H v``, so x and xi are kept on the sensor alone.
    """

    def reflect(value: Tensor, pull: Tensor) -> Tensor:
        return (2 * value).sub_(pull)

    def follow(pull: Tensor, reflected: Tensor, copy: Tensor) -> Tensor:  # copy - value + pull
        return copy.add_(pull, alpha=0.5).sub_(reflected, alpha=0.5)

    slope = state.slope
    if slope:
        gy, gx = (reflect(*each) for each in zip(gradient(state.v), slope, strict=True))
        uy, ux = shrink((gy, gx), tau / mu.gradient, variation)
        slope = follow(slope[0], gy, uy), follow(slope[1], gx, ux)
        del gy, gx, uy, ux  # the memory of a large picture
    Hv, v = reflect(state.Hv, state.at_sensor), reflect(state.v, state.sign)
    x = (problem.measurement + mu.data * Hv) / (1 + mu.data)
    w = v.clamp(min=0)
    return state._replace(at_sensor=follow(state.at_sensor, Hv, x), slope=slope, sign=follow(state.sign, v, w))


def merge(state: State, problem: Problem, mu: Penalties) -> State:
    """Update the scene, on which all pulls must agree, in the Fourier domain."""
    prior, stiffness = mu.sign * state.sign, mu.sign
    if state.slope:
        prior.add_(mu.gradient * divergence(state.slope))
        stiffness = mu.gradient * problem.laplacian + mu.sign
    V = spectrum(prior, problem.grid)
    del prior
    power = mu.data * problem.power
    beyond = mu.data * (state.at_sensor - state.Hv)  # what the sensor adds to mu1 H v
    V = V.add_(power * state.V).add_(problem.adjoint * spectrum(beyond, problem.grid))
    V = V * (1 / (power + stiffness))  # a complex quotient takes three times as long
    del power
    Hv = inverse_spectrum(problem.transfer * V, problem.grid, problem.sensor)
    return state._replace(v=inverse_spectrum(V, problem.grid, problem.grid), V=V, Hv=Hv)


def rescale(state: State, old: Penalties, new: Penalties) -> State:
    """Keep the multipliers what they are when the penalties change."""
    data, steep, sign = (1 - before / after for before, after in zip(old, new, strict=True))
    slope = state.slope
    if slope:
        gy, gx = gradient(state.v)
        slope = slope[0] + (gy - slope[0]) * steep, slope[1] + (gx - slope[1]) * steep
    return state._replace(
        at_sensor=state.at_sensor + (state.Hv - state.at_sensor) * data,
        slope=slope,
        sign=state.sign + (state.v - state.sign) * sign,
    )


def objective(state: State, problem: Problem, tau: float, variation: Variation) -> Tensor:
    """Value of the minimised function at the scene v, one number a sample."""
    misfit = (state.Hv - problem.measurement).square().sum((1, 2, 3))
    return 0.5 * misfit + tau * total_variation(gradient(state.v), variation)


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
    penalties: Penalties = Penalties()
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
            problem = pose(b, psf / h_norm)
            state, mu = start(problem), self.penalties
        else:
            problem, state, mu = last.problem._replace(measurement=b.float()), last.state, last.penalties
        for iteration in range(1, self.iterations + 1):
            balancing = self.balance_every and iteration % self.balance_every == 0
            checking = self.tolerance and iteration % 10 == 0
            watched = balancing or checking or callback
            old = state if watched else None  # the last state's memory, unless it is compared
            state = split(state, problem, mu, tau, self.variation)
            state = merge(state, problem, mu)
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
                state, mu = rescale(state, mu, balanced), balanced
        height, width = problem.sensor
        scene = state.v[..., :height, :width].clamp(min=0) * (b_norm / h_norm)
        return scene, Reached(problem, state, mu)

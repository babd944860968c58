"""ADMM with total variation and non-negativity, the classical reconstruction of a lensless camera."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from mwdn.errors import ParameterError
from mwdn.fourier import Size, check_fit, fast_length, inverse_spectrum, spectrum, transfer_function
from mwdn.solvers.proximal import Variation, divergence, gradient, shrink, total_variation
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
    """The scene v, its gradient, what the sensor sees of it, and the multipliers xi, eta, rho.

    The multipliers are kept divided by their penalties, which saves a multiplication at each of their uses. A
    problem without total variation has neither slope nor eta: they are empty.
    """

    v: Tensor
    V: Spectrum
    slope: tuple[Tensor, ...]
    Hv: Measurement
    xi: Measurement
    eta: tuple[Tensor, ...]
    rho: Tensor


class Splitting(NamedTuple):
    """The copies u = Psi v, x = H v and w = v of one iteration."""

    u: tuple[Tensor, ...]
    x: Measurement
    w: Tensor


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
    zero = b.new_zeros((*b.shape[:2], *problem.grid))
    v = zero if scene is None else scene
    V = spectrum(v, problem.grid)
    Hv = inverse_spectrum(problem.transfer * V, problem.grid, problem.sensor)
    slope, eta = (gradient(v), (zero, zero)) if smooth else ((), ())
    return State(v, V, slope, Hv, torch.zeros_like(b), eta, zero)


def split(state: State, problem: Problem, mu: Penalties, tau: float | Tensor, variation: Variation) -> Splitting:
    """Update the copies: shrink the gradient, fit the sensor, clip the sign.

    Outside the sensor nothing is measured and the textbook's x obeys ``mu1 x - xi = mu1 H v``, so x and xi are
    kept on the sensor alone.
    """
    u: tuple[Tensor, ...] = ()
    if state.slope:
        (gy, gx), (ey, ex) = state.slope, state.eta
        u = shrink((gy + ey, gx + ex), tau / mu.gradient, variation)
    x = (mu.data * (state.xi + state.Hv) + problem.measurement) / (1 + mu.data)
    w = (state.rho + state.v).clamp(min=0)
    return Splitting(u, x, w)


def merge(state: State, copies: Splitting, problem: Problem, mu: Penalties) -> State:
    """Update the scene, which all copies must agree on, in the Fourier domain; then the multipliers."""
    u, x, w = copies
    H = problem.transfer
    # Copy minus multiplier is what the scene is pulled to; the new multiplier is how far it then stays away.
    pull_sensor, pull_w = x - state.xi, w - state.rho
    prior, stiffness = mu.sign * pull_w, mu.sign
    if u:
        pull_y, pull_x = u[0] - state.eta[0], u[1] - state.eta[1]
        prior.add_(mu.gradient * divergence((pull_y, pull_x)))
        stiffness = mu.gradient * problem.laplacian + mu.sign
    beyond = mu.data * (pull_sensor - state.Hv)  # what the sensor adds to mu1 H v
    power = mu.data * problem.power
    V = spectrum(prior, problem.grid).add_(power * state.V).add_(problem.adjoint * spectrum(beyond, problem.grid))
    V = V * (1 / (power + stiffness))  # a complex quotient takes three times as long
    v = inverse_spectrum(V, problem.grid, problem.grid)
    Hv = inverse_spectrum(H * V, problem.grid, problem.sensor)
    new = State(v, V, (), Hv, xi=Hv - pull_sensor, eta=(), rho=v - pull_w)
    if not u:
        return new
    gy, gx = gradient(v)
    return new._replace(slope=(gy, gx), eta=(gy - pull_y, gx - pull_x))


def rescale(state: State, old: Penalties, new: Penalties) -> State:
    """Keep the multipliers what they are when the penalties change."""
    ratio = old.gradient / new.gradient
    eta = tuple(each * ratio for each in state.eta)
    return state._replace(xi=state.xi * (old.data / new.data), eta=eta, rho=state.rho * (old.sign / new.sign))


def objective(state: State, problem: Problem, tau: float, variation: Variation) -> Tensor:
    """Value of the minimised function at the scene v, one number a sample."""
    misfit = (state.Hv - problem.measurement).square().sum((1, 2, 3))
    gy, gx = state.slope
    return 0.5 * misfit + tau * total_variation((gy, gx), variation)


class Residuals(NamedTuple):
    """How far the copies are from the scene (primal), and how far they moved (dual); three numbers a sample.

    Both are relative, as in Boyd et al. (2011), section 3.3: to the larger of copy and original, and to the
    multiplier.
    """

    primal: tuple[Tensor, Tensor, Tensor]
    dual: tuple[Tensor, Tensor, Tensor]


def _norm(*parts: Tensor) -> Tensor:
    return torch.stack([p.square().sum((1, 2, 3)) for p in parts]).sum(0).sqrt()


def residuals(old: State, new: State, copies: Splitting) -> Residuals:
    """Relative primal and dual residuals of the iteration from ``old`` to ``new``.

    The dual residual is written with the scene in place of its copies, which saves keeping two generations of them.
    """
    tiny = torch.finfo(torch.float32).tiny
    primal, dual = [], []
    for copy, value, last, multiplier in (
        ((copies.x,), (new.Hv,), (old.Hv,), (new.xi,)),
        (copies.u, new.slope, old.slope, new.eta),
        ((copies.w,), (new.v,), (old.v,), (new.rho,)),
    ):
        gap = _norm(*(a - b for a, b in zip(copy, value, strict=True)))
        primal.append(gap / torch.maximum(_norm(*copy), _norm(*value)).clamp(min=tiny))
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
            copies = split(state, problem, mu, tau, self.variation)
            state, old = merge(state, copies, problem, mu), state
            balancing = self.balance_every and iteration % self.balance_every == 0
            checking = self.tolerance and iteration % 10 == 0
            if not (balancing or checking or callback):
                continue
            found = residuals(old, state, copies)
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

"""One iteration of ADMM for ``1/2 |C H v - b|^2 + tau |Psi v|_1`` over ``v >= 0``.

H convolves the scene v with the PSF, C crops to the sensor, Psi is the gradient. Each term gets a splitting variable (a
copy of H v, Psi v or v): x = H v, u = Psi v, w = v, with penalties mu and scaled multipliers xi, eta, rho (multiplier
over penalty):

1. ``x = argmin 1/2 |C x - b|^2 + mu1/2 |x - H v - xi|^2``: on the sensor ``(mu1 (H v + xi) + b) / (mu1 + 1)``
2. ``u = prox of (tau / mu2) |.|_1 at Psi v + eta``
3. ``w = max(v + rho, 0)``
4. ``v = D (mu1 H^T p1 + mu2 Psi^T p2 + mu3 p3)`` with ``D = 1 / (mu1 |H|^2 + mu2 |Psi|^2 + mu3)`` in the Fourier domain
5. ``xi += H v - x``, ``eta += Psi v - u``, ``rho += v - w``

The code keeps neither copies nor multipliers but the targets of (4), ``p1 = x - xi``, ``p2 = u - eta``,
``p3 = w - rho``. With (5) the multiplier is ``v - p`` for the last target p (H v and Psi v in place of v for p1 and
p2), so the argument of the proximal map in (1) to (3) is ``z = v + (v - p) = 2 v - p`` and the next target is
``prox(z) - (v - p) = v - (z - prox(z))``: the value minus what the map removes.

Over-relaxation goes further in the same direction: ``p + alpha (v - (z - prox(z)) - p)``. An alpha of 1.5 to 1.8 saves
a third of the iterations or more (S. Boyd et al., Distributed optimization and statistical learning via the alternating
direction method of multipliers, 2011, section 3.4.3).
"""

import math
from typing import NamedTuple

import torch
from torch import Tensor

from mwdn.fourier.convolution import check_fit
from mwdn.fourier.transforms import fast_length, inverse_spectrum, spectrum, transfer_function
from mwdn.solvers.proximal import Gradient, Variation, divergence, dual_projection, gradient
from mwdn.types import Measurement, Psf, Size, Spectrum, size_of


class Penalties(NamedTuple):
    """Weights mu1, mu2, mu3 of the three constraints; numbers, or tensors that broadcast against (B, C, H, W).

    The usual ones of the literature, `TEXTBOOK`, have similar ratios, but are so small that tau has no effect within
    100 iterations: stopping early is then the regularisation. With these the iterations converge.
    """

    data: float | Tensor = 0.005
    gradient: float | Tensor = 20.0
    sign: float | Tensor = 0.06


TEXTBOOK = Penalties(1e-6, 1e-5, 4e-5)
"""DiffuserCam's constants, used there with tau = 1e-4."""


class Problem(NamedTuple):
    """The constants of the iteration: b, H, |Psi|^2. The grid holds every scene point that reaches the sensor.

    Where b is ``saturated``, bool, the light was at least b: the data term of a pixel is zero if C x is larger.
    """

    measurement: Measurement
    transfer: Spectrum
    laplacian: Tensor
    grid: Size
    saturated: Tensor | None = None

    @classmethod
    def from_psf(cls, measurement: Measurement, psf: Psf) -> "Problem":
        """Problem on the grid of a linear convolution, sensor at the top left.

        Raises:
            ShapeError: batch or channels of the PSF are neither 1 nor the measurement's.
        """
        check_fit(measurement, psf, "measurement")
        height, width = (fast_length(s + p) for s, p in zip(measurement.shape[-2:], psf.shape[-2:], strict=True))
        return cls.from_transfer(measurement.float(), transfer_function(psf, (height, width)))

    @classmethod
    def from_transfer(cls, measurement: Tensor, transfer: Tensor, saturated: Tensor | None = None) -> "Problem":
        """Problem of a PSF's transfer function, (B, C, height, width // 2 + 1) on a grid of even width."""
        height, width = transfer.shape[-2], 2 * (transfer.shape[-1] - 1)
        # |Psi|^2 of periodic forward differences is 4 sin^2 along each axis.
        rows = torch.arange(height, device=transfer.device)[:, None] * (math.pi / height)
        columns = torch.arange(width // 2 + 1, device=transfer.device) * (math.pi / width)
        laplacian = 4 * rows.sin().square() + 4 * columns.sin().square()
        return cls(measurement, transfer, laplacian, (height, width), saturated)

    @property
    def sensor(self) -> Size:
        """Height and width of the measurement, the top left of the grid."""
        return size_of(self.measurement)


class State(NamedTuple):
    """The scene v, H v as a spectrum and on the sensor, and the targets p1, p2, p3 of equation (4).

    p1 is kept on the sensor, where it is needed pixel by pixel, and as the spectrum of the whole grid. A problem
    without total variation has an empty gradient target.
    """

    v: Tensor
    HV: Spectrum
    Hv: Measurement
    data_target: Measurement
    data_spectrum: Spectrum
    gradient_target: Gradient | tuple[()]
    sign_target: Tensor


def initial_state(problem: Problem, scene: Tensor | None = None, *, smooth: bool = True) -> State:
    """State with zero multipliers.

    Args:
        problem: to solve.
        scene: (B, C, *grid); zeros by default.
        smooth: whether the problem has total variation.
    """
    b = problem.measurement
    v = b.new_zeros((*b.shape[:2], *problem.grid)) if scene is None else scene
    HV = problem.transfer * spectrum(v, problem.grid)
    Hv = inverse_spectrum(HV, problem.grid, problem.sensor)
    return State(v, HV, Hv, Hv, HV, gradient_target=gradient(v) if smooth else (), sign_target=v)


def update_copies(
    state: State,
    problem: Problem,
    mu: Penalties,
    tau: float | Tensor,
    variation: Variation,
    relaxation: float = 1.0,
) -> State:
    """Equations (1) to (3) and (5): shrink the gradient, fit the measurement, clip the sign.

    Each target is value - (z - prox(z)) with z = 2 value - target, over-relaxed by alpha = ``relaxation``. What a map
    takes away is odd in z for (1) and (2): both start from -z, `reflected`. For (3) it is min(z, 0), so the target is
    v - min(2 v - p, 0) = max(v, p - v). Off the sensor nothing is measured: (1) gives x = H v + xi, so before
    over-relaxation the target is H v.
    """
    gradient_target = state.gradient_target
    if gradient_target:
        gy, gx = gradient(state.v)
        by, bx = dual_projection(
            (reflected(gy, gradient_target[0]), reflected(gx, gradient_target[1])), tau / mu.gradient, variation
        )
        old = gradient_target
        gradient_target = relaxed(old[0], gy.add_(by), relaxation), relaxed(old[1], gx.add_(bx), relaxation)
        del by, bx, old  # frees a large image's memory
    # prox(z) - z = (b - z) / (1 + mu1), on the sensor alone
    step = deficit(problem, state.Hv, state.data_target).div_(1 + mu.data)
    sign_target = torch.maximum(state.v, state.sign_target - state.v)
    return state._replace(
        data_target=relaxed(state.data_target, state.Hv + step, relaxation),
        data_spectrum=relaxed(state.data_spectrum, spectrum(step, problem.grid).add_(state.HV), relaxation),
        gradient_target=gradient_target,
        sign_target=relaxed(state.sign_target, sign_target, relaxation),
    )


def relaxed(old: Tensor, new: Tensor, relaxation: float) -> Tensor:
    """``old + relaxation (new - old)``, written into ``new``."""
    if relaxation == 1:
        return new
    if new.is_complex():  # torch's `lerp_` takes three times as long there
        return new.mul_(relaxation).add_(old, alpha=1 - relaxation)
    return new.lerp_(old, 1 - relaxation)


def deficit(problem: Problem, Hv: Measurement, target: Measurement) -> Measurement:
    """``b - z`` with ``z = 2 H v - target``; not below 0 where b is saturated."""
    missing = reflected(Hv, target).add_(problem.measurement)
    return missing if problem.saturated is None else torch.where(problem.saturated, missing.clamp(min=0), missing)


def reflected(value: Tensor, target: Tensor) -> Tensor:
    """``-z = target - 2 value``: the negative argument of a proximal map, value plus multiplier."""
    return torch.sub(target, value, alpha=2)


class Filters(NamedTuple):
    """Factors of equation (4), constant as long as the penalties are.

    The new spectrum is ``V = prior F(p3 + gradient_weight Psi^T p2) + data F(p1)``.

    Args:
        prior: mu3 D, stored as complex numbers.
        data: mu1 conj(H) D.
        gradient_weight: mu2 / mu3.
    """

    prior: Tensor
    data: Spectrum
    gradient_weight: float | Tensor


def make_filters(problem: Problem, mu: Penalties, *, smooth: bool = True) -> Filters:
    """Filters for these penalties; ``smooth`` if the problem has total variation."""
    power = mu.data * problem.transfer.abs().square()
    D = 1 / (power + (mu.gradient * problem.laplacian + mu.sign if smooth else mu.sign))
    data = problem.transfer.conj() * (mu.data * D)
    prior = mu.sign * D
    if not torch.compiler.is_compiling():  # torch would make it complex in each product
        prior = prior.to(data.dtype)
    return Filters(prior, data, mu.gradient / mu.sign)


def update_scene(state: State, problem: Problem, filters: Filters) -> State:
    """Equation (4) in the Fourier domain, as in `Filters`."""
    prior = state.sign_target
    if state.gradient_target:
        prior = divergence(state.gradient_target).mul_(filters.gradient_weight).add_(prior)
    V = spectrum(prior, problem.grid).mul_(filters.prior).addcmul_(state.data_spectrum, filters.data)
    del prior
    HV = problem.transfer * V
    Hv = inverse_spectrum(HV, problem.grid, problem.sensor)
    return state._replace(v=inverse_spectrum(V, problem.grid, problem.grid), HV=HV, Hv=Hv)


def rescale(state: State, old: Penalties, new: Penalties) -> State:
    """Targets for new penalties with the same multipliers, before an update without over-relaxation.

    The unscaled multiplier ``mu (v - p)`` stays, so the new target is ``p + (v - p) (1 - old / new)``. The next update
    does not need the data target off the sensor, so its spectrum stays as it is.
    """
    data, slope, sign = (1 - before / after for before, after in zip(old, new, strict=True))
    target = state.gradient_target
    if target:
        gy, gx = gradient(state.v)
        target = target[0] + (gy - target[0]) * slope, target[1] + (gx - target[1]) * slope
    return state._replace(
        data_target=state.data_target + (state.Hv - state.data_target) * data,
        gradient_target=target,
        sign_target=state.sign_target + (state.v - state.sign_target) * sign,
    )

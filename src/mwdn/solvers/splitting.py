"""One iteration of ADMM, and what it needs: the scene is split into copies that each obey one constraint."""

import math
from typing import NamedTuple

import torch
from torch import Tensor

from mwdn.fourier.convolution import check_fit
from mwdn.fourier.transforms import fast_length, inverse_spectrum, spectrum, transfer_function
from mwdn.solvers.proximal import Gradient, Variation, divergence, dual_projection, gradient, total_variation
from mwdn.types import Measurement, Psf, Size, Spectrum


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
    laplacian: Tensor
    grid: Size

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
    def from_transfer(cls, measurement: Tensor, transfer: Tensor) -> "Problem":
        """The same from the PSF's transfer function, (B, C, height, width // 2 + 1) on a grid of even width."""
        height, width = transfer.shape[-2], 2 * (transfer.shape[-1] - 1)
        # |Psi|^2 of periodic forward differences is 4 sin^2 along each axis.
        rows = torch.arange(height, device=transfer.device)[:, None] * (math.pi / height)
        columns = torch.arange(width // 2 + 1, device=transfer.device) * (math.pi / width)
        laplacian = 4 * rows.sin().square() + 4 * columns.sin().square()
        return cls(measurement, transfer, laplacian, (height, width))

    @property
    def sensor(self) -> Size:
        """Height and width of the measurement, the top left of the grid."""
        return self.measurement.shape[-2], self.measurement.shape[-1]


class Filters(NamedTuple):
    """What `update_scene` multiplies each part of the new spectrum with: the same as long as the penalties are.

    The gradient's pull counts ``steep`` times as much as the sign's.
    """

    prior: Tensor
    before: Tensor
    correlate: Spectrum
    steep: float | Tensor


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


def make_filters(problem: Problem, mu: Penalties, *, smooth: bool = True) -> Filters:
    """Filters for these penalties; ``smooth`` for total variation."""
    power = mu.data * problem.transfer.abs().square()
    stiffness = mu.gradient * problem.laplacian + mu.sign if smooth else mu.sign
    all_in_all = 1 / (power + stiffness)
    correlate = problem.transfer.conj() * (mu.data * all_in_all)
    return Filters(mu.sign * all_in_all, power * all_in_all, correlate, mu.gradient / mu.sign)


def initial_state(problem: Problem, scene: Tensor | None = None, *, smooth: bool = True) -> State:
    """Zero multipliers, and a zero scene unless one of the grid's size is given; ``smooth`` for total variation."""
    b = problem.measurement
    v = b.new_zeros((*b.shape[:2], *problem.grid)) if scene is None else scene
    V = spectrum(v, problem.grid)
    Hv = inverse_spectrum(problem.transfer * V, problem.grid, problem.sensor)
    return State(v, V, Hv, at_sensor=Hv, slope=gradient(v) if smooth else (), sign=v)


def update_copies(state: State, problem: Problem, mu: Penalties, tau: float | Tensor, variation: Variation) -> State:
    """Update the copies u = Psi v, x = H v and w = v: shrink the gradient, fit the sensor, clip the sign.

    A copy is the proximal map of value plus multiplier, and the new pull, copy minus multiplier, is the value less what
    that map takes away: each of them takes the negative of its argument, `opposed`, and adds. Outside the sensor
    nothing is measured and the textbook's x obeys ``mu1 x - xi = mu1 H v``, so x and xi are kept on the sensor alone.
    """
    slope = state.slope
    if slope:
        gy, gx = gradient(state.v)
        by, bx = dual_projection((opposed(gy, slope[0]), opposed(gx, slope[1])), tau / mu.gradient, variation)
        slope = gy.add_(by), gx.add_(bx)
        del by, bx  # the memory of a large picture
    at_sensor = opposed(state.Hv, state.at_sensor).add_(problem.measurement).div_(1 + mu.data).add_(state.Hv)
    sign = state.v + opposed(state.v, state.sign).relu_()
    return state._replace(at_sensor=at_sensor, slope=slope, sign=sign)


def opposed(value: Tensor, pull: Tensor) -> Tensor:
    """``pull - 2 value``: the negative of value plus multiplier."""
    return torch.sub(pull, value, alpha=2)


def update_scene(state: State, problem: Problem, mu: Penalties, filters: Filters) -> State:
    """Update the scene, on which all pulls must agree, in the Fourier domain; ``filters`` of the same penalties."""
    prior = state.sign
    if state.slope:
        prior = divergence(state.slope).mul_(filters.steep).add_(prior)
    V = spectrum(prior, problem.grid).mul_(filters.prior).addcmul_(filters.before, state.V)
    del prior
    added = spectrum(state.at_sensor - state.Hv, problem.grid)  # by the sensor to H v
    V.add_(added.mul_(filters.correlate))
    del added
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

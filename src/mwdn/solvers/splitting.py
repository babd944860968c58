"""One iteration of ADMM, and what it needs: the scene is split into copies that each obey one constraint."""

import math
from typing import NamedTuple

import torch
from torch import Tensor

from mwdn.fourier import Size, check_fit, fast_length, inverse_spectrum, spectrum, transfer_function
from mwdn.solvers.proximal import Gradient, Variation, divergence, gradient, shrink, total_variation
from mwdn.types import Measurement, Psf, Spectrum


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

    @property
    def sensor(self) -> Size:
        """Height and width of the measurement, the top left of the grid."""
        return self.measurement.shape[-2], self.measurement.shape[-1]


class Filters(NamedTuple):
    """What `merge` multiplies each part of the new spectrum with: the same as long as the penalties are."""

    prior: Tensor
    before: Tensor
    beyond: Spectrum


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
    return Problem(measurement, transfer, laplacian, (height, width))


def weigh(problem: Problem, mu: Penalties, *, smooth: bool = True) -> Filters:
    """Filters for these penalties; ``smooth`` for total variation."""
    power = mu.data * problem.transfer.abs().square()
    stiffness = mu.gradient * problem.laplacian + mu.sign if smooth else mu.sign
    prior = 1 / (power + stiffness)
    return Filters(prior, before=power * prior, beyond=problem.transfer.conj() * (mu.data * prior))


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


def reflect(value: Tensor, pull: Tensor) -> Tensor:
    """Value plus multiplier: what the copy is made of."""
    return (2 * value).sub_(pull)


def follow(pull: Tensor, reflected: Tensor, copy: Tensor) -> Tensor:
    """The new pull, ``copy - value + pull``; in the copy's place."""
    return copy.add_(pull, alpha=0.5).sub_(reflected, alpha=0.5)


def merge(state: State, problem: Problem, mu: Penalties, filters: Filters) -> State:
    """Update the scene, on which all pulls must agree, in the Fourier domain; ``filters`` of the same penalties."""
    prior = mu.sign * state.sign
    if state.slope:
        prior.add_(mu.gradient * divergence(state.slope))
    V = spectrum(prior, problem.grid).mul_(filters.prior)
    del prior
    beyond = spectrum(state.at_sensor - state.Hv, problem.grid)  # what the sensor adds to H v
    V = V.add_(filters.before * state.V).add_(beyond.mul_(filters.beyond))
    del beyond
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

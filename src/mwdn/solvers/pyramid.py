"""ADMM from coarse to fine: better than a hundred iterations at full size, in a fraction of their time."""

import math
from dataclasses import dataclass
from functools import cached_property, partial
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional as F

from mwdn.arguments import checked
from mwdn.errors import ParameterError
from mwdn.fourier.convolution import check_fit
from mwdn.fourier.transforms import fast_length, inverse_spectrum, spectrum, transfer_function
from mwdn.optics.psf import checked_psf, unit_sum
from mwdn.optics.saturation import saturated_pixels
from mwdn.runtime.iterations import repeat
from mwdn.solvers.levels import (
    LEVELS,
    REFERENCE_NOISE,
    REFERENCE_SIDE,
    Level,
    relative_noise,
    root_mean_square,
    smoothing_scale,
)
from mwdn.solvers.splitting import Problem, initial_state, make_filters, update_copies, update_scene
from mwdn.types import TINY, Measurement, Psf, Scene, Size, Spectrum, size_of

MIXED = 0.1
"""Saturated part of a coarse pixel above which its value is taken as a lower bound of the light."""


@checked
@dataclass(frozen=True)
class Pyramid:
    """Coarse-to-fine ADMM with total variation, then one Wiener step on the residual.

    Minimises ``1/2 |crop(h * v) - b|^2 + tau |Psi v|_1`` over scenes ``v >= 0``.

    The sensor crops the pattern, which loses mostly the low frequencies of the scene. They need many iterations but
    few pixels: an image of half the size holds half the band, and depends on the PSF's low frequencies alone. The
    finest level smooths by total variation; a last step adds the Wiener estimate of the residual. The light of a
    saturated pixel (`mwdn.optics.saturation`) is at least what the pixel holds.

    Called with a measurement (B, C, H, W) and a PSF, it returns the part (B, C, H, W) of the scene that faces the
    sensor.

    Args:
        levels: the coarsest first.
        regularisation: lambda of the Wiener step, for a PSF of unit sum; multiplied by `smoothing_scale` where that is
            above 1. As it grows, detail and noise fade. The weight tau of the total variation is
            `Level.regularisation`.

    Raises:
        ParameterError: ``regularisation`` is not positive, or the levels do not go from coarse to fine.
        ShapeError: batch or channels of PSF and measurement do not fit.
    """

    regularisation: float = 1e-3
    levels: tuple[Level, ...] = LEVELS

    def __post_init__(self) -> None:
        if not self.regularisation > 0:
            raise ParameterError(f"`regularisation` ({self.regularisation}) must be positive; try 1e-3.")
        sizes = [level.downsampling for level in self.levels]
        falling = sorted(set(sizes), reverse=True)
        if sizes[-1:] != [1] or sizes != falling or any(s < 1 or s & (s - 1) for s in sizes):
            raise ParameterError(f"`levels` {sizes} must be powers of two, falling to 1: for example 4, 2, 1.")

    @torch.no_grad()
    def __call__(self, measurement: Measurement, psf: Psf) -> Scene:
        """Reconstruct a batch."""
        psf = checked_psf(psf)
        estimate = solve(measurement, psf, self.levels)
        detail = estimate.detail(self.regularisation * smoothing_scale(estimate.noise).clamp(min=1))
        return (estimate.scene + detail).clamp(min=0) / psf.float().sum((-2, -1), keepdim=True)


@dataclass(frozen=True)
class Estimate:
    """A smooth scene and its residual.

    Args:
        measurement: (B, C, H, W).
        grid_scene: (B, C, rows, columns), the scene on the whole grid of the finest level, not negative, for a PSF of
            unit sum.
        psf: of the iterations.
        saturated: (B, C, H, W), `saturated_pixels` of the measurement.
        noise: `relative_noise` of the measurement, (B, 1, 1, 1).
    """

    measurement: Measurement
    grid_scene: Tensor
    psf: "PsfPyramid"
    saturated: Tensor
    noise: Tensor

    @cached_property
    def scene(self) -> Scene:
        """The part (B, C, H, W) that faces the sensor."""
        return self._on_sensor(self.grid_scene)

    @cached_property
    def residual(self) -> Measurement:
        """The measurement minus the forward model of the scene, (B, C, H, W); not below 0 where it is saturated."""
        finest = self.psf.bands[-1]
        downsampling, (height, width) = finest.level.downsampling, self.measurement.shape[-2:]
        sensor = -(-height // downsampling), -(-width // downsampling)
        V = finest.transfer * finest.norm * spectrum(self.grid_scene, finest.grid)
        residual = self.measurement - self._on_sensor(inverse_spectrum(V, finest.grid, sensor))
        return torch.where(self.saturated, residual.clamp(min=0), residual)

    def _on_sensor(self, image: Tensor) -> Tensor:
        """Enlarge an image from the finest level's pixels to the sensor's, and crop it."""
        downsampling, (height, width) = self.psf.bands[-1].level.downsampling, self.measurement.shape[-2:]
        if downsampling > 1:
            # Two more pixels: one for a side that is not divisible, one to interpolate with.
            image = image[..., : height // downsampling + 2, : width // downsampling + 2]
            image = enlarge(image, (downsampling * image.shape[-2], downsampling * image.shape[-1]))
        return image[..., :height, :width]

    @cached_property
    def residual_spectrum(self) -> Tensor:
        """Spectrum of the residual, zero off the sensor, on the grid of the finest level."""
        return spectrum(self.residual, self.psf.bands[-1].grid)

    def doubt(self, side: int) -> Tensor:
        """How much the residual contradicts the PSF, (B, 1, 1, 1).

        The root mean square of the residual's mean in blocks of s x s pixels, over ``n / s``, which white noise n would
        leave. 1 to 3 with a right PSF, 5 to 100 with a wrong one.
        """
        means = root_mean_square(F.avg_pool2d(self.residual, side, ceil_mode=True))
        return means * (side / (self.noise.clamp(min=REFERENCE_NOISE / 10) * root_mean_square(self.measurement)))

    def detail(self, regularisation: float | Tensor) -> Scene:
        """Wiener deconvolution of the residual, to add to the scene. The finest level must have the full size.

        Args:
            regularisation: lambda as for `mwdn.fourier.wiener.wiener`.
        """
        finest = self.psf.bands[-1]
        H = finest.transfer * finest.norm
        V = H.conj() * self.residual_spectrum / (H.abs().square() + regularisation)
        return inverse_spectrum(V, finest.grid, size_of(self.scene))


class Band(NamedTuple):
    """The PSF at one level: its transfer function over ``norm``, so that its colours have a mean square sum of 1."""

    level: Level
    transfer: Spectrum
    norm: Tensor

    @property
    def grid(self) -> Size:
        """Height and width of the whole spectrum; the width is even."""
        return self.transfer.shape[-2], 2 * (self.transfer.shape[-1] - 1)


@dataclass(frozen=True)
class PsfPyramid:
    """The PSF at all levels, prepared once for many measurements of one size."""

    bands: tuple[Band, ...]

    @classmethod
    def from_psf(cls, psf: Psf, size: Size, levels: tuple[Level, ...] = LEVELS) -> "PsfPyramid":
        """Prepare a PSF (1 or B, 1 or C, h, w), centred, of any sum, for measurements of ``size``."""
        coarsest = levels[0].downsampling
        # The grid of a linear convolution, divisible by the coarsest level's downsampling.
        lengths = zip(size, psf.shape[-2:], strict=True)
        rows, columns = (fast_length(-(-(s + p) // coarsest)) * coarsest for s, p in lengths)
        H = transfer_function(unit_sum(psf.float()), (rows, columns))
        bands = []
        for level in levels:
            low = low_band(H, (rows, columns), level.downsampling)
            grid = rows // level.downsampling, columns // level.downsampling
            norm = inverse_spectrum(low, grid, grid).square().sum((-2, -1), keepdim=True).mean(1, keepdim=True).sqrt()
            norm = norm.clamp(min=TINY)
            bands.append(Band(level, low / norm, norm))
        return cls(tuple(bands))

    def solve(self, measurement: Measurement) -> Estimate:
        """Estimate a smooth non-negative scene (B, C, H, W), from coarse to fine. Differentiable."""
        size = size_of(measurement)
        # tau is stated for a measurement of unit mean square.
        unit = root_mean_square(measurement)
        b = measurement.float() / unit
        noise = relative_noise(measurement)
        smooth = any(band.level.regularisation for band in self.bands)
        scale = smoothing_scale(noise) if smooth else torch.ones_like(unit)
        size_factor = math.sqrt(size[0] * size[1]) / REFERENCE_SIDE
        saturated = saturated_pixels(b)
        sizes, parts, side = {1: b}, {1: saturated.float()}, 1
        while side < self.bands[0].level.downsampling:
            sizes[2 * side], parts[2 * side] = halve(sizes[side]), halve(parts[side])
            side *= 2
        scene: Tensor = b.new_zeros((1, 1, 1, 1))
        work = [band.level.iterations / band.level.downsampling**2 for band in self.bands]  # in proportion to time
        for number, band in enumerate(self.bands):
            done = [sum(work[:end]) / max(sum(work), 1e-9) for end in (number, number + 1)]
            side = band.level.downsampling
            problem = Problem.from_transfer(sizes[side], band.transfer, parts[side] > MIXED)
            scene = _solve(problem, band, scene, scale, size_factor, done)
        return Estimate(measurement, scene.clamp(min=0) * unit, self, saturated, noise)


def solve(measurement: Measurement, psf: Psf, levels: tuple[Level, ...] = LEVELS) -> Estimate:
    """Fit a smooth non-negative scene to the measurement, from coarse to fine. Differentiable.

    Args:
        measurement: (B, C, H, W).
        psf: (1 or B, 1 or C, h, w), centred, of any sum; the scene is that for a unit sum of each colour.
        levels: the coarsest first.

    Raises:
        ShapeError: batch or channels do not fit.
    """
    check_fit(measurement, psf, "measurement")
    return PsfPyramid.from_psf(psf, size_of(measurement), levels).solve(measurement)


def halve(image: Tensor) -> Tensor:
    """Half the size, rounded up: binomial weights (1, 3, 3, 1) / 8 along each axis around each 2 x 2 pixels.

    They suppress aliasing much better than the mean of 2 x 2 pixels.
    """
    # Sums, not convolutions, which autocast would round to half precision.
    height, width = image.shape[-2:]
    padded = F.pad(image, (1, 1 + width % 2, 1, 1 + height % 2), mode="replicate")
    a, b, c, d = (padded[..., i : padded.shape[-2] - 3 + i : 2, :] for i in range(4))
    rows = (a + d + 3 * (b + c)) / 8
    a, b, c, d = (rows[..., i : padded.shape[-1] - 3 + i : 2] for i in range(4))
    return (a + d + 3 * (b + c)) / 8


def enlarge(image: Tensor, size: Size) -> Tensor:
    """Bilinear interpolation to a larger size.

    Anti-aliasing changes nothing there, but torch's kernel for it works along one axis at a time: a third faster.
    """
    return F.interpolate(image, size=size, mode="bilinear", antialias=not torch.compiler.is_compiling())


def low_band(transfer: Spectrum, grid: Size, downsampling: int) -> Tensor:
    """Low frequencies of a transfer function: that of a camera whose pixels are ``downsampling`` times as long."""
    rows, columns = grid[0] // downsampling, grid[1] // downsampling
    low = torch.cat([transfer[..., : rows // 2, :], transfer[..., grid[0] - rows + rows // 2 :, :]], dim=-2)
    return low[..., : columns // 2 + 1].mT.contiguous().mT  # the memory layout of `spectrum`


def even_start(problem: Problem) -> Tensor:
    """Even light in the frame, black around it, (B, C, *grid): as bright in each colour as fits the measurement."""
    b, (rows, columns), (height, width) = problem.measurement, problem.grid, problem.sensor
    V = spectrum(torch.full_like(b, 1.0), problem.grid)
    seen = inverse_spectrum(problem.transfer * V, problem.grid, problem.sensor)
    light = (seen * b).sum((-2, -1), keepdim=True) / seen.square().sum((-2, -1), keepdim=True).clamp(min=1e-30)
    return F.pad(light.clamp(min=0).expand_as(b), (0, columns - width, 0, rows - height))


def _solve(
    problem: Problem, band: Band, coarser: Tensor, scale: Tensor, size_factor: float, done: list[float]
) -> Tensor:
    """Scene on the whole grid after the iterations of one level, started at the coarser scene."""
    # The penalties are stated for a PSF whose colours have a mean square sum of 1, so the scene is times that norm.
    level = band.level
    start = even_start(problem) if level.lit else enlarge(coarser, band.grid).clamp(min=0) * band.norm
    mu, tau = level.smoothing(scale)
    tau = size_factor * tau
    smooth = level.regularisation > 0
    filters = make_filters(problem, mu, smooth=smooth)
    updates = (
        partial(update_copies, problem=problem, mu=mu, tau=tau, variation="colour", relaxation=level.relaxation),
        partial(update_scene, problem=problem, filters=filters),
    )
    start = start.expand(*problem.measurement.shape[:2], *band.grid)
    # No variable holds the initial state: it is freed after the first iteration.
    state = repeat(updates, initial_state(problem, start, smooth=smooth), level.iterations, start=done[0], end=done[1])
    return state.v / band.norm

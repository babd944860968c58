"""Turn, scale and haze a PSF until it explains the capture: what has changed in a camera since its calibration."""

from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional as F

from mwdn.fourier.convolution import check_fit
from mwdn.fourier.transforms import frequency_grid, inverse_spectrum, spectrum
from mwdn.optics.warp import hazed, warp
from mwdn.solvers.pyramid import Level, halve, solve
from mwdn.solvers.splitting import Penalties
from mwdn.types import Image, Measurement, Psf, Size


class Pose(NamedTuple):
    """How the PSF of each capture differs from the calibrated one.

    Args:
        turn_degrees: (B,), clockwise.
        scale: (B,), relative magnification, 0 for none.
        haze: (B,), part of the light that lies evenly under the PSF: scattered by the mask or the sensor's glass, or
            taken from the PSF as if it had been the sensor's black.
    """

    turn_degrees: Tensor
    scale: Tensor
    haze: Tensor | float = 0.0

    def move(self, psf: Psf) -> Tensor:
        """The PSF (1 or B, C, h, w) as each capture met it: (B, C, h, w), each colour of unit sum."""
        angle, size = torch.deg2rad(self.turn_degrees), 1 + self.scale
        c, s = size * angle.cos(), size * angle.sin()
        moved = warp(psf, torch.stack([torch.stack([c, s], -1), torch.stack([-s, c], -1)], 1))
        moved = moved / moved.sum((-2, -1), keepdim=True).clamp(min=torch.finfo(torch.float32).tiny)
        return hazed(moved, torch.as_tensor(self.haze, device=moved.device).reshape(-1, 1, 1, 1))


_PLAIN = Penalties(0.15, 0.0, 0.6)  # without total variation

# At half the size, where a turn by 0.5 degrees still moves the outer lines of a PSF of 320 pixels by 0.7 of them.
# Total variation in the last level keeps a shrunken, so sharper PSF from explaining the noise.
_LEVELS = (
    Level(4, 20, _PLAIN),
    Level(2, 20, _PLAIN),
    Level(1, 8, Penalties(0.1, 1.5, 1.5), 0.02, least=0.2),
)
_COARSE = 0.03  # periods a pixel: below it, ambient light and iterations that have not ended are most of what is left
_LIKELY = (0.5, 0.01)  # degrees and relative magnification by which a calibration may be wrong
_DELTA = (0.1, 0.002)  # for the derivatives
_WORTH = 1e-3  # part of what is left that a pose explains, or the PSF stays as it was calibrated
_SHARED = 20.0  # pixels that tell as much as one: what is left is alike in neighbours

# At a quarter of the size: haze is nothing but low frequencies.
_HAZES = (0.0, 0.02, 0.04, 0.07, 0.1, 0.14, 0.2)
_HAZE_LEVELS = (Level(2, 20, _PLAIN), Level(1, 20, _PLAIN))


@torch.no_grad()
def align(measurement: Measurement, psf: Psf, *, steps: int = 2) -> Pose:
    """Find the turn, scale and haze with which the PSF explains each capture best, from nothing but the capture.

    A wrong PSF leaves more of the measurement unexplained, whatever the scene: the energy that is left by the best
    scene is smooth in turn and scale, and least at the truth. Gauss-Newton steps go there. Their derivatives are those
    of what is left once the scene has been found anew (variable projection): with a scene that stands still the steps
    would be three times too short. A step that leaves more unexplained is not taken, and a PSF whose best pose explains
    hardly more than its own stays where it is: with an exact one that is noise.

    Then the haze. Faint light all over the scene explains a haze that the PSF lacks, but nothing explains one that the
    camera lacks, for light is not negative: what is left is level up to the true haze and rises steeply behind it. So
    it is the largest that explains about as well as none. Blur cannot be found: a sharper PSF always explains more.

    Args:
        measurement: (B, C, H, W).
        psf: (1 or B, 1 or C, h, w), centred.
        steps: each takes three scenes of half the size. Two find half a degree and 1 % to within a tenth of it.

    Raises:
        ShapeError: batch or channels do not fit.

    References:
        G. Golub and V. Pereyra, Separable nonlinear least squares: the variable projection method and its
        applications, Inverse Problems 19, R1 (2003).
    """
    check_fit(measurement, psf, "measurement")
    small = halve(measurement.float())
    small = small / small.abs().amax((1, 2, 3), keepdim=True).clamp(min=torch.finfo(torch.float32).tiny)
    delta, likely = small.new_tensor(_DELTA), small.new_tensor(_LIKELY)
    around = torch.cat([delta.new_zeros(1, 2), delta.diag()])
    pose = best = delta.new_zeros(len(small), 2)
    least = calibrated = delta.new_full((len(small),), torch.inf)
    for step in range(steps):
        left = _unexplained(small, psf, pose[:, None] + around)
        best, least = _better(pose, left[:, 0], best, least)
        if step == 0:
            calibrated = least
        # The likeliest pose, given how wrong calibrations are: a damped step.
        A = (left[:, 1:] - left[:, :1]) / delta[:, None]
        noise = _SHARED * left[:, 0].square().mean(1).clamp(min=1e-30)[:, None, None]
        slope = A @ left[:, 0, :, None] + noise * (pose / likely.square())[..., None]
        curvature = A @ A.mT + noise * likely.square().reciprocal().diag()
        pose = pose - torch.linalg.solve(curvature, slope)[..., 0]
    best, least = _better(pose, _unexplained(small, psf, pose[:, None])[:, 0], best, least)
    best = torch.where((least < (1 - _WORTH) * calibrated)[:, None], best, 0.0)
    found = Pose(best[:, 0], best[:, 1])
    return found._replace(haze=_haze(halve(small), _halved(_halved(found.move(psf)))))


def _better(pose: Tensor, left: Tensor, best: Tensor, least: Tensor) -> tuple[Tensor, Tensor]:
    energy = left.square().sum(1)
    return torch.where((energy < least)[:, None], pose, best), torch.minimum(energy, least)


def _haze(measurement: Measurement, psf: Psf) -> Tensor:
    """Haze (B,) under the PSF (B, C, h, w) of each capture: where what is left at low frequencies begins to rise.

    As a parabola that far beyond has the curvature E'' it has then risen by 1.4 % of its least value E. With this part,
    the best of 0.5 to 3 %, no haze was found in 16 exact captures through two measured PSFs, and 95 % of the decibels
    gained that the best haze of each of 16 others gains.
    """
    hazes = measurement.new_tensor(_HAZES)
    each = hazed(psf.repeat_interleave(len(hazes), 0), hazes.repeat(len(psf))[:, None, None, None])
    found = solve(measurement.repeat_interleave(len(hazes), 0), each, _HAZE_LEVELS)
    grid = found.psf.bands[-1].grid
    left = inverse_spectrum(found.residual_spectrum * _low(grid, 4 * _COARSE, measurement.device), grid, grid)
    left = left.square().sum((1, 2, 3)).reshape(-1, len(hazes))
    slope = (left.diff() / hazes.diff()).cummax(1).values
    curvature = 2 * left[:, -1:] / hazes[-1] ** 2
    level = slope < (2 * 0.014 * left.amin(1, keepdim=True) * curvature).sqrt()
    return hazes[level.sum(1)]


@torch.no_grad()
def misfit(measurement: Measurement, psf: Psf) -> Tensor:
    """Part of each measurement's detail that no scene explains with this PSF as it is, (B,): what `align` makes small.

    Args:
        measurement: (B, C, H, W).
        psf: (1 or B, 1 or C, h, w), centred.
    """
    small = halve(measurement.float())
    left = _unexplained(small, psf, small.new_zeros(len(small), 1, 2))[:, 0].square().sum(1)
    return left / fine_detail(small).square().sum((1, 2, 3)).clamp(min=torch.finfo(torch.float32).tiny)


def fine_detail(image: Image) -> Image:
    """What is finer than about 30 pixels in a picture, periodically continued."""
    grid = image.shape[-2], image.shape[-1]
    return inverse_spectrum(spectrum(image, grid) * (1 - _low(grid, _COARSE, image.device)), grid, grid)


def _unexplained(measurement: Tensor, psf: Psf, poses: Tensor) -> Tensor:
    """Detail that is left of each measurement with each of its poses (B, K, 2): (B, K, pixels)."""
    count = poses.shape[1]
    each = psf.expand(len(measurement), -1, -1, -1).repeat_interleave(count, 0)
    moved = Pose(*poses.flatten(0, 1).unbind(-1)).move(each)
    found = solve(measurement.repeat_interleave(count, 0), _halved(moved), _LEVELS)
    grid = found.psf.bands[-1].grid
    left = inverse_spectrum(found.residual_spectrum * (1 - _low(grid, _COARSE, measurement.device)), grid, grid)
    return left.reshape(len(measurement), count, -1)


def _halved(psf: Psf) -> Tensor:
    """Of pixels twice as long. The centre may move by one of them, and with it the scene, which nobody sees."""
    return F.avg_pool2d(F.pad(psf, (0, psf.shape[-1] % 2, 0, psf.shape[-2] % 2)), 2)


def _low(grid: Size, limit: float, device: torch.device) -> Tensor:
    rows, columns = frequency_grid(grid, device=device)
    return torch.exp(-(rows.square() + columns.square()) / (2 * limit**2))

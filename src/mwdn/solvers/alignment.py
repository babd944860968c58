"""Align a PSF to a capture: what has changed since the camera's calibration, estimated from the capture alone.

Rotation and scale of the PSF, displacement of the aperture's shadow against the mask's pattern, and haze.

The capture b is a scene v through a PSF of pose theta = (turn, scale). Variable projection eliminates the scene:

1. ``v(theta) = argmin |C H(theta) v - b|^2 + tau |Psi v|_1`` over ``v >= 0``, by a short pyramid
2. ``r(theta) = high_pass(b - g C H(theta) v(theta))``, g the sensor's fall-off: a quadratic polynomial, least squares
3. ``E(theta) = |r(theta)|^2``, smooth in theta and least at the true pose: a wrong PSF leaves a larger residual for
   every scene

Without g in (2), a smaller PSF would imitate a fall-off: one of 20 % to the corners moves the scale by 2.5 %.

Gauss-Newton steps minimise E with a Gaussian prior of standard deviations S on theta:

4. ``A = dr / dtheta`` by finite differences of (2), so with a new scene for each pose. With a fixed scene the steps
   would be three times too short.
5. ``(A^T A + s^2 S^-2) step = -(A^T r + s^2 S^-2 theta)``, where s^2 is the noise variance of the residual

With the pose known, one such step finds the displacement d of the envelope (`mwdn.optics.aperture.displaced_envelope`),
with theta = d. For near objects, pattern and envelope have different scales. A d estimated with the pose would change
the pattern's scale and blur the picture; a d estimated after it causes faint ghosts. So d is zero for them. Where the
PSF is exact, a small wrong d lowers E a little, so d is used only if it lowers E clearly (`MIN_ENVELOPE_GAIN`).

Haze is estimated after that. A faint veil over the scene compensates a haze that is missing from the PSF, but nothing
compensates too much haze, because light is not negative: E at low frequencies is flat up to the true haze, then rises
steeply. The estimate is the largest haze of the flat part. Blur cannot be estimated: a sharper PSF always fits better.
"""

import torch
from torch import Tensor
from torch.nn import functional as F

from mwdn.arguments import checked
from mwdn.errors import ParameterError
from mwdn.fourier.convolution import check_fit
from mwdn.fourier.transforms import gaussian_transfer, inverse_spectrum, spectrum
from mwdn.optics.aperture import displaced_envelope
from mwdn.optics.psf import checked_psf
from mwdn.optics.saturation import saturated_pixels
from mwdn.optics.warp import hazed
from mwdn.solvers.levels import Level, relative_noise, root_mean_square
from mwdn.solvers.pose import POSE_BLUR, Pose
from mwdn.solvers.pyramid import halve, solve
from mwdn.solvers.splitting import Penalties
from mwdn.types import TINY, Image, Measurement, Psf, Size, size_of

_NO_VARIATION = Penalties(0.15, 0.0, 0.6)

# At half the size, where a turn by 0.5 degrees still moves the outer lines of a PSF of 320 pixels by 0.7 pixels.
# Total variation in the last level keeps a smaller, so sharper PSF from fitting the noise.
SMOOTH_LEVELS = (
    Level(4, 20, _NO_VARIATION),
    Level(2, 20, _NO_VARIATION),
    Level(1, 8, Penalties(0.1, 1.5, 1.5), 0.02, min_smoothing=0.2),
)
_BLUR = 5.305  # pixels, 0.03 cycles per pixel: below, most of the residual is ambient light and unconverged iterations
_MAX_FALL_OFF = 0.5  # coefficient of any polynomial: that of x^2 + y^2 then loses all light in the corners
_REACH = 16  # pixels, three standard deviations of the Gaussian of `_BLUR`
_PRIOR = (0.5, 0.01)  # standard deviations S of a calibration's errors: degrees and relative magnification
_DELTA = (0.1, 0.002)  # finite differences
_ENVELOPE_PRIOR = (0.015, 0.015)  # of the envelope: down and right, over the shorter side
_ENVELOPE_DELTA = (0.004, 0.004)
_ENVELOPE_PARTS = (1.5, 1.0, 0.5, 0.25)  # of its step, tried in turn: it is often too long in real captures
_MIN_SIDE = 200  # pixels: at half of 160, the paper's PSF is so coarse that exact captures seem displaced: -1 dB each
_MAX_SCALE = 0.02  # relative magnification of an object that is about as far away as the calibration's source
_CORRELATED = 20.0  # pixels of the residual that count as one independent sample
MIN_GAIN = 1e-3
"""Part of the residual's energy that a pose must explain; otherwise the calibrated PSF is kept. With an exact PSF a
smaller gain is noise."""

MIN_ENVELOPE_GAIN = 0.02
"""The same for the displacement of the envelope, up to a noise of `_GOOD_LIGHT`; beyond it falls as 1 / noise, because
noise raises E and hides what a displacement explains. 160 captures through four measured PSFs without displacement, on
dark or filling the frame, exact or mismatched, are below: at most 0.019 in good light, 0.005 in low light. Of 20
real-like ones 17 are above in good light, 12 in low light. A third of the saturated part is added: clipped lines do not
contradict a wrong displacement. With 5 % saturated one gained 0.02 and cost 3 dB, with 41 % one gained 0.13."""

_GOOD_LIGHT = 0.02  # noise over the measurement's root mean square: at 15,000 electrons 0.009 to 0.018

# At a quarter of the size: haze has only low frequencies, which converge slowest. With 20 iterations each, the haze of
# frames that are filled was not found, which cost 1 to 3 dB. Strong smoothing keeps noise and detail from being
# explained as haze. Not `LEVELS`: their over-relaxation makes the haze of exact cameras 1 to 2 % larger.
_HAZES = (0.0, 0.02, 0.04, 0.07, 0.1, 0.14)
_HAZE_LEVELS = (
    Level(2, 80, Penalties(0.015, 0.4, 0.06), 0.04),
    Level(1, 40, Penalties(0.05, 1.3, 0.2), 0.04),
)
_MIN_HAZE = 0.001  # less is none: E rises by 5 % shortly after its minimum at no haze
_HAZE_RISE = 1.05
"""E over its minimum at which the flat part ends: the best from 1.03 to 1.15. 40 captures through three measured PSFs,
exact and under 10 % of haze, come within 0.05 dB of their best haze, and 24 that fill the frame within 0.25 dB."""


MIN_DETAIL = 1.7
"""Detail of a capture over its noise, both at a quarter of the size, below which it shows nothing to align by. Dark and
even frames have 1.3 to 1.4, simulated captures of 100 electrons 2.2, of 2,000 electrons 9, real ones 20 and more."""

_ROUNDING_DETAIL = 1e-3  # over the root mean square: without noise, rounding is detail; real captures have 0.04 to 0.07
_QUARTER_NOISE = 0.11  # standard deviation of white noise after `halve` twice


@checked
@torch.no_grad()
def align(measurement: Measurement, psf: Psf, *, steps: int = 2, min_gain: float = MIN_GAIN) -> Pose:
    """Estimate rotation, scale, displaced envelope and haze of each capture's PSF from the capture alone.

    Args:
        measurement: (B, C, H, W), a tensor as `mwdn.Calibration.correct` returns it for an array or picture. For one
            with NaN or infinity, or without detail (`has_detail`), the calibrated pose is returned, all zeros.
        psf: (1 or B, 1 or C, h, w), centred: `mwdn.Calibration.psf`. Its scale does not matter.
        steps: of Gauss-Newton for rotation and scale; each solves three scenes of half the size. Two reach half a
            degree and 1 % to within a tenth of it. A step that increases the residual is not taken.
        min_gain: part of the residual's energy, see `MIN_GAIN`.

    Raises:
        ShapeError: batch or channels do not fit.
        ParameterError: not tensors of floats, or negative ``steps``.
        PsfError: the PSF is negative, not finite, or dark.

    References:
        G. Golub and V. Pereyra, Separable nonlinear least squares: the variable projection method and its
        applications, Inverse Problems 19, R1 (2003).
    """
    check_fit(measurement, psf, "measurement")
    if steps < 0:
        raise ParameterError(f"`steps` ({steps}) must not be negative; 0 keeps rotation and scale.")
    seen = has_detail(measurement)
    if not seen.any():
        none = torch.zeros(len(seen), device=seen.device)
        return Pose(none, none, none)
    half = halve(measurement.float())
    half = half / half.abs().amax((1, 2, 3), keepdim=True).clamp(min=TINY)
    psf = checked_psf(psf).expand(len(half), -1, -1, -1)
    pose = _estimate_pose(half, psf, steps, min_gain)
    if min(measurement.shape[-2:]) >= _MIN_SIDE:
        least_gain = MIN_ENVELOPE_GAIN * (_GOOD_LIGHT / relative_noise(measurement)).clamp(max=1).flatten()
        least_gain = least_gain + saturated_pixels(measurement).float().mean((1, 2, 3)) / 3
        envelope = _estimate_envelope(half, halve_psf(pose.move(psf)), least_gain)
        pose = pose._replace(envelope=torch.where((pose.scale.abs() <= _MAX_SCALE)[:, None], envelope, 0.0))
    haze = _estimate_haze(halve(half), halve_psf(halve_psf(pose.move(psf))))
    turn_degrees, scale, haze = (torch.where(seen, value, 0.0) for value in (pose.turn_degrees, pose.scale, haze))
    shift = None if pose.envelope is None else torch.where(seen[:, None], pose.envelope, 0.0)
    return Pose(turn_degrees, scale, haze, shift)


def has_detail(measurement: Measurement) -> Tensor:
    """Whether each capture shows more than noise and even light, (B,); false for one with NaN or infinity."""
    unit, noise = root_mean_square(measurement), relative_noise(measurement)
    detail = root_mean_square(fine_detail(halve(halve(measurement.float() / unit))))
    return (detail > (MIN_DETAIL * _QUARTER_NOISE * noise).clamp(min=_ROUNDING_DETAIL)).flatten()


def _estimate_pose(half: Measurement, psf: Psf, steps: int, min_gain: float) -> Pose:
    """Rotation and scale of least E for captures (B, C, H, W) of half the size and PSFs (B, C, h, w)."""
    delta, prior = half.new_tensor(_DELTA), half.new_tensor(_PRIOR)
    offsets = torch.cat([delta.new_zeros(1, 2), delta.diag()])

    def residual(poses: Tensor) -> Tensor:
        turn_degrees, scale = poses.flatten(0, 1).unbind(-1)
        psfs = psf.repeat_interleave(poses.shape[1], 0)
        return _residual(half, halve_psf(Pose(turn_degrees, scale).move(psfs)))

    theta = best = delta.new_zeros(len(half), 2)
    energy = calibrated = delta.new_full((len(half),), torch.inf)
    for step in range(steps):
        r = residual(theta[:, None] + offsets)
        best, energy = _better(theta, r[:, 0], best, energy)
        if step == 0:
            calibrated = energy
        A = (r[:, 1:] - r[:, :1]) / delta[:, None]
        theta = theta + _gauss_newton_step(A, r[:, 0], theta, prior)
    best, energy = _better(theta, residual(theta[:, None])[:, 0], best, energy)
    best = torch.where((energy < (1 - min_gain) * calibrated)[:, None], best, 0.0)
    return Pose(best[:, 0], best[:, 1])


def _estimate_envelope(half: Measurement, psf: Psf, least_gain: Tensor) -> Tensor:
    """`Pose.envelope` (B, 2) of PSFs (B, C, h, w) of half the size: the best part of one Gauss-Newton step.

    Zero where it lowers the residual's energy by less than ``least_gain`` (B,).
    """
    delta, prior = half.new_tensor(_ENVELOPE_DELTA), half.new_tensor(_ENVELOPE_PRIOR)

    def residual(shifts: Tensor) -> Tensor:
        psfs, pixels = psf.repeat_interleave(shifts.shape[1], 0), shifts.flatten(0, 1) * min(psf.shape[-2:])
        return _residual(half, displaced_envelope(psfs, pixels, blur=POSE_BLUR))

    none = delta.new_zeros(len(half), 2)
    r = residual(none[:, None] + torch.cat([none[:1], delta.diag()]))
    A = (r[:, 1:] - r[:, :1]) / delta[:, None]
    parts = half.new_tensor(_ENVELOPE_PARTS)[:, None] * _gauss_newton_step(A, r[:, 0], none, prior)[:, None]
    energy, best = residual(parts).square().sum(-1).min(1)
    is_displaced = energy < (1 - least_gain) * r[:, 0].square().sum(1)
    return torch.where(is_displaced[:, None], parts[torch.arange(len(parts)), best], 0.0)


def _gauss_newton_step(A: Tensor, r: Tensor, theta: Tensor, prior: Tensor) -> Tensor:
    """Equation (5) for A (B, P, pixels), transposed, r (B, pixels) and theta (B, P)."""
    variance = _CORRELATED * r.square().mean(1).clamp(min=1e-30)[:, None, None]
    slope = A @ r[..., None] + variance * (theta / prior.square())[..., None]
    curvature = A @ A.mT + variance * prior.square().reciprocal().diag()
    return -torch.linalg.solve(curvature, slope)[..., 0]


def _better(theta: Tensor, r: Tensor, best: Tensor, least: Tensor) -> tuple[Tensor, Tensor]:
    """For each sample the pose with the smaller energy, and that energy."""
    energy = r.square().sum(1)
    return torch.where((energy < least)[:, None], theta, best), torch.minimum(energy, least)


def _estimate_haze(measurement: Measurement, psf: Psf) -> Tensor:
    """Haze (B,) under the PSF (B, C, h, w) of each capture: where E(haze) leaves its flat part, interpolated."""
    hazes = measurement.new_tensor(_HAZES)
    psfs = hazed(psf.repeat_interleave(len(hazes), 0), hazes.repeat(len(psf))[:, None, None, None])
    estimate = solve(measurement.repeat_interleave(len(hazes), 0), psfs, _HAZE_LEVELS)
    grid = estimate.psf.bands[-1].grid
    low = gaussian_transfer(grid, _BLUR / 4, device=measurement.device)
    residual = inverse_spectrum(estimate.residual_spectrum * low, grid, grid)
    energy = residual.square().sum((1, 2, 3)).reshape(-1, len(hazes))
    limit = _HAZE_RISE * energy.amin(1, keepdim=True)
    last = (energy < limit).long().cumsum(1).argmax(1, keepdim=True)  # the last True: argmax takes the first maximum
    after = (last + 1).clamp(max=len(hazes) - 1)
    below, above = energy.gather(1, last), energy.gather(1, after)
    part = (limit - below) / (above - below).clamp(min=torch.finfo(energy.dtype).tiny)
    haze = torch.lerp(hazes[last], hazes[after], part.clamp(max=1))[:, 0].nan_to_num()
    return F.threshold(haze, _MIN_HAZE, 0.0)


def fine_detail(image: Image) -> Image:
    """High-pass filter: detail finer than about 30 pixels. Beyond its border the image is mirrored."""
    height, width = image.shape[-2:]
    down, right = min(_REACH, height - 1), min(_REACH, width - 1)
    wide = F.pad(image.float(), (right, right, down, down), mode="reflect")
    grid = wide.shape[-2], wide.shape[-1] + wide.shape[-1] % 2
    smooth = inverse_spectrum(spectrum(wide, grid) * gaussian_transfer(grid, _BLUR, device=image.device), grid, grid)
    return image - smooth[..., down : down + height, right : right + width]


def _residual(measurement: Tensor, psfs: Psf) -> Tensor:
    """Equation (2) for each measurement and each of its K PSFs (B K, C, h, w): (B, K, pixels)."""
    count = len(psfs) // len(measurement)
    estimate = solve(measurement.repeat_interleave(count, 0), psfs, SMOOTH_LEVELS)
    grid = estimate.psf.bands[-1].grid
    high = 1 - gaussian_transfer(grid, _BLUR, device=measurement.device)
    r = inverse_spectrum(estimate.residual_spectrum * high, grid, grid)
    b = inverse_spectrum(spectrum(measurement, grid) * high, grid, grid)  # the prediction is b - r, high-passed
    size = size_of(measurement)
    return _without_fall_off(r, b.repeat_interleave(count, 0) - r, size, count).reshape(len(measurement), count, -1)


def _without_fall_off(whole: Tensor, prediction: Tensor, size: Size, count: int) -> Tensor:
    """Remove the sensor's fall-off from a residual r: ``r - sum_k a_k q_k p``, a by least squares.

    The residual and the high-passed prediction are given on a grid (N, C, rows, columns) that begins with the sensor.
    The polynomials q are smooth, so that the high-passed product with a prediction is q times the high-passed
    prediction p. A fall-off of more than `_MAX_FALL_OFF` cannot be the sensor's: if one of a capture's ``count`` poses
    has it, all residuals of this capture stay unchanged, including what the high pass spreads beyond the sensor. All
    poses are treated alike, so that differences between residuals come from the poses only.
    """
    height, width = size
    r, p = whole[..., :height, :width], prediction[..., :height, :width]
    y, x = (torch.linspace(-1, 1, length, device=r.device, dtype=r.dtype) for length in r.shape[-2:])
    y, x = torch.meshgrid(y, x, indexing="ij")
    q = torch.stack([torch.ones_like(x), x, y, x * y, x.square() - y.square(), x.square() + y.square()])
    A = (q[:, None] * p[:, None]).flatten(2)
    normal = A @ A.mT
    ridge = (1e-6 * normal.diagonal(dim1=-2, dim2=-1).mean(-1)).clamp(min=1e-30)[:, None, None]
    a = torch.linalg.solve(normal + ridge * torch.eye(len(q)).to(r), A @ r.flatten(1)[..., None])
    is_sensor = (a.abs().amax((1, 2)) < _MAX_FALL_OFF).reshape(-1, count).all(1)
    unexplained = F.pad(
        r - (a.mT @ A)[:, 0].reshape(r.shape), (0, whole.shape[-1] - width, 0, whole.shape[-2] - height)
    )
    return torch.where(is_sensor.repeat_interleave(count)[:, None, None, None], unexplained, whole)


def halve_psf(psf: Psf) -> Tensor:
    """Bin a PSF by 2. Its centre may move by one of the new pixels, which shifts the scene and does not change E."""
    return F.avg_pool2d(F.pad(psf, (0, psf.shape[-1] % 2, 0, psf.shape[-2] % 2)), 2)

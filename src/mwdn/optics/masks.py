"""A mask as an optical element, and the PSF of a camera with it."""

import math
from dataclasses import dataclass
from typing import Any, Literal, Protocol, runtime_checkable

import torch

from mwdn.arguments import checked
from mwdn.errors import ParameterError
from mwdn.optics.propagation import UM_PER_MM, UM_PER_NM, check_positive, integrate, overlap, point_source, propagate
from mwdn.optics.setup import Setup
from mwdn.types import Field, Plane, Psf, Size

Kind = Literal["phase", "amplitude"]


@checked
@dataclass(frozen=True, eq=False)
class Mask:
    """A thin element that delays light (phase mask) or blocks it (amplitude mask); opaque beyond its border.

    Args:
        kind: phase or amplitude.
        values: heights in um (phase), or transmitted amplitudes in [0, 1]. Row 0 at the top, seen from the scene.
        pitch_um: sample spacing.
        index: refractive index n of a phase mask, the same for all wavelengths: n - 1 of fused silica changes by 2 %
            from green to the ends of the visible spectrum.
        step_um: height of one level; 0 for a continuous surface.

    Raises:
        UnknownNameError: `kind` is neither.
        ParameterError: `pitch_um` is not positive, or `index` of a phase mask not above 1.
    """

    kind: Kind
    values: Plane
    pitch_um: float
    index: float = 1.0
    step_um: float = 0.0

    def __post_init__(self) -> None:
        check_positive(pitch_um=self.pitch_um)
        if self.kind == "phase":
            check_index(self.index)

    @property
    def size_mm(self) -> tuple[float, float]:
        """Height and width."""
        height, width = self.values.shape
        return height * self.pitch_um / UM_PER_MM, width * self.pitch_um / UM_PER_MM

    def field(self, wavelength_nm: float) -> Field:
        """Complex transmission of each sample: ``exp(2 pi i (index - 1) height / wavelength)``, or the amplitude."""
        if self.kind == "amplitude":
            return torch.complex(self.values, torch.zeros_like(self.values))
        turns = self.values * ((self.index - 1) / (wavelength_nm * UM_PER_NM))
        return torch.polar(torch.ones_like(turns), 2 * math.pi * turns.frac())

    def middle(self, size: Size) -> "Mask":
        """Crop to at most ``size`` samples around the centre."""
        (height, width), (h, w) = self.values.shape, (min(a, b) for a, b in zip(self.values.shape, size, strict=True))
        top, left = height // 2 - h // 2, width // 2 - w // 2
        return Mask(self.kind, self.values[top : top + h, left : left + w], self.pitch_um, self.index, self.step_um)


@runtime_checkable
class MaskDesign(Protocol):
    """Parameters from which a mask can be computed."""

    def build(self, setup: Setup) -> Mask:
        """Compute the mask for a camera."""


def sample_counts(size_mm: tuple[float, float], pitch_um: float) -> Size:
    """Rows and columns of samples of a mask.

    Raises:
        ParameterError: a length is not positive, or there would be fewer than 2 or more than 20,000 samples a side.
    """
    check_positive(size_mm=min(size_mm), pitch_um=pitch_um)
    rows, columns = (round(side * UM_PER_MM / pitch_um) for side in size_mm)
    check_samples(rows, columns, f"`pitch_um` ({pitch_um:g}) and `size_mm` {size_mm}")
    return rows, columns


def check_samples(rows: int, columns: int, cause: str = "`mask`") -> None:
    """Check that each side of a mask has 2 to 20,000 samples: 20,000 x 20,000 complex numbers take 3 GB."""
    if not 2 <= min(rows, columns) <= max(rows, columns) <= 20_000:
        raise ParameterError(
            f"{cause} makes {rows:,} x {columns:,} samples, but a side must have 2 to 20,000. Change the pitch or the "
            "size."
        )


def quantise(height_um: Plane, levels: int | None) -> tuple[Plane, float]:
    """Round heights to ``levels`` even steps from 0 to the highest; returns them with the step. ``None``: no rounding.

    Raises:
        ParameterError: fewer than 2 levels or more than 65,536.
    """
    if levels is None:
        return height_um, 0.0
    check_levels(levels)
    if not height_um.max() > 0:  # flat
        return height_um, 0.0
    step = height_um.max().item() / (levels - 1)
    return (height_um / step).round() * step, step


def check_index(index: float) -> None:
    """Refuse a refractive index that does not exceed that of air."""
    if not index > 1:
        raise ParameterError(f"`index` ({index:g}) must be above 1, the index of air: 1.46 for fused silica.")


def check_levels(levels: int) -> None:
    """Refuse a number of levels outside 2 to 65,536."""
    if not 2 <= levels <= 65_536:
        raise ParameterError(f"`levels` ({levels}) must be 2 to 65,536. Leave it out for a continuous surface.")


def mask_psf(mask: Mask, setup: Setup, *, angle_degrees: tuple[float, float] = (0.0, 0.0)) -> Psf:
    """PSF of a camera: a point's light through the mask onto the sensor, its intensity summed over wavelengths.

    Args:
        mask: in the plane of the aperture, and cropped by it.
        setup: the camera without its mask.
        angle_degrees: of the point from the axis, downwards and to the right. The sensor does not move.

    Returns:
        (1, 1 or 3, *setup.size). The sum is the part of the aperture's light that reaches the sensor; divide by it for
        a `Camera`.

    Raises:
        ParameterError: the mask's pitch cannot sample the light behind it; the message says which pitch can.
    """
    pitch, mask = mask.pitch_um, _in_aperture(mask, setup)
    opening = tuple(side * UM_PER_MM for side in setup.aperture_mm)
    down, across = (overlap(1, side, n, pitch)[0] for side, n in zip(opening, mask.values.shape, strict=True))
    aperture = torch.outer(down, across).float()
    wavelengths, weights = setup.spectrum()
    needed, deflection = needed_pitch(mask, setup, angle_degrees=angle_degrees)
    if pitch > needed:
        raise ParameterError(
            f"`pitch_um` ({pitch:g}) cannot sample a surface that deflects light of {min(wavelengths):g} nm by "
            f"{deflection:.2g} degrees: use at most {needed:.3g} um, or a flatter surface; `subdivide` a smooth array. "
            "If it has steps, such as a wrapped phase, say how many: `levels=256`."
        )
    window = tuple(math.ceil(n * setup.pitch_um / pitch / 2) * 2 + 2 for n in setup.size)
    shape = mask.values.shape[0], mask.values.shape[1]
    psf = torch.zeros(len(weights), *setup.size)
    for wavelength, weight in zip(wavelengths, weights.T, strict=True):
        light: dict[str, Any] = {"pitch_um": pitch, "wavelength_nm": wavelength}
        field = point_source(shape, distance_mm=setup.source_mm, angle_degrees=angle_degrees, **light) * aperture
        sensor = propagate(
            field * mask.field(wavelength), distance_mm=setup.distance_mm, size=(window[0], window[1]), **light
        )
        power = sensor.real.square() + sensor.imag.square()
        pixels = integrate(power, pitch_um=pitch, size=setup.size, pixel_um=setup.pitch_um)
        psf += weight[:, None, None].float() * pixels
    return psf[None] / (opening[0] * opening[1] / pitch**2)


def _in_aperture(mask: Mask, setup: Setup) -> Mask:
    """Crop a mask to the samples that lie at least partly within the aperture."""
    rows, columns = (2 * math.ceil(side * UM_PER_MM / mask.pitch_um / 2) + 1 for side in setup.aperture_mm)
    return mask.middle((rows, columns))


def needed_pitch(mask: Mask, setup: Setup, *, angle_degrees: tuple[float, float] = (0.0, 0.0)) -> tuple[float, float]:
    """Largest pitch in um that samples the light behind a surface, ``wavelength / (2 sin(angle))``; and this angle.

    A surface deflects light by about its slope times ``index - 1``, on top of the angle of incidence. Surfaces in
    levels and amplitude masks have no slope: their samples are the structure, and any pitch will do.

    Returns:
        The pitch in um, with a tolerance of 1e-6 for rounding, and the angle in degrees.
    """
    if mask.kind == "amplitude" or mask.step_um > 0:
        return math.inf, 0.0
    mask, steepest = _in_aperture(mask, setup), 0.0
    for axis, angle in enumerate(angle_degrees):
        slope = mask.values.diff(dim=axis).abs().max().item() / mask.pitch_um * (mask.index - 1)
        half = mask.size_mm[axis] / 2 / setup.source_mm
        steepest = max(steepest, slope + math.sin(math.atan(math.tan(math.radians(abs(angle))) + half)))
    shortest = min(setup.spectrum()[0]) * UM_PER_NM
    needed = shortest / (2 * max(steepest, 1e-12))
    return needed * (1 + 1e-6), math.degrees(math.asin(min(1.0, steepest)))


def describe_mask(mask: Mask, psf: Psf) -> dict[str, Any]:
    """Size, pitch, material and light efficiency of a mask for a report, as plain values."""
    report: dict[str, Any] = {
        "kind": mask.kind,
        "samples": list(mask.values.shape),
        "size_mm": list(mask.size_mm),
        "pitch_um": mask.pitch_um,
        "light_on_sensor": [round(value, 6) for value in psf.sum((-2, -1))[0].tolist()],
    }
    if mask.kind == "phase":
        highest = round(mask.values.max().item(), 6)
        return report | {"index": mask.index, "step_um": mask.step_um, "highest_um": highest}
    return report | {"open_part": round(mask.values.square().mean().item(), 6)}

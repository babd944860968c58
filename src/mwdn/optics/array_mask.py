"""A mask from an array of numbers that another program computed or a microscope measured."""

import math
from collections.abc import Collection
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
import numpy.typing as npt
import torch
from torch.nn import functional as F

from mwdn.arguments import checked
from mwdn.errors import ImageError, ParameterError, ShapeError, UnknownNameError, shown
from mwdn.io.images import read_frame
from mwdn.io.npy import read_array
from mwdn.optics.mask_files import read_mask
from mwdn.optics.masks import Mask, check_index, check_samples, needed_pitch, quantise
from mwdn.optics.propagation import UM_PER_NM, check_positive
from mwdn.optics.setup import Setup
from mwdn.types import Plane

Numbers = npt.NDArray[Any]
Quantity = Literal["height", "phase", "amplitude", "transmission"]

_IGNORED: dict[Quantity, tuple[str, ...]] = {
    "height": ("phase_nm",),
    "phase": (),
    "amplitude": ("phase_nm", "index", "levels", "full_scale"),
    "transmission": ("phase_nm", "index", "levels", "full_scale"),
}
"""Options of `ArrayMask` without effect, by what the numbers are."""

_PLURAL = dict(zip(get_args(Quantity), ("heights", "phases", "amplitudes", "transmissions"), strict=True))

MAX_RELIEF_UM = 1000.0
"""Largest height of a mask above its lowest point. A larger one is not a thin mask; its numbers are probably in nm."""


@checked
@dataclass(frozen=True)
class ArrayMask:
    """A mask from a file: heights, phases, amplitudes or transmissions, or the mask.tif of another design.

    Args:
        mask: NPY, TIFF or PNG with one number per sample, row 0 at the top, seen from the scene; its middle is on the
            axis. The mask.tif of `mwdn design` needs no other option.
        values: what the numbers are. height: of the surface, in um. phase: delay of the light in radians; wrapped or
            not, of any sign. amplitude or transmission: part of the light's amplitude or power that passes, 0 to 1.
        pitch_um: side of a sample.
        full_scale: height in um or phase in radians of the largest number of a file of integers, 255 or 65,535;
            positive. Amplitudes and transmissions are 1 there.
        phase_nm: wavelength for which phases are given; the middle of the light's band unless given. Heights follow
            from it and from `index`: other colours have other phases.
        index: refractive index of a surface; 1.46 is fused silica.
        levels: round a surface to this many even steps; continuous unless given. A wrapped phase has steps, too.
        subdivide: compute with this many samples along each side of a sample. Needed where the samples are so large
            that light bends at their edges within the array's pitch: squares of 20 um need 10; and where a smooth
            surface is so steep that the array's pitch cannot sample the light behind it. A surface without `levels` is
            interpolated; all others consist of squares.
    """

    mask: Path
    values: Quantity | None = None
    pitch_um: float | None = None
    full_scale: float | None = None
    phase_nm: float | None = None
    index: float = 1.46
    levels: int | None = None
    subdivide: int = 1

    def build(self, setup: Setup) -> Mask:
        """Read the array and turn it into a mask.

        Raises:
            ImageError: the file cannot be read.
            ShapeError: it is not one picture in grey.
            ParameterError: an option is missing or out of its range, or the numbers cannot be what `values` says.
        """
        if designed := _read_design(self.mask):
            self._refuse(
                {field.name for field in fields(self)[1:]}, "is a design with its own pitch, heights and index"
            )
            needed, _ = needed_pitch(designed, setup)
            if designed.pitch_um > needed:
                raise ParameterError(
                    f"`{self.mask}` has samples {designed.pitch_um:g} um apart, too far for the light of this camera. "
                    f"Design it again for this camera: `mwdn design`, with `pitch_um={_floor(needed):g}`."
                )
            return designed
        frame = _grey(_read_numbers(self.mask))
        if self.values is None or self.pitch_um is None:
            raise ParameterError(
                f"`{self.mask}` holds numbers without units: say what they are, "
                f"{', '.join(get_args(Quantity))}, and how many um apart: `values='height', pitch_um=2`."
            )
        self._refuse(_IGNORED[self.values], f"holds {_PLURAL[self.values]}")
        mask = make_mask(
            _scaled(frame, self.values, self.full_scale),
            self.values,
            pitch_um=self.pitch_um,
            phase_nm=sum(setup.band_nm) / 2 if self.phase_nm is None else self.phase_nm,
            index=self.index,
            levels=self.levels,
            subdivide=self.subdivide,
        )
        _check_slope(mask, setup, self.subdivide)
        return mask

    def _refuse(self, names: Collection[str], why: str) -> None:
        """Refuse options that would be ignored."""
        changed = [field.name for field in fields(self) if getattr(self, field.name) != field.default]
        if given := [name for name in changed if name in names]:
            options = ", ".join(f"`{name}`" for name in given)
            raise ParameterError(f"`{self.mask}` {why}: leave out {options}, which would have no effect.")


def _check_slope(mask: Mask, setup: Setup, subdivide: int) -> None:
    """Check that a surface is sampled finely enough for the light behind it; the error says what to change."""
    needed, deflection = needed_pitch(mask, setup)
    if mask.pitch_um <= needed:
        return
    largest_step = max(mask.values.diff(dim=axis).abs().max().item() for axis in (0, 1))
    if subdivide * largest_step > 0.5 * (mask.values.max() - mask.values.min()).item():
        advice = "Its steps are as high as the whole surface, as those of a wrapped phase: `levels=256`."
    else:
        # Between samples slopes are up to 1.3 times steeper.
        parts = math.ceil(1.3 * subdivide * mask.pitch_um / needed)
        advice = f"Interpolate between them: `subdivide={parts}`."
    raise ParameterError(
        f"`mask` deflects light by {deflection:.2g} degrees, and its samples, {mask.pitch_um:.3g} um apart, must be at "
        f"most {needed:.3g} um apart to sample that. {advice}"
    )


def _floor(pitch_um: float) -> float:
    """Round a pitch down to two significant digits."""
    step = 10 ** (math.floor(math.log10(pitch_um)) - 1)
    return math.floor(pitch_um / step) * step


def make_mask(
    numbers: Plane,
    values: Quantity,
    *,
    pitch_um: float,
    phase_nm: float = 550.0,
    index: float = 1.46,
    levels: int | None = None,
    subdivide: int = 1,
) -> Mask:
    """Make a mask of an array, for `mwdn.optics.mask_psf`.

    Args:
        numbers: (H, W), see `ArrayMask` for them and the other arguments.
        values: what they are.
        pitch_um: side of a sample.
        phase_nm: wavelength for which phases are given.
        index: refractive index of a surface.
        levels: round a surface to this many even steps.
        subdivide: samples of the mask along each side of a number; see `ArrayMask`.

    Raises:
        ParameterError: ``numbers`` is no tensor (H, W); an argument is out of its range, NaN or infinity, an amplitude
            or transmission outside [0, 1], or a surface higher than `MAX_RELIEF_UM`.
        UnknownNameError: ``values`` is an unknown kind.
    """
    if values not in get_args(Quantity):
        raise UnknownNameError("quantity of a mask", values, get_args(Quantity))
    check_positive(pitch_um=pitch_um, phase_nm=phase_nm, subdivide=subdivide)
    if not isinstance(numbers, torch.Tensor) or numbers.ndim != 2:
        raise ParameterError(f"`numbers` ({shown(numbers)}) must be a tensor (H, W): `torch.from_numpy(array)`.")
    rows, columns = numbers.shape
    check_samples(rows * subdivide, columns * subdivide)
    if not numbers.isfinite().all():
        raise ParameterError("`mask` holds NaN or infinity. Fill the gaps, for example with 0.")
    pitch = pitch_um / subdivide
    if values in ("amplitude", "transmission"):
        amplitude = _amplitude(numbers, values)
        return Mask("amplitude", _subdivided(amplitude, subdivide), pitch)
    check_index(index)
    # A surface of height h delays light of wavelength w by the phase 2 pi h (index - 1) / w.
    um = phase_nm * UM_PER_NM / (2 * math.pi * (index - 1)) if values == "phase" else 1.0
    height, step = quantise(_relief(numbers.double() * um), levels)
    divide = _interpolated if levels is None else _subdivided
    surface = _relief(divide(height.float(), subdivide))  # bicubic interpolation undershoots the lowest height
    return Mask("phase", surface, pitch, index, step)


def _read_design(path: Path) -> Mask | None:
    """The mask of another design; ``None`` if the file is anything else."""
    try:
        return read_mask(path)
    except ImageError:
        return None


def _read_numbers(path: Path) -> Numbers:
    """The array of a file; openings stored as true and false become 1 and 0."""
    if path.suffix.lower() == ".npy":
        stored = read_array(path)
        if stored.dtype == bool:
            return stored.astype(np.float32)
        if stored.ndim != 2:
            raise ShapeError(f"`mask` {stored.shape} must be (H, W), one number per sample.")
    return read_frame(path)


def _grey(frame: Numbers) -> Numbers:
    """(H, W) of a frame in grey."""
    if frame.ndim == 3 and (frame == frame[..., :1]).all():
        frame = frame[..., 0]
    if frame.ndim != 2:
        raise ShapeError(f"`mask` {frame.shape} must have one number per sample, not colours. Save it as grey.")
    return frame


def _scaled(frame: Numbers, values: Quantity, full_scale: float | None) -> Plane:
    """The numbers in their unit, float32; integers are fractions of `full_scale`."""
    numbers = torch.from_numpy(np.ascontiguousarray(frame, np.float32))
    if frame.dtype.kind == "f":
        if full_scale is not None:
            raise ParameterError("`full_scale` is for files of integers; this one holds floats. Leave it out.")
        return numbers
    largest = int(np.iinfo(frame.dtype).max)
    if full_scale is not None and not full_scale > 0:
        raise ParameterError(f"`full_scale` ({full_scale:g}) must be positive.")
    if full_scale is None and values in ("height", "phase"):
        unit = "um" if values == "height" else "radians"
        raise ParameterError(
            f"The file holds integers: `full_scale` must say the {values} in {unit} that {largest:,} stands for, "
            "`full_scale=1.2`."
        )
    return numbers * ((1.0 if full_scale is None else full_scale) / largest)


def _amplitude(numbers: Plane, values: Quantity) -> Plane:
    low, high = numbers.min().item(), numbers.max().item()
    if low < 0 or high > 1:
        raise ParameterError(
            f"`mask` ({low:g} to {high:g}) must be in [0, 1] for {values}. For a surface: `values='height'` or 'phase'."
        )
    return numbers.float() if values == "amplitude" else numbers.float().sqrt()


def _relief(height_um: Plane) -> Plane:
    """Shift negative heights up to 0; a constant offset delays all light alike and has no effect."""
    low, high = height_um.min().item(), height_um.max().item()
    if high - low > MAX_RELIEF_UM:
        raise ParameterError(
            f"`mask` has heights from {low:g} to {high:g} um, more than {MAX_RELIEF_UM:g} um apart, but must be thin. "
            "Numbers in nm: divide them by 1,000."
        )
    return height_um - min(low, 0.0)


def _subdivided(plane: Plane, count: int) -> Plane:
    """Repeat each number in a square of ``count`` x ``count`` samples."""
    return plane.repeat_interleave(count, 0).repeat_interleave(count, 1)


def _interpolated(plane: Plane, count: int) -> Plane:
    """Bicubic interpolation; a linear one would have an edge at every sample, which deflects light."""
    return F.interpolate(plane[None, None], scale_factor=count, mode="bicubic")[0, 0] if count > 1 else plane

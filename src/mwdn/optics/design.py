"""A designed camera: its mask and PSF, and the files that describe it."""

import dataclasses
import math
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from torch import Tensor

from mwdn.errors import ParameterError, shown
from mwdn.io.contact_sheets import contact_sheet, thumbnail
from mwdn.io.files import as_image_error, check_regular, write_json
from mwdn.io.images import write_linear, write_picture
from mwdn.io.reading import read_json
from mwdn.optics.mask_files import write_mask
from mwdn.optics.masks import Mask, MaskDesign, describe_mask, mask_psf
from mwdn.optics.psf import psf_hash, unit_sum
from mwdn.optics.psf_measures import autocorrelation_width, likeness
from mwdn.optics.psf_spectrum import modulus_image
from mwdn.optics.setup import Setup
from mwdn.types import Psf

WRITTEN = ("mask.tif", "psf.tif", "preview.png", "camera.json")
"""Files of a design; the last says whose the others are."""

ANGLES = (1.0, 2.0, 5.0, 10.0)
"""Degrees off the axis at which `Designed.sensitivity` compares PSFs."""


@dataclass(frozen=True, eq=False)
class Designed:
    """A mask with its PSF, to be made, or simulated with ``Camera(designed.psf)``.

    Args:
        name: kind of mask.
        design: parameters of the mask.
        setup: the camera without its mask.
        mask: the result.
        light: PSF whose sum is the part of the aperture's light that reaches the sensor, see `mwdn.optics.mask_psf`.
    """

    name: str
    design: MaskDesign
    setup: Setup
    mask: Mask
    light: Psf

    @property
    def psf(self) -> Psf:
        """The PSF with sum 1 in each channel."""
        return unit_sum(self.light)

    @property
    def stored(self) -> Psf:
        """The PSF with maximum 1, as in psf.tif."""
        return self.psf / self.psf.max()

    def report(self) -> dict[str, Any]:
        """All parameters and results, as plain values for JSON; an infinite distance or focal length is None."""
        rows, columns = self.setup.size
        pitch_mm = self.setup.pitch_um / 1e3
        width = autocorrelation_width(self.psf)
        return {
            "mask": {"name": self.name} | _plain(dataclasses.asdict(self.design)),  # type: ignore[call-overload]
            "setup": _plain(dataclasses.asdict(self.setup)),
            "made": describe_mask(self.mask, self.light)
            | {
                "psf_size": [rows, columns],
                "psf_pitch_um": self.setup.pitch_um,
                "psf_hash": psf_hash(unit_sum(self.stored)),
                "autocorrelation_width_px": round(width, 3),
                "resolution_mrad": round(1e3 * width * pitch_mm / self.setup.distance_mm, 3),
                "field_degrees": [
                    round(2 * math.degrees(math.atan(n / 2 * pitch_mm / self.setup.distance_mm)), 2)
                    for n in (rows, columns)
                ],
            },
        }

    def sensitivity(self) -> dict[str, dict[str, float]]:
        """`likeness` of the PSF with the PSFs of points nearer, farther and off the axis; 1 means no change.

        Three wavelengths stand for the band. Angles end where the mask's pitch can no longer sample the light.
        """
        coarse = dataclasses.replace(self.setup, wavelengths=min(3, self.setup.wavelengths))
        reference = mask_psf(self.mask, coarse)
        # A source beyond 1,000 mask-to-sensor distances is as good as infinitely far.
        source = min(self.setup.source_mm, 1e3 * self.setup.distance_mm)
        by_distance: dict[str, float] = {}
        for mm in (factor * source for factor in (0.25, 0.5, 2.0, 4.0)):
            psf = mask_psf(self.mask, dataclasses.replace(coarse, source_mm=mm))
            by_distance[f"{mm:g}"] = round(likeness(psf, reference), 4)
        by_angle: dict[str, float] = {}
        for angle in ANGLES:
            try:
                psf = mask_psf(self.mask, coarse, angle_degrees=(0.0, angle))
            except ParameterError:
                break  # the mask's pitch cannot sample light this steep
            by_angle[f"{angle:g}"] = round(likeness(psf, reference), 4)
        return {"source_mm": by_distance, "angle_degrees": by_angle}

    def write(self, out: Path, *, sensitive: bool = False) -> None:
        """Write mask.tif, psf.tif, camera.json and preview.png, replacing files of the same names together.

        Args:
            out: a folder; created if missing.
            sensitive: also compute `sensitivity`, for camera.json.

        Raises:
            ImageError: a file cannot be written.
        """
        report = self.report() | ({"likeness": self.sensitivity()} if sensitive else {})
        with as_image_error(out):
            out.mkdir(parents=True, exist_ok=True)
            folder = TemporaryDirectory(prefix=".design-", dir=out)
        with folder as hidden:
            draft = Path(hidden)
            write_mask(draft / "mask.tif", self.mask)
            write_linear(draft / "psf.tif", self.stored)
            write_picture(draft / "preview.png", contact_sheet([self.pictures()], ["mask (middle)", "PSF", "spectrum"]))
            write_json(draft / "camera.json", report)
            with as_image_error(out):
                for name in WRITTEN:
                    check_regular(out / name)
                for name in WRITTEN:
                    (draft / name).replace(out / name)

    def pictures(self) -> list[Tensor]:
        """The middle of the mask, the PSF and its spectrum, for `contact_sheet`."""
        values = self.mask.middle((480, 480)).values[None, None]
        return [thumbnail(values / values.max().clamp(min=1e-12)), self.psf, modulus_image(self.psf)]


def design_camera(name: str, design: MaskDesign, setup: Setup) -> Designed:
    """Compute a mask and its PSF.

    Args:
        name: of the mask, such as ``contour``; recorded in ``camera.json``.
        design: parameters of this kind of mask.
        setup: the camera: distances, pitch, wavelengths, size of the sensor.

    Raises:
        ParameterError: a parameter is invalid for this mask or camera, or no light passes the mask.
    """
    mask = design.build(setup)
    if not isinstance(mask, Mask):
        raise ParameterError(f"`build` of the mask '{name}' must return a `mwdn.optics.Mask`, not {shown(mask)}.")
    light = mask_psf(mask, setup)
    if not bool(light.any()):
        height, width = setup.aperture_mm
        raise ParameterError(
            f"No light passes the mask within the aperture ({height:g} x {width:g} mm): give an open mask, or another "
            "`aperture_mm`."
        )
    return Designed(name, design, setup, mask, light)


def check_replaced(out: Path, *, gds: bool = False, stl: bool = False) -> None:
    """Refuse a folder in which a design would replace files that no design wrote, such as a measured PSF.

    Args:
        out: the folder.
        gds: mask.gds will be written, too.
        stl: mask.stl will be written, too.

    Raises:
        ParameterError: it holds such files.
    """
    try:
        if read_json(out / "camera.json")["made"]["psf_hash"]:
            return
    except (ParameterError, LookupError, TypeError):  # missing, or not written by `Designed.write`
        pass
    names = [*WRITTEN[:-1], *["mask.gds"] * gds, *["mask.stl"] * stl, WRITTEN[-1]]
    for path in (out / name for name in names):
        if path.exists():
            raise ParameterError(
                f"`{path}` would be replaced, and no camera.json beside it says that it belongs to a design. Choose "
                "another folder: `out`."
            )


def _plain(parameters: dict[str, Any]) -> dict[str, Any]:
    """Replace what JSON does not have: infinity by None, a path by its text."""
    known = {name: None if value == math.inf else value for name, value in parameters.items()}
    return {name: str(value) if isinstance(value, Path) else value for name, value in known.items()}

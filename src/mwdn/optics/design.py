"""A designed camera in files: mask, PSF, numbers and a picture."""

import dataclasses
import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from mwdn.errors import ParameterError
from mwdn.fourier.convolution import correlate
from mwdn.fourier.transforms import frequencies, spectrum
from mwdn.io.contact_sheets import contact_sheet, thumbnail
from mwdn.io.files import write_json
from mwdn.io.images import write_linear, write_picture
from mwdn.optics.mask_files import write_gds, write_mask, write_stl
from mwdn.optics.masks import Mask, MaskDesign, mask_psf, numbers
from mwdn.optics.psf import psf_hash
from mwdn.optics.psf_measures import likeness, ring_means
from mwdn.optics.setup import Setup
from mwdn.types import Image, Psf

ANGLES = (1.0, 2.0, 5.0, 10.0)
"""Degrees off the axis at which `Designed.sensitivity` looks."""


@dataclass(frozen=True, eq=False)
class Designed:
    """A camera that can be built, or simulated: ``Camera(designed.psf)``.

    Args:
        name: of the kind of mask.
        design: the numbers that it was made from.
        setup: everything but the mask.
        mask: what was made.
        light: PSF in parts of the light that falls onto the aperture, see `mwdn.optics.mask_psf`.
    """

    name: str
    design: MaskDesign
    setup: Setup
    mask: Mask
    light: Psf

    @property
    def psf(self) -> Psf:
        """The PSF with the sum 1 in each channel."""
        return _unit(self.light)

    @property
    def stored(self) -> Psf:
        """The same with the maximum 1, as in psf.tif."""
        return self.psf / self.psf.max()

    def report(self) -> dict[str, Any]:
        """All numbers, as plain values that JSON can hold; None is infinite: a source's distance, a focal length."""
        rows, columns = self.setup.size
        pitch_mm = self.setup.pitch_um / 1e3
        width = sharpness(self.psf)
        return {
            "mask": {"name": self.name} | _plain(dataclasses.asdict(self.design)),  # type: ignore[call-overload]
            "setup": _plain(dataclasses.asdict(self.setup)),
            "made": numbers(self.mask, self.light)
            | {
                "psf_size": [rows, columns],
                "psf_pitch_um": self.setup.pitch_um,
                "psf_hash": psf_hash(_unit(self.stored)),
                "autocorrelation_width_px": round(width, 3),
                "resolution_mrad": round(1e3 * width * pitch_mm / self.setup.distance_mm, 3),
                "field_degrees": [
                    round(2 * math.degrees(math.atan(n / 2 * pitch_mm / self.setup.distance_mm)), 2)
                    for n in (rows, columns)
                ],
            },
        }

    def sensitivity(self) -> dict[str, dict[str, float]]:
        """Likeness of the PSF with that of a point nearer, farther, or off the axis; 1 where it is the same.

        See `mwdn.optics.psf_measures.likeness`. Three wavelengths stand for the band. Angles stop where the mask's
        pitch cannot sample the light any more.
        """
        quick = dataclasses.replace(self.setup, wavelengths=min(3, self.setup.wavelengths))
        known = mask_psf(self.mask, quick)
        # Beyond a thousand times the distance of mask and sensor, nothing changes any more.
        source = min(self.setup.source_mm, 1e3 * self.setup.distance_mm)
        away: dict[str, float] = {}
        for mm in (part * source for part in (0.25, 0.5, 2.0, 4.0)):
            psf = mask_psf(self.mask, dataclasses.replace(quick, source_mm=mm))
            away[f"{mm:g}"] = round(likeness(psf, known), 4)
        aside: dict[str, float] = {}
        for angle in ANGLES:
            try:
                psf = mask_psf(self.mask, quick, angle_degrees=(0.0, angle))
            except ParameterError:
                break  # steeper light than the mask's pitch can sample
            aside[f"{angle:g}"] = round(likeness(psf, known), 4)
        return {"source_mm": away, "angle_degrees": aside}

    def write(self, out: Path, *, sensitive: bool = False) -> None:
        """Write mask.tif, psf.tif, camera.json and preview.png; files of the same names are replaced.

        Args:
            out: a folder; created if missing.
            sensitive: camera.json holds `sensitivity` too.

        Raises:
            ImageError: a file cannot be written.
        """
        report = self.report() | ({"likeness": self.sensitivity()} if sensitive else {})
        write_mask(out / "mask.tif", self.mask)
        write_linear(out / "psf.tif", self.stored)
        write_picture(out / "preview.png", contact_sheet([self.pictures()], ["mask (middle)", "PSF", "spectrum"]))
        write_json(out / "camera.json", report)

    def pictures(self) -> list[Tensor]:
        """Middle of the mask, PSF and its spectrum, for `contact_sheet`."""
        values = self.mask.middle((480, 480)).values[None, None]
        return [thumbnail(values / values.max().clamp(min=1e-12)), self.psf, decades(self.psf)]


def design_camera(name: str, design: MaskDesign, setup: Setup) -> Designed:
    """Compute mask and PSF.

    Raises:
        ParameterError: a number that no such mask or camera can have.
    """
    mask = design.build(setup)
    return Designed(name, design, setup, mask, mask_psf(mask, setup))


def check_replaced(out: Path, *, gds: bool = False, stl: bool = False) -> None:
    """Check that a design written into a folder would replace nothing but another design, no measured PSF above all.

    Args:
        out: the folder.
        gds: mask.gds is written, too.
        stl: mask.stl is written, too.

    Raises:
        ParameterError: it would.
    """
    try:
        if json.loads((out / "camera.json").read_bytes())["made"]["psf_hash"]:
            return
    except (OSError, ValueError, LookupError, TypeError):  # none of ours
        pass
    names = ["mask.tif", "psf.tif", "preview.png", *["mask.gds"] * gds, *["mask.stl"] * stl, "camera.json"]
    for path in (out / name for name in names):
        if path.exists():
            raise ParameterError(
                f"`{path}` would be replaced, and no camera.json says that it is a design's. Choose another folder: "
                "`--out`."
            )


def write_fabrication(designed: Designed, out: Path, *, gds: bool, stl: bool, stl_every: int = 1) -> None:
    """Write mask.gds and mask.stl, those that are asked for, into a folder."""
    if gds:
        write_gds(out / "mask.gds", designed.mask)
    if stl:
        write_stl(out / "mask.stl", designed.mask, every=stl_every)


def sharpness(psf: Psf) -> float:
    """Full width at half maximum, in pixels, of the PSF's autocorrelation, averaged over directions and channels.

    It is what a point becomes when the measurement is correlated with the PSF: about 1.4 times as wide as the PSF's
    finest structure.
    """
    profile = radial_autocorrelation(psf)
    below = int((profile < 0.5).nonzero()[0]) if (profile < 0.5).any() else len(profile) - 1
    step = (profile[below - 1] - 0.5) / (profile[below - 1] - profile[below]).clamp(min=1e-12)
    return 2 * (below - 1 + step.item())


def radial_autocorrelation(psf: Psf, reach: int = 40) -> Tensor:
    """Autocorrelation of the PSF less its mean at 0, 1, 2 ... pixels, over all directions and channels; 1 at 0."""
    centred = psf - psf.mean((-2, -1), keepdim=True)
    channels = centred.transpose(0, 1)
    both = torch.cat([correlate(one[None], one[None]) for one in channels]).sum((0, 1))
    rows, columns = (torch.arange(n) - n // 2 for n in both.shape)
    distance = torch.hypot(rows[:, None].double(), columns.double())
    means = ring_means(both, distance, min(reach, min(both.shape) // 2))
    return means / means[0]


def radial_spectrum(psf: Psf, bins: int = 60) -> Tensor:
    """Modulus of the transfer function, root mean square over directions and channels; up to half a period a pixel."""
    size = (psf.shape[-2], psf.shape[-1])
    power = spectrum(psf, size).abs().square().mean((0, 1))
    v, u = frequencies(size[0]), frequencies(size[1])[: size[1] // 2 + 1].abs()
    means = ring_means(power, torch.hypot(v[:, None], u) * 2 * bins, bins)
    return (means / means[0] * power[0, 0]).sqrt()


def decades(psf: Psf, lowest: float = 3.0) -> Image:
    """Modulus of the transfer function as a picture, origin in the middle; white is 1, black 10^-lowest."""
    size = (psf.shape[-2], psf.shape[-1])
    half = spectrum(psf.mean(1, keepdim=True), size).abs()
    # A real picture's spectrum is the same at opposite points: the missing half is the other, turned.
    rest = half[..., 1 : size[1] - size[1] // 2].flip(-1)
    rest = torch.cat([rest[..., :1, :], rest[..., 1:, :].flip(-2)], dim=-2)
    whole = torch.cat([half, rest], dim=-1).roll((size[0] // 2, (size[1] - 1) // 2), dims=(-2, -1))
    return (1 + (whole / whole.amax()).clamp(min=10**-lowest).log10() / lowest) ** 2.2


def _plain(numbers: dict[str, Any]) -> dict[str, Any]:
    """JSON has no infinity."""
    return {name: None if value == math.inf else value for name, value in numbers.items()}


def _unit(psf: Psf) -> Psf:
    return psf / psf.sum((-2, -1), keepdim=True)

"""Masks that deflect light: contour phase mask, diffuser, lenslets."""

import math
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from mwdn.arguments import checked
from mwdn.errors import ParameterError
from mwdn.optics.drawing import contours
from mwdn.optics.masks import Mask, check_index, check_levels, quantise, sample_counts
from mwdn.optics.phase_retrieval import retrieve_phase
from mwdn.optics.propagation import UM_PER_MM, UM_PER_NM, check_positive, coordinates, point_source
from mwdn.optics.setup import Setup
from mwdn.types import Size


@checked
@dataclass(frozen=True)
class Contour:
    """A surface in a few levels that concentrates light onto thin contour lines. The defaults are the paper's mask.

    Args:
        size_mm: height and width of the mask.
        pitch_um: side of a square of constant height.
        index: refractive index; 1.46 is fused silica.
        levels: number of levels; 2, 4, 8 ... take 1, 2, 3 ... etchings.
        step_nm: height of a level. All levels together delay light of wavelength ``levels step_nm (index - 1)`` by one
            wave: 8 x 145 nm x 0.46 = 534 nm. Other colours focus at other distances, and less sharply.
        line_um: full width of a line at half its maximum, in the target.
        spacing_um: usual distance from one line to the next.
        irregularity: spread of these distances, as a part of ``spacing_um``.
        iterations: iterations of the phase retrieval.
        seed: seed of the pattern.

    References:
        V. Boominathan et al., PhlatCam, IEEE TPAMI 42, 1618 (2020).
    """

    size_mm: tuple[float, float] = (7.0, 7.0)
    pitch_um: float = 2.0
    index: float = 1.46
    levels: int = 8
    step_nm: float = 145.0
    line_um: float = 8.0
    spacing_um: float = 104.0
    irregularity: float = 0.15
    iterations: int = 20
    seed: int = 0

    @property
    def design_nm(self) -> float:
        """Wavelength that all levels together delay by one wave."""
        return self.levels * self.step_nm * (self.index - 1)

    def build(self, setup: Setup) -> Mask:
        """Compute the mask for a camera.

        Raises:
            ParameterError: a number is out of its range, `design_nm` is outside the light's band, or the pitch is too
                coarse to deflect light from between two lines onto one.
        """
        size = sample_counts(self.size_mm, self.pitch_um)
        self._check(setup)
        target = contours(
            size,
            line=self.line_um / self.pitch_um,
            spacing=self.spacing_um / self.pitch_um,
            irregularity=self.irregularity,
            generator=torch.Generator().manual_seed(self.seed),
        )
        light: dict[str, Any] = {"pitch_um": self.pitch_um, "wavelength_nm": self.design_nm}
        source = point_source(size, distance_mm=setup.source_mm, **light)
        phase = retrieve_phase(target, source, distance_mm=setup.distance_mm, iterations=self.iterations, **light)
        level = (phase * (self.levels / (2 * math.pi))).round().remainder(self.levels)
        step_um = self.step_nm * UM_PER_NM
        return Mask("phase", level * step_um, self.pitch_um, self.index, step_um)

    def _check(self, setup: Setup) -> None:
        """Check the parameters against the limits of the mask and of the camera's light."""
        check_levels(self.levels)
        check_index(self.index)
        check_positive(step_nm=self.step_nm, line_um=self.line_um, spacing_um=self.spacing_um)
        shortest, longest = setup.band_nm
        if not 0.8 * shortest <= self.design_nm <= 1.25 * longest:
            step = (shortest + longest) / 2 / self.levels / (self.index - 1)
            raise ParameterError(
                f"`levels` ({self.levels}) x `step_nm` ({self.step_nm:g}) x (`index` - 1) ({self.index - 1:.3g}) = "
                f"{self.design_nm:.4g} nm must be in the light's band {setup.band_nm}: try `step_nm` {step:.0f}."
            )
        # Light from halfway between two lines is deflected by asin(sine); a pitch p deflects up to wavelength / (2 p).
        sine = self.spacing_um / 2 / math.hypot(self.spacing_um / 2, setup.distance_mm * UM_PER_MM)
        needed = self.design_nm * UM_PER_NM / (2 * sine)
        if self.pitch_um > needed:
            raise ParameterError(
                f"`pitch_um` ({self.pitch_um:g}) cannot deflect light by {math.degrees(math.asin(sine)):.2g} degrees, "
                f"from between two lines onto one: use at most {needed:.3g} um, or a smaller `spacing_um`."
            )


@checked
@dataclass(frozen=True)
class Diffuser:
    """A smooth random surface whose hills focus light into a net of caustics.

    Args:
        size_mm: height and width of the mask.
        pitch_um: sample spacing of the mask.
        index: refractive index.
        feature_um: distance at which the correlation of the heights falls to 1/e.
        deflection_degrees: deflection of light along one axis, root mean square. The caustics are sharpest about
            ``feature / (2.4 deflection)`` behind the surface.
        levels: number of heights of the printer; continuous unless given.
        seed: seed of the surface.

    References:
        N. Antipa et al., DiffuserCam, Optica 5, 1 (2018).
    """

    size_mm: tuple[float, float] = (3.2, 3.2)
    pitch_um: float = 2.0
    index: float = 1.5
    feature_um: float = 100.0
    deflection_degrees: float = 1.0
    levels: int | None = None
    seed: int = 0

    def build(self, setup: Setup) -> Mask:
        """Compute the mask; it does not depend on the camera.

        Raises:
            ParameterError: a number is out of its range, or `feature_um` is below four samples.
        """
        size = sample_counts(self.size_mm, self.pitch_um)
        check_index(self.index)
        check_positive(feature_um=self.feature_um, deflection_degrees=self.deflection_degrees)
        if not self.deflection_degrees < 90:
            raise ParameterError(f"`deflection_degrees` ({self.deflection_degrees:g}) must be below 90.")
        _check_feature("feature_um", self.feature_um, self.pitch_um, self.size_mm)
        field = _hills(size, self.feature_um / self.pitch_um, torch.Generator().manual_seed(self.seed))
        slope = torch.stack([field.diff(dim=axis).square().mean() for axis in (0, 1)]).mean().sqrt().item()
        # A thin prism deflects light by about (index - 1) times its slope.
        target = math.tan(math.radians(self.deflection_degrees)) / (self.index - 1) * self.pitch_um
        height, step = quantise((field - field.min()) * (target / slope), self.levels)
        return Mask("phase", height, self.pitch_um, self.index, step)


@checked
@dataclass(frozen=True)
class Lenslets:
    """Small lenses at random places: each focuses a point of the scene, and the PSF is a cloud of dots.

    Args:
        size_mm: height and width of the mask.
        pitch_um: sample spacing of the mask.
        index: refractive index.
        spacing_um: usual distance between lenses.
        irregularity: largest displacement of a lens from its place on a square lattice, as a part of ``spacing_um``;
            with 0 the PSF is periodic and the reconstruction has ghosts.
        focal_mm: focal length; unless given, the one that images a point at ``source_mm`` sharply onto the sensor.
        levels: number of heights of the printer; continuous unless given.
        seed: seed of the places.

    References:
        G. Kuo et al., On-chip fluorescence microscopy with a random microlens diffuser, Opt. Express 28, 8384 (2020).
    """

    size_mm: tuple[float, float] = (3.2, 3.2)
    pitch_um: float = 2.0
    index: float = 1.5
    spacing_um: float = 160.0
    irregularity: float = 0.3
    focal_mm: float | None = None
    levels: int | None = None
    seed: int = 0

    def build(self, setup: Setup) -> Mask:
        """Compute the mask for a camera.

        Raises:
            ParameterError: a number is out of its range, or `spacing_um` is below four samples.
        """
        size = sample_counts(self.size_mm, self.pitch_um)
        # 1 / f = 1 / sensor distance + 1 / source distance
        focal = 1 / (1 / setup.distance_mm + 1 / setup.source_mm) if self.focal_mm is None else self.focal_mm
        check_index(self.index)
        check_positive(focal_mm=focal)
        _check_feature("spacing_um", self.spacing_um, self.pitch_um, self.size_mm)
        if not 0 <= self.irregularity <= 0.5:
            raise ParameterError(f"`irregularity` ({self.irregularity:g}) must be in [0, 0.5], a part of `spacing_um`.")
        squared = _squared_distance_to_lens(self, size)
        # A thin lens of focal length f is the paraboloid -r^2 / (2 f (index - 1)).
        surface = -squared / (2 * focal * UM_PER_MM * (self.index - 1))
        height, step = quantise((surface - surface.min()).float(), self.levels)
        return Mask("phase", height, self.pitch_um, self.index, step)


def _check_feature(name: str, um: float, pitch_um: float, size_mm: tuple[float, float]) -> None:
    if not 4 * pitch_um <= um <= min(size_mm) * UM_PER_MM:
        raise ParameterError(
            f"`{name}` ({um:g}) must be at least 4 samples ({4 * pitch_um:g} um) and at most the "
            f"mask's smaller side ({min(size_mm) * UM_PER_MM:g} um)."
        )


def _hills(size: Size, feature: float, generator: torch.Generator) -> Tensor:
    """Sum of Gaussian hills of random height on a lattice; the correlation falls to 1/e at ``feature`` samples.

    A hill exp(-r^2 / (2 w^2)) has the autocorrelation exp(-r^2 / (4 w^2)), which is 1/e at r = 2 w = feature.
    """
    width = feature / 2  # also the lattice spacing: the variance of the sum is then uniform to 1e-4
    factors = []
    for length in size:
        places = torch.arange(-4, math.ceil(length / width) + 5, dtype=torch.float64) * width
        factors.append(torch.exp(-0.5 * ((torch.arange(length)[:, None] - places) / width).square()).float())
    heights = torch.randn(factors[0].shape[1], factors[1].shape[1], generator=generator)
    return factors[0] @ heights @ factors[1].T


def _squared_distance_to_lens(design: Lenslets, size: Size) -> Tensor:
    """Squared distance in um^2 of each sample from the centre of the nearest lens, float64."""
    generator = torch.Generator().manual_seed(design.seed)
    y, x = coordinates(size[0], design.pitch_um), coordinates(size[1], design.pitch_um)
    counts = [math.ceil(side * UM_PER_MM / design.spacing_um) + 3 for side in design.size_mm]
    rows, columns = (coordinates(count, design.spacing_um) for count in counts)
    shift = (torch.rand(2, *counts, generator=generator, dtype=torch.float64) * 2 - 1) * design.irregularity
    nearest = torch.full(size, math.inf, dtype=torch.float64)
    reach = 2.5 * design.spacing_um  # the nearest lens is never farther, however the lenses are displaced
    for i in range(counts[0]):
        for j in range(counts[1]):
            place = rows[i] + shift[0, i, j] * design.spacing_um, columns[j] + shift[1, i, j] * design.spacing_um
            (top, bottom), (left, right) = (
                torch.searchsorted(axis, torch.stack([middle - reach, middle + reach])).tolist()
                for axis, middle in zip((y, x), place, strict=True)
            )
            squared = (y[top:bottom, None] - place[0]).square() + (x[left:right] - place[1]).square()
            part = nearest[top:bottom, left:right]
            torch.minimum(part, squared, out=part)
    return nearest

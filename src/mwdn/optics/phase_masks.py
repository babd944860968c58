"""Masks that bend light: contour phase mask, diffuser, lenslets."""

import math
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from mwdn.errors import ParameterError
from mwdn.optics.drawing import contours
from mwdn.optics.masks import Mask, check_levels, quantised, samples
from mwdn.optics.phase_retrieval import retrieve_phase
from mwdn.optics.propagation import UM_PER_MM, UM_PER_NM, coordinates, point_source, positive
from mwdn.optics.setup import Setup
from mwdn.types import Size


@dataclass(frozen=True)
class Contour:
    """A surface of a few levels that concentrates light onto thin contour lines. The defaults are the paper's mask.

    Args:
        size_mm: height and width.
        pitch_um: side of the squares that have one level each.
        index: refractive index; 1.46 is fused silica.
        levels: of the surface; 2, 4, 8 ... are made by 1, 2, 3 ... etchings.
        step_nm: height of a level. All levels together delay light of ``levels step_nm (index - 1)`` by one wave:
            8 x 145 nm x 0.46 = 534 nm. Light of other colours focuses at another distance, and less of it.
        line_um: full width of a line at half its height, as aimed at.
        spacing_um: usual distance from one line to the next.
        irregularity: spread of these distances, as a part of ``spacing_um``.
        iterations: of the phase retrieval.
        seed: of the pattern.

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
        """Wavelength for which the levels are even parts of one wave."""
        return self.levels * self.step_nm * (self.index - 1)

    def build(self, setup: Setup) -> Mask:
        """Compute the mask for a camera.

        Raises:
            ParameterError: a number is out of its range, the light's band does not hold `design_nm`, or the pitch is
                too coarse to turn light from between two lines onto one.
        """
        size = samples(self.size_mm, self.pitch_um)
        check_levels(self.levels)
        positive(step_nm=self.step_nm, line_um=self.line_um, spacing_um=self.spacing_um, index=self.index - 1)
        shortest, longest = setup.band_nm
        if not 0.8 * shortest <= self.design_nm <= 1.25 * longest:
            step = (shortest + longest) / 2 / self.levels / (self.index - 1)
            raise ParameterError(
                f"`levels` ({self.levels}) x `step_nm` ({self.step_nm:g}) x (`index` - 1) ({self.index - 1:.3g}) = "
                f"{self.design_nm:.4g} nm must be in the light's band {setup.band_nm}: try `step_nm` {step:.0f}."
            )
        reach = self.spacing_um / 2 / math.hypot(self.spacing_um / 2, setup.distance_mm * UM_PER_MM)
        needed = self.design_nm * UM_PER_NM / (2 * reach)
        if self.pitch_um > needed:
            raise ParameterError(
                f"`pitch_um` ({self.pitch_um:g}) cannot turn light by the {math.degrees(math.asin(reach)):.2g} degrees "
                f"from between two lines onto one: use at most {needed:.3g} um, or a smaller `spacing_um`."
            )
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


@dataclass(frozen=True)
class Diffuser:
    """A smooth random surface: its hills focus light into a net of caustics.

    Args:
        size_mm: height and width.
        pitch_um: distance of the samples.
        index: refractive index.
        feature_um: distance at which the correlation of the heights has fallen to 1/e.
        deflection_degrees: by which the surface turns light along one axis, root mean square. The caustics are
            sharpest about ``feature / (2.4 deflection)`` behind it.
        levels: heights that a printer has; any height unless given.
        seed: of the surface.

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
            ParameterError: a number is out of its range, or the features are finer than four samples.
        """
        size = samples(self.size_mm, self.pitch_um)
        positive(feature_um=self.feature_um, deflection_degrees=self.deflection_degrees, index=self.index - 1)
        _fits("feature_um", self.feature_um, self.pitch_um, self.size_mm)
        field = _hills(size, self.feature_um / self.pitch_um, torch.Generator().manual_seed(self.seed))
        slope = torch.stack([field.diff(dim=axis).square().mean() for axis in (0, 1)]).mean().sqrt().item()
        wanted = math.tan(math.radians(self.deflection_degrees)) / (self.index - 1) * self.pitch_um
        height, step = quantised((field - field.min()) * (wanted / slope), self.levels)
        return Mask("phase", height, self.pitch_um, self.index, step)


@dataclass(frozen=True)
class Lenslets:
    """Small lenses at random places: each focuses a point of the scene, so the PSF is a cloud of dots.

    Args:
        size_mm: height and width.
        pitch_um: distance of the samples.
        index: refractive index.
        spacing_um: usual distance of the lenses.
        irregularity: how far a lens is from its place on a square lattice at most, as a part of ``spacing_um``; with
            0 the PSF repeats itself and the reconstruction has ghosts.
        focal_mm: of each lens; such that a point at the setup's distance is sharp on its sensor unless given.
        levels: heights that a printer has; any height unless given.
        seed: of the places.

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
            ParameterError: a number is out of its range, or the lenses are finer than four samples.
        """
        size = samples(self.size_mm, self.pitch_um)
        focal = 1 / (1 / setup.distance_mm + 1 / setup.source_mm) if self.focal_mm is None else self.focal_mm
        positive(focal_mm=focal, index=self.index - 1)
        _fits("spacing_um", self.spacing_um, self.pitch_um, self.size_mm)
        if not 0 <= self.irregularity <= 0.5:
            raise ParameterError(f"`irregularity` ({self.irregularity:g}) must be in [0, 0.5].")
        away = _from_nearest_lens(self, size)
        # A paraboloid of this height delays light as a thin lens does; the lowest point is at 0.
        surface = -away / (2 * focal * UM_PER_MM * (self.index - 1))
        height, step = quantised((surface - surface.min()).float(), self.levels)
        return Mask("phase", height, self.pitch_um, self.index, step)


def _fits(name: str, um: float, pitch_um: float, size_mm: tuple[float, float]) -> None:
    if not 4 * pitch_um <= um <= min(size_mm) * UM_PER_MM:
        raise ParameterError(
            f"`{name}` ({um:g}) must be at least 4 samples ({4 * pitch_um:g} um) and at most the mask's smaller side."
        )


def _hills(size: Size, feature: float, generator: torch.Generator) -> Tensor:
    """Gaussian hills of random height on a lattice; their correlation falls to 1/e at ``feature`` samples."""
    width = feature / 2  # of one hill, and of the lattice: the sum is then even to 1e-4
    factors = []
    for length in size:
        places = torch.arange(-4, math.ceil(length / width) + 5, dtype=torch.float64) * width
        factors.append(torch.exp(-0.5 * ((torch.arange(length)[:, None] - places) / width).square()).float())
    heights = torch.randn(factors[0].shape[1], factors[1].shape[1], generator=generator)
    return factors[0] @ heights @ factors[1].T


def _from_nearest_lens(design: Lenslets, size: Size) -> Tensor:
    """Squared distance in um^2 of each sample from the nearest lens's middle, float64."""
    generator = torch.Generator().manual_seed(design.seed)
    y, x = coordinates(size[0], design.pitch_um), coordinates(size[1], design.pitch_um)
    counts = [math.ceil(side * UM_PER_MM / design.spacing_um) + 3 for side in design.size_mm]
    rows, columns = (coordinates(count, design.spacing_um) for count in counts)
    shift = (torch.rand(2, *counts, generator=generator, dtype=torch.float64) * 2 - 1) * design.irregularity
    away = torch.full(size, math.inf, dtype=torch.float64)
    reach = 2.5 * design.spacing_um  # no sample's nearest lens is farther, wherever the neighbours have gone
    for i in range(counts[0]):
        for j in range(counts[1]):
            place = rows[i] + shift[0, i, j] * design.spacing_um, columns[j] + shift[1, i, j] * design.spacing_um
            (top, bottom), (left, right) = (
                torch.searchsorted(axis, torch.stack([middle - reach, middle + reach])).tolist()
                for axis, middle in zip((y, x), place, strict=True)
            )
            squared = (y[top:bottom, None] - place[0]).square() + (x[left:right] - place[1]).square()
            part = away[top:bottom, left:right]
            torch.minimum(part, squared, out=part)
    return away

"""Propagation of light from a point through a mask to the sensor: scalar diffraction on sampled planes.

Names of lengths end in their unit. A plane of n samples is centred at sample ``n // 2``; row 0 is at the top.
"""

import math

import torch
from torch import Tensor

from mwdn.errors import ParameterError
from mwdn.fourier.transforms import fast_length, filter_field, frequencies
from mwdn.types import Field, Plane, Size

UM_PER_MM = 1e3
UM_PER_NM = 1e-3


def check_positive(**numbers: float | int) -> None:
    """Check that lengths and counts, given by name, are positive."""
    for name, value in numbers.items():
        if not value > 0:
            raise ParameterError(f"`{name}` ({value:g}) must be positive.")


def coordinates(count: int, pitch_um: float) -> Tensor:
    """Coordinates of ``count`` samples in um, float64, 0 at sample ``count // 2``."""
    return (torch.arange(count, dtype=torch.float64) - count // 2) * pitch_um


def needed_samples(inside: int, outside: int, *, pitch_um: float, wavelength_nm: float, distance_mm: float) -> int:
    """Samples along one axis of a grid on which no light wraps around onto the output plane.

    The finest grating on the mask, with a period of two samples, deflects light by ``asin(wavelength / (2 pitch))``:
    a displacement e over the distance. Light displaced by more than ``(inside + outside) / 2`` misses the output plane,
    so e is limited to that. The light reaches ``inside / 2 + e``; its periodic copy, one grid to the left, must lie
    left of ``-outside / 2``: ``grid >= (inside + outside) / 2 + e``.

    Args:
        inside: samples of the input plane.
        outside: samples of the output plane.
        pitch_um: sample spacing.
        wavelength_nm: of the light.
        distance_mm: between the planes.
    """
    sine = wavelength_nm * UM_PER_NM / (2 * pitch_um)
    farthest = math.inf if sine >= 1 else distance_mm * UM_PER_MM * sine / math.sqrt(1 - sine**2) / pitch_um
    reach = (inside + outside) / 2
    return math.ceil(reach + min(farthest, reach))


def propagate(
    field: Field,
    *,
    pitch_um: float,
    wavelength_nm: float,
    distance_mm: float,
    size: Size | None = None,
    grid: Size | None = None,
) -> Field:
    """Propagate light to a parallel plane: band-limited angular spectrum.

    Args:
        field: light on the first plane; darkness outside.
        pitch_um: sample spacing, on both planes.
        wavelength_nm: of the light.
        distance_mm: between the planes.
        size: samples of the second plane, centred opposite the first; those of the first unless given.
        grid: samples of the FFT grid; `needed_samples` or a few more unless given.

    Returns:
        The light on the second plane. Light that lands beside it is lost.

    Raises:
        ParameterError: a length is not positive, or the grid is so small that light wraps around onto the plane.

    References:
        K. Matsushima, T. Shimobaba, Band-limited angular spectrum method for numerical simulation of free-space
        propagation in far and near fields, Opt. Express 17, 19662 (2009).
    """
    check_positive(pitch_um=pitch_um, wavelength_nm=wavelength_nm, distance_mm=distance_mm)
    inside = field.shape[0], field.shape[1]
    size = size or inside
    step = {"pitch_um": pitch_um, "wavelength_nm": wavelength_nm, "distance_mm": distance_mm}
    needed = tuple(max(needed_samples(a, b, **step), a, b) for a, b in zip(inside, size, strict=True))
    if grid is None:
        grid = fast_length(needed[0]), fast_length(needed[1])
    elif grid[0] < needed[0] or grid[1] < needed[1]:
        raise ParameterError(
            f"`grid` ({grid[0]} x {grid[1]}) lets light wrap around onto the second plane at a pitch of {pitch_um:g} "
            f"um: use at least {needed[0]} x {needed[1]}."
        )
    wide = filter_field(field, angular_spectrum(grid, **step))
    start = inside[0] // 2 - size[0] // 2, inside[1] // 2 - size[1] // 2
    if min(start) < 0 or start[0] + size[0] > grid[0] or start[1] + size[1] > grid[1]:
        wide = wide.roll((-start[0], -start[1]), dims=(0, 1))
        start = 0, 0
    return wide[start[0] : start[0] + size[0], start[1] : start[1] + size[1]]


def angular_spectrum(grid: Size, *, pitch_um: float, wavelength_nm: float, distance_mm: float) -> Field:
    """Transfer function of free space, eq. (8) to (13) of Matsushima and Shimobaba, frequency 0 first.

    ``H(u, v) = exp(2 pi i z sqrt(1 / wavelength^2 - u^2 - v^2))``, 0 where |u| or |v| exceeds the band limit
    ``1 / (wavelength sqrt((2 z / width)^2 + 1))``, with z the distance and the width that of the grid.

    Args:
        grid: samples.
        pitch_um: sample spacing.
        wavelength_nm: of the light.
        distance_mm: negative to propagate backwards; evanescent waves decay either way.
    """
    wavelength, distance = wavelength_nm * UM_PER_NM, distance_mm * UM_PER_MM
    v, u = (frequencies(length) / pitch_um for length in grid)
    # Above the band limit the phase is too steep for the grid; such light leaves the grid before it arrives.
    limits = [1 / (wavelength * math.hypot(2 * distance / (length * pitch_um), 1)) for length in grid]
    # In float64: of a phase of 2 pi 2 mm / 0.5 um = 25,000, float32 keeps only two digits after the point.
    squared = wavelength**-2 - v.square()[:, None] - u.square()
    phase = squared.clamp(min=0).sqrt_().mul_(2 * math.pi * distance)
    fading = squared.neg_().clamp_(min=0).sqrt_().mul_(-2 * math.pi * abs(distance)).exp_()
    fading *= ((v.abs() <= limits[0])[:, None] & (u.abs() <= limits[1])).double()
    return torch.polar(fading.float(), phase.remainder_(2 * math.pi).float())


def point_source(
    size: Size,
    *,
    pitch_um: float,
    wavelength_nm: float,
    distance_mm: float = math.inf,
    angle_degrees: tuple[float, float] = (0.0, 0.0),
) -> Field:
    """Light of a far point on a plane: a spherical or plane wave of modulus 1 in the middle.

    Args:
        size: samples of the plane.
        pitch_um: sample spacing.
        wavelength_nm: of the light.
        distance_mm: from this plane to the parallel one through the point; infinity for a plane wave.
        angle_degrees: from the axis, downwards and to the right.

    Raises:
        ParameterError: a length is not positive, an angle is not within 90 degrees, or the pitch cannot sample the
            light's phase; the message says which pitch can.
    """
    check_positive(pitch_um=pitch_um, wavelength_nm=wavelength_nm, distance_mm=distance_mm)
    if not max(map(abs, angle_degrees)) < 90:
        raise ParameterError(f"`angle_degrees` {angle_degrees} must be within 90 degrees of the axis.")
    wavelength = wavelength_nm * UM_PER_NM
    tangents = [math.tan(math.radians(angle)) for angle in angle_degrees]
    needed = wavelength / (2 * _steepest(size, tangents, pitch_um, distance_mm))
    if pitch_um > needed * (1 + 1e-9):
        raise ParameterError(
            f"`pitch_um` ({pitch_um:g}) cannot sample light of {wavelength_nm:g} nm from {angle_degrees} degrees at "
            f"{distance_mm:g} mm: use at most {needed:.3g} um, a smaller angle or a smaller aperture."
        )
    y, x = coordinates(size[0], pitch_um)[:, None], coordinates(size[1], pitch_um)
    if math.isinf(distance_mm):
        slope = math.sqrt(1 + tangents[0] ** 2 + tangents[1] ** 2)
        path = -(tangents[0] * y + tangents[1] * x) / slope
        modulus = torch.ones_like(path)
    else:
        distance = distance_mm * UM_PER_MM
        far = distance * math.sqrt(1 + tangents[0] ** 2 + tangents[1] ** 2)
        path = ((y - distance * tangents[0]).square() + (x - distance * tangents[1]).square() + distance**2).sqrt()
        modulus, path = far / path, path - far
    return torch.polar(modulus.float(), (2 * math.pi / wavelength * path).remainder(2 * math.pi).float())


def _steepest(size: Size, tangents: list[float], pitch_um: float, distance_mm: float) -> float:
    """Sine of the largest angle of incidence along either axis, over the whole plane; at least 1e-12."""
    sines = [1e-12]
    for length, tangent in zip(size, tangents, strict=True):
        half = length / 2 * pitch_um / (distance_mm * UM_PER_MM)
        sines.append(math.sin(math.atan(abs(tangent) + half)))
    return max(sines)


def integrate(intensity: Plane, *, pitch_um: float, size: Size, pixel_um: float) -> Plane:
    """Sum the light in each pixel of a sensor without gaps between its pixels.

    A sample is a square of the pitch; its light is divided among the pixels by area. So no light is lost inside the
    sensor, whatever the two pitches. Pixels binned by n are pixels n times as large.

    Args:
        intensity: samples on the sensor's plane.
        pitch_um: sample spacing.
        size: rows and columns of pixels; the middle of pixel ``n // 2`` is the middle of the plane.
        pixel_um: distance of the pixels.
    """
    check_positive(pitch_um=pitch_um, pixel_um=pixel_um)
    down, across = (
        overlap(length, pixel_um, samples, pitch_um) for length, samples in zip(size, intensity.shape, strict=True)
    )
    return (down @ intensity.double() @ across.T).float()


def overlap(cells: int, cell_um: float, others: int, other_um: float) -> Tensor:
    """Part of each cell of the other grid that each cell covers, along one axis: (cells, others), float64."""
    a, b = coordinates(cells, cell_um)[:, None], coordinates(others, other_um)
    right = torch.minimum(a + cell_um / 2, b + other_um / 2)
    left = torch.maximum(a - cell_um / 2, b - other_um / 2)
    return (right - left).clamp(min=0) / other_um

"""Light on its way from a point through a mask to the sensor: scalar diffraction on a sampled plane.

Lengths carry their unit in their name. A plane of n samples is centred at sample ``n // 2``, row 0 at the top.
"""

import math

import torch
from torch import Tensor

from mwdn.errors import ParameterError
from mwdn.fourier.transforms import fast_length, filter_field, frequencies
from mwdn.types import Field, Plane, Size

UM_PER_MM = 1e3
UM_PER_NM = 1e-3


def positive(**numbers: float | int) -> None:
    """Refuse lengths and counts that are not positive, by their names."""
    for name, value in numbers.items():
        if not value > 0:
            raise ParameterError(f"`{name}` ({value:g}) must be positive.")


def coordinates(count: int, pitch_um: float) -> Tensor:
    """Places of ``count`` samples in um, float64, 0 at sample ``count // 2``."""
    return (torch.arange(count, dtype=torch.float64) - count // 2) * pitch_um


def needed_samples(inside: int, outside: int, *, pitch_um: float, wavelength_nm: float, distance_mm: float) -> int:
    """Samples along one axis of a grid on which nothing that lands on the output plane has been wrapped around.

    The finest grating that the pitch can carry turns light by ``asin(wavelength / (2 pitch))``. Over the distance
    that is a displacement e, or half of both planes together, whatever is less: light that is displaced farther
    lands beside the output. A displacement of e reaches ``inside / 2 + e``, and one grid to the left of that must
    still lie left of ``-outside / 2``.

    Args:
        inside: samples of the input plane.
        outside: samples of the output plane.
        pitch_um: distance of the samples.
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
        field: light on the first plane, zero outside of it.
        pitch_um: distance of the samples, on both planes.
        wavelength_nm: of the light.
        distance_mm: between the planes.
        size: samples of the second plane, whose centre faces that of the first; those of the first unless given.
        grid: samples of the grid in between; as many as are needed unless given.

    Returns:
        The light on the second plane. What lands beside it is lost.

    Raises:
        ParameterError: a length is not positive, or the grid is so small that light wraps around onto the plane.

    References:
        K. Matsushima, T. Shimobaba, Band-limited angular spectrum method for numerical simulation of free-space
        propagation in far and near fields, Opt. Express 17, 19662 (2009).
    """
    positive(pitch_um=pitch_um, wavelength_nm=wavelength_nm, distance_mm=distance_mm)
    inside = field.shape[0], field.shape[1]
    size = size or inside
    step = {"pitch_um": pitch_um, "wavelength_nm": wavelength_nm, "distance_mm": distance_mm}
    needed = tuple(max(needed_samples(a, b, **step), a, b) for a, b in zip(inside, size, strict=True))
    if grid is None:
        grid = fast_length(needed[0]), fast_length(needed[1])
    elif grid[0] < needed[0] or grid[1] < needed[1]:
        raise ParameterError(
            f"`grid` ({grid[0]} x {grid[1]}) lets light wrap around onto the second plane at a pitch of {pitch_um:g} "
            f"um: pad it to at least {needed[0]} x {needed[1]}."
        )
    wide = filter_field(field, angular_spectrum(grid, **step))
    start = inside[0] // 2 - size[0] // 2, inside[1] // 2 - size[1] // 2
    if min(start) < 0 or start[0] + size[0] > grid[0] or start[1] + size[1] > grid[1]:
        wide = wide.roll((-start[0], -start[1]), dims=(0, 1))
        start = 0, 0
    return wide[start[0] : start[0] + size[0], start[1] : start[1] + size[1]]


def angular_spectrum(grid: Size, *, pitch_um: float, wavelength_nm: float, distance_mm: float) -> Field:
    """Transfer function of free space, eq. (8) to (13) of Matsushima and Shimobaba, origin first.

    Args:
        grid: samples.
        pitch_um: distance of the samples.
        wavelength_nm: of the light.
        distance_mm: to propagate; negative ones lead back, evanescent waves still fading.
    """
    wavelength, distance = wavelength_nm * UM_PER_NM, distance_mm * UM_PER_MM
    v, u = (frequencies(length) / pitch_um for length in grid)
    # Light of a higher frequency leaves the grid before it arrives: its phase is too steep for the grid.
    limits = [1 / (wavelength * math.hypot(2 * distance / (length * pitch_um), 1)) for length in grid]
    # In float64: a phase of 2 pi 2 mm / 0.5 um = 25,000 leaves float32 no more than two digits after the point.
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
    """Light of a far point on a plane, of modulus 1 in its middle.

    Args:
        size: samples of the plane.
        pitch_um: distance of the samples.
        wavelength_nm: of the light.
        distance_mm: from the plane to the point's plane; infinity for a plane wave.
        angle_degrees: from the axis, downwards and to the right.

    Raises:
        ParameterError: a length is not positive, an angle is not within 90 degrees, or the pitch cannot carry the
            light's slope; the message says which could.
    """
    positive(pitch_um=pitch_um, wavelength_nm=wavelength_nm, distance_mm=distance_mm)
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
    """Sine of the largest angle to the axis, along one axis, under which the plane sees the point; not quite 0."""
    sines = [1e-12]
    for length, tangent in zip(size, tangents, strict=True):
        half = length / 2 * pitch_um / (distance_mm * UM_PER_MM)
        sines.append(math.sin(math.atan(abs(tangent) + half)))
    return max(sines)


def integrate(intensity: Plane, *, pitch_um: float, size: Size, pixel_um: float) -> Plane:
    """Light that falls into each pixel of a sensor whose pixels lie without gaps.

    Each sample stands for a square of its pitch, whose light is divided among the pixels by area: no light is lost
    inside the sensor, and any two pitches fit together. Pixels binned by n are pixels n times as large.

    Args:
        intensity: samples on the sensor's plane.
        pitch_um: distance of the samples.
        size: rows and columns of pixels; the middle of pixel ``n // 2`` faces the middle of the plane.
        pixel_um: distance of the pixels.
    """
    positive(pitch_um=pitch_um, pixel_um=pixel_um)
    down, across = (
        overlap(length, pixel_um, samples, pitch_um) for length, samples in zip(size, intensity.shape, strict=True)
    )
    return (down @ intensity.double() @ across.T).float()


def overlap(cells: int, cell_um: float, others: int, other_um: float) -> Tensor:
    """Part of each of the other grid's cells, along one axis, that each cell covers, (cells, others), float64."""
    a, b = coordinates(cells, cell_um)[:, None], coordinates(others, other_um)
    right = torch.minimum(a + cell_um / 2, b + other_um / 2)
    left = torch.maximum(a - cell_um / 2, b - other_um / 2)
    return (right - left).clamp(min=0) / other_um

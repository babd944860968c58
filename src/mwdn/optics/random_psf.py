"""Random plausible PSFs of every kind of mask, drawn fast enough to train a network across cameras.

Light is not propagated: each family draws the pattern on the sensor directly. The imperfections of real cameras (the
edge of the aperture, blur, halo, haze, speckle, differences between colours) are added to all families alike.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, fields

import torch
from torch import Tensor
from torch.nn import functional as F

from mwdn.arguments import checked
from mwdn.errors import ParameterError, UnknownNameError
from mwdn.fourier.transforms import fast_length, gaussian_transfer, inverse_spectrum, spectrum
from mwdn.optics.drawing import contour_lines, scatter_light, smooth_field
from mwdn.optics.psf import unit_sum
from mwdn.types import Psf, Size

Range = tuple[float, float]


@checked
@dataclass(frozen=True)
class Variety:
    """Ranges from which the properties of random cameras are drawn, uniformly for each camera.

    Args:
        support: height (and, drawn separately, width) of the lit area over that of the frame; above 1 it is cut off.
        offset: largest displacement of the lit area's centre, over the frame's height and width.
        turn_degrees: largest rotation of the mask relative to the sensor.
        detail_px: distance between the mask's lines or spots, in pixels of a frame of 320; scaled with the frame's
            shorter side.
        line_px: width of contour lines, in pixels of the frame.
        blur_px: standard deviation of a Gaussian blur.
        halo: fraction of the light in a wide halo around every line.
        glow: fraction of the light that fills the aperture evenly, undeflected by the mask.
        background: fraction of the light that fills the frame evenly.
        speckle: standard deviation of the logarithm of a random smooth brightness.
        colour_scale: largest relative magnification of red and blue over green, of opposite signs.
        colour_blur: largest relative difference of the blur of red and blue from green's, of opposite signs.
        colour_tilt: largest relative change of a colour's brightness from the middle to a side of the frame.
        grey: probability that all colours are alike.

    Raises:
        ParameterError: a number is out of its range, or of another type.
    """

    support: Range = (0.4, 1.15)
    offset: float = 0.05
    turn_degrees: float = 5.0
    detail_px: Range = (10.0, 45.0)
    line_px: Range = (1.0, 2.5)
    blur_px: Range = (0.3, 1.3)
    halo: Range = (0.0, 0.35)
    glow: Range = (0.0, 0.5)
    background: Range = (0.0, 0.1)
    speckle: Range = (0.0, 0.5)
    colour_scale: float = 0.005
    colour_blur: float = 0.3
    colour_tilt: float = 0.3
    grey: float = 0.25

    def __post_init__(self) -> None:
        for part in fields(self):
            value = getattr(self, part.name)
            low, high = value if isinstance(value, tuple | list) else (value, value)
            if not 0 <= low <= high:
                raise ParameterError(f"`{part.name}` ({value}) must not be negative, and a range must rise.")
        for name, low in (("support", self.support[0]), ("detail_px", self.detail_px[0]), ("line_px", self.line_px[0])):
            if not low > 0:
                raise ParameterError(f"`{name}` {getattr(self, name)} must be positive.")
        for name, high in (("halo", self.halo[1]), ("glow", self.glow[1]), ("background", self.background[1])):
            if not high < 1:
                raise ParameterError(f"`{name}` {getattr(self, name)} must be below 1: a fraction of the light.")


@dataclass(frozen=True, eq=False)
class _Draw:
    """Random numbers and fields for one camera."""

    generator: torch.Generator
    variety: Variety
    size: Size
    device: torch.device

    def uniform(self, low: float, high: float) -> float:
        number = torch.rand((), generator=self.generator, device=self.generator.device)
        return low + (high - low) * float(number)

    def range(self, name: str) -> float:
        return self.uniform(*getattr(self.variety, name))

    def spread(self, name: str) -> float:
        """A number of either sign, up to the limit of that name."""
        limit = getattr(self.variety, name)
        return self.uniform(-limit, limit)

    def signs(self, count: int) -> Tensor:
        bits = torch.randint(0, 2, (count,), generator=self.generator, device=self.generator.device)
        return (2.0 * bits - 1).to(self.device)

    def normal(self, *shape: int) -> Tensor:
        return torch.randn(shape, generator=self.generator, device=self.generator.device).to(self.device)

    def detail(self) -> float:
        """Distance between lines or spots in pixels; at least 4, below which they could not be resolved."""
        return max(self.range("detail_px") * min(self.size) / 320, 4.0)

    def field(self, period: float, bandwidth: float = 1.0) -> Tensor:
        return smooth_field(self.size, period, bandwidth=bandwidth, generator=self.generator, device=self.device)


@dataclass(frozen=True, eq=False)
class _Aperture:
    """The lit area: ``light`` (H, W) in [0, 1]; ``y``, ``x`` in pixels from its centre; half its sides."""

    light: Tensor
    y: Tensor
    x: Tensor
    half: tuple[float, float]


def _aperture(draw: _Draw) -> _Aperture:
    """A rotated rectangle or ellipse with a soft edge."""
    height, width = draw.size
    half = draw.range("support") * height / 2, draw.range("support") * width / 2
    turn = math.radians(draw.spread("turn_degrees"))
    down, along = draw.spread("offset") * height, draw.spread("offset") * width
    v = torch.arange(height, device=draw.device)[:, None] - (height // 2 + down)
    u = torch.arange(width, device=draw.device)[None] - (width // 2 + along)
    y, x = math.cos(turn) * v - math.sin(turn) * u, math.sin(turn) * v + math.cos(turn) * u
    soft = draw.uniform(0.5, 0.03 * min(draw.size) + 0.5)
    # A superellipse: power 2 is an ellipse, 16 a rectangle with rounded corners.
    power = 2.0 if draw.uniform(0.0, 1.0) < 0.2 else draw.uniform(8.0, 24.0)
    radius = ((y.abs() / half[0]) ** power + (x.abs() / half[1]) ** power) ** (1 / power)
    light = torch.sigmoid((1 - radius) * min(half) / soft * 2)
    return _Aperture(light, y, x, half)


def _contours(draw: _Draw, aperture: _Aperture) -> Tensor:
    """Contour phase mask (PhlatCam): sharp lines at even distances that rarely meet."""
    spacing = draw.detail()
    field = draw.field(2 * spacing, draw.uniform(0.03, 0.5))
    # Three tenths of the steepest slopes, pi / spacing: flatter places would become wide blots.
    return contour_lines(field, draw.range("line_px"), 0.3 * math.pi / spacing) * aperture.light


def _caustics(draw: _Draw, aperture: _Aperture) -> Tensor:
    """Smooth random diffuser (DiffuserCam): rays deflected by the slope of the surface meet in a net of caustics."""
    height, width = draw.size
    surface = draw.field(3 * draw.detail(), draw.uniform(0.3, 0.8))
    slope = torch.stack(torch.gradient(surface, dim=(0, 1)))
    curvature = torch.stack(torch.gradient(slope[0], dim=(0, 1))).square().mean().sqrt()
    # Deflection = bend * slope. From bend * curvature = 0.3 on, the strongest bumps focus and lines form; at 1 they
    # begin to cross.
    bend = draw.uniform(0.3, 1.1) / curvature.clamp(min=1e-12)
    # Four rays a pixel, so that stretched areas stay smooth.
    rays = F.interpolate(
        torch.cat([slope * bend, aperture.light[None]])[None], scale_factor=2, mode="bilinear", align_corners=False
    )[0]
    rows = (torch.arange(2 * height, device=draw.device)[:, None] - 0.5) / 2 + rays[0]
    columns = (torch.arange(2 * width, device=draw.device) - 0.5) / 2 + rays[1]
    return scatter_light(rows.flatten(), columns.flatten(), rays[2].flatten(), draw.size)


def _dots(draw: _Draw, aperture: _Aperture) -> Tensor:
    """Pinholes or lenslets: separate spots, irregular and unevenly bright."""
    height, width = draw.size
    distance = draw.detail()
    rows, columns = (torch.arange(0, n, distance, device=draw.device) for n in draw.size)
    places = torch.cartesian_prod(rows, columns)
    places = places + draw.uniform(0.2, 0.6) * distance * draw.normal(*places.shape)
    y, x = places[:, 0].clamp(0, height - 1), places[:, 1].clamp(0, width - 1)
    power = aperture.light[y.round().long(), x.round().long()] * torch.exp(0.4 * draw.normal(len(places)))
    return scatter_light(y, x, power, draw.size) + 1e-9 * aperture.light


def _zone_plate(draw: _Draw, aperture: _Aperture) -> Tensor:
    """Fresnel zone aperture: rings whose distance falls outwards to 2.5 to 10 pixels at the edge."""
    edge = draw.uniform(0.1, 0.4)
    rings = torch.cos(math.pi * (aperture.y.square() + aperture.x.square()) * edge / max(aperture.half))
    hardness = draw.uniform(1.0, 6.0)
    return (0.5 + 0.5 * hardness * rings).clamp(0, 1) * aperture.light


def _separable(draw: _Draw, aperture: _Aperture) -> Tensor:
    """Coded aperture of two random sequences (FlatCam): half of its squares are open."""
    element = max(draw.detail() / 4, 1.5)

    def along(axis: Tensor, half: float) -> Tensor:
        count = 2 * math.ceil(1.5 * half / element) + 2
        return draw.signs(count)[((axis / element).floor().long() + count // 2).clamp(0, count - 1)]

    return (0.5 + 0.5 * along(aperture.y, aperture.half[0]) * along(aperture.x, aperture.half[1])) * aperture.light


FAMILIES: dict[str, Callable[[_Draw, _Aperture], Tensor]] = {
    "contours": _contours,
    "caustics": _caustics,
    "dots": _dots,
    "zone-plate": _zone_plate,
    "separable": _separable,
}
"""Families of masks for `sample_camera`."""


@checked
def sample_camera(
    generator: torch.Generator | int,
    size: Size,
    *,
    family: str | None = None,
    variety: Variety | None = None,
    device: torch.device | str | None = None,
) -> Psf:
    """Draw the PSF of a random camera.

    Args:
        generator: source of randomness, or its seed. A generator on the CPU also serves a ``device`` that is a GPU;
            the PSF is then the CPU's up to rounding.
        size: height and width in pixels.
        family: one of `FAMILIES`; drawn unless given.
        variety: ranges of the cameras' properties.
        device: where to compute; the generator's unless given.

    Returns:
        (1, 3, *size), float32, not negative, each channel of unit sum; the middle of the lit area is near
        ``(H // 2, W // 2)``.

    Raises:
        UnknownNameError: unknown family.
        ParameterError: a size below 8, or an argument of another type.

    References:
        V. Boominathan et al., IEEE TPAMI 42, 1618 (2020) for contours; N. Antipa et al., Optica 5, 1 (2018) for
        caustics; T. Shimano et al., Appl. Opt. 57, 2841 (2018) for zone plates; M. S. Asif et al., IEEE Trans.
        Comput. Imaging 3, 384 (2017) for separable masks.
    """
    if min(size) < 8:
        raise ParameterError(f"`size` {size} must be at least 8 x 8 pixels.")
    if family is not None and family not in FAMILIES:
        raise UnknownNameError("family", family, FAMILIES)
    if not isinstance(generator, torch.Generator):
        generator = torch.Generator().manual_seed(int(generator))  # numpy's numbers, too
    draw = _Draw(generator, variety or Variety(), size, torch.device(device or generator.device))
    name = family or list(FAMILIES)[int(draw.uniform(0.0, float(len(FAMILIES))))]
    aperture = _aperture(draw)
    pattern = FAMILIES[name](draw, aperture)
    if speckle := draw.range("speckle"):
        pattern = pattern * torch.exp(speckle * draw.field(draw.uniform(3.0, 8.0)))
    glow = draw.range("glow")
    pattern = (1 - glow) * pattern / pattern.sum() + glow * aperture.light / aperture.light.sum()
    psf = _blur(draw, _colours(draw, pattern))
    background = draw.range("background")
    psf = (1 - background) * psf / psf.sum((-2, -1), keepdim=True) + background / (size[0] * size[1])
    return unit_sum(psf)


def _colours(draw: _Draw, pattern: Tensor) -> Tensor:
    """Red, green and blue (1, 3, H, W), slightly magnified relative to green and shaded differently."""
    grey = draw.uniform(0.0, 1.0) < draw.variety.grey
    scale, tilts = draw.spread("colour_scale"), [draw.spread("colour_tilt") for _ in range(6)]
    if grey:
        return pattern.expand(1, 3, -1, -1)
    height, width = draw.size
    y = (torch.arange(height, device=draw.device)[:, None] - height // 2) / (height / 2)
    x = (torch.arange(width, device=draw.device) - width // 2) / (width / 2)
    planes = []
    for colour, (down, along) in enumerate(zip(tilts[:3], tilts[3:], strict=True)):
        plane = pattern if colour == 1 else _magnify(pattern, 1 + (colour - 1) * scale)
        planes.append(plane * (1 + down * y + along * x).clamp(min=0.05))
    return torch.stack(planes)[None]


def _magnify(plane: Tensor, factor: float) -> Tensor:
    """Scale a picture (H, W) about its pixel ``(H // 2, W // 2)``."""
    height, width = plane.shape
    # Pixel n // 2 lies at (2 (n // 2) + 1) / n - 1 of grid_sample's axis from -1 to 1.
    middle = [(2 * (n // 2) + 1) / n - 1 for n in (width, height)]
    theta = plane.new_tensor([[1 / factor, 0, 0], [0, 1 / factor, 0]])
    theta[:, 2] = plane.new_tensor(middle) * (1 - 1 / factor)
    grid = F.affine_grid(theta[None], [1, 1, height, width], align_corners=False)
    return F.grid_sample(plane[None, None], grid, align_corners=False)[0, 0]


def _blur(draw: _Draw, psf: Tensor) -> Tensor:
    """Blur each colour by the sum of a narrow and a wide Gaussian (the halo); light outside the frame is lost."""
    narrow, wide = draw.range("blur_px"), draw.uniform(0.02, 0.08) * min(draw.size)
    halo, difference = draw.range("halo"), draw.spread("colour_blur")
    height, width = draw.size
    # Padding by three standard deviations: less than 1e-3 of the halo wraps around.
    margin = math.ceil(3 * wide)
    grid = fast_length(height + margin), fast_length(width + margin)
    widths = [narrow * (1 + colour * difference) for colour in (-1, 0, 1)]
    pass_narrow = torch.stack([gaussian_transfer(grid, sigma, device=draw.device) for sigma in widths])
    transfer = (1 - halo) * pass_narrow + halo * gaussian_transfer(grid, wide, device=draw.device)
    return inverse_spectrum(spectrum(psf, grid) * transfer, grid, draw.size).clamp(min=0)

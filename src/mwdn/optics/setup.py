"""A lensless camera without its mask: aperture, distances, sensor, light."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from mwdn.arguments import check_options
from mwdn.errors import ParameterError
from mwdn.io.arrays import MAX_PIXELS
from mwdn.optics.propagation import check_positive
from mwdn.types import Size

# Gaussians: mean and standard deviation in nm, for the LED also the height. A white LED is a blue chip with a broad
# phosphor; the filters are red, green and blue of a Bayer mosaic. Typical values, not those of a specific part.
_LED = ((450.0, 10.0, 1.0), (560.0, 50.0, 0.6))
_FILTERS = ((605.0, 35.0), (535.0, 38.0), (460.0, 30.0))


@dataclass(frozen=True)
class Setup:
    """A camera without its mask. The defaults are the paper's camera.

    Args:
        distance_mm: from the mask to the sensor. A larger one gives a finer angular resolution and a narrower field.
        source_mm: from the point source to the mask; infinity for a star.
        aperture_mm: height and width of the opening at the mask.
        pixels: rows and columns of the sensor.
        pixel_um: pixel pitch.
        bin: pixels averaged into one, along each axis.
        band_nm: shortest and longest wavelength.
        wavelengths: number of wavelengths to compute, evenly spaced over the band; 1 is the middle of the band.
        colour: a white LED and a sensor with red, green and blue filters; otherwise a flat spectrum on a grey sensor.

    Raises:
        ParameterError: a number is not positive, out of its range, or of another type.
    """

    distance_mm: float = 2.0
    source_mm: float = 200.0
    aperture_mm: tuple[float, float] = (3.0, 2.5)
    pixels: tuple[int, int] = (1280, 1280)
    pixel_um: float = 2.4
    bin: int = 4
    band_nm: tuple[float, float] = (400.0, 760.0)
    wavelengths: int = 25
    colour: bool = True

    def __post_init__(self) -> None:
        # `check_options` refuses infinity, the distance of a star.
        finite = {
            key: value for key, value in vars(self).items() if not (isinstance(value, float) and value == math.inf)
        }
        check_options(Setup, "`Setup`", finite)
        check_positive(distance_mm=self.distance_mm, source_mm=self.source_mm, pixel_um=self.pixel_um)
        check_positive(
            aperture_mm=min(self.aperture_mm), pixels=min(self.pixels), bin=self.bin, wavelengths=self.wavelengths
        )
        if math.isinf(self.distance_mm):
            raise ParameterError("`distance_mm` (inf) must be finite: the sensor is near the mask.")
        for name in ("aperture_mm", "band_nm"):
            if math.inf in getattr(self, name):
                raise ParameterError(f"`{name}` {getattr(self, name)} must be finite.")
        if not 0 < self.band_nm[0] <= self.band_nm[1]:
            raise ParameterError(f"`band_nm` {self.band_nm} must be the shortest and the longest wavelength, positive.")
        if self.bin > min(self.pixels):
            raise ParameterError(f"`bin` ({self.bin}) must be at most {min(self.pixels)}, the smaller side in pixels.")
        rows, columns = self.size
        if min(rows, columns) < 8 or rows * columns > MAX_PIXELS:
            raise ParameterError(
                f"`pixels` {self.pixels} over `bin` ({self.bin}) makes a PSF of {rows:,} x {columns:,} pixels, but it "
                f"must have at least 8 x 8, and at most {MAX_PIXELS:,} in all."
            )

    @property
    def size(self) -> Size:
        """Rows and columns of a measurement, after binning."""
        return self.pixels[0] // self.bin, self.pixels[1] // self.bin

    @property
    def pitch_um(self) -> float:
        """Pixel pitch of a measurement, after binning."""
        return self.pixel_um * self.bin

    def spectrum(self) -> tuple[list[float], Tensor]:
        """Wavelengths in nm and their weights in each channel: (1 or 3, wavelengths), float64, rows of sum 1."""
        first, last = self.band_nm
        if self.wavelengths == 1:
            return [(first + last) / 2], torch.ones(3 if self.colour else 1, 1, dtype=torch.float64)
        nm = torch.linspace(first, last, self.wavelengths, dtype=torch.float64)
        if not self.colour:
            return nm.tolist(), torch.full((1, self.wavelengths), 1 / self.wavelengths, dtype=torch.float64)
        led = torch.stack([part * _gaussian(nm, mean, width) for mean, width, part in _LED]).sum(0)
        weights = torch.stack([led * _gaussian(nm, mean, width) + 1e-12 for mean, width in _FILTERS])
        return nm.tolist(), weights / weights.sum(-1, keepdim=True)


def _gaussian(x: Tensor, mean: float, width: float) -> Tensor:
    return torch.exp(-0.5 * ((x - mean) / width).square())

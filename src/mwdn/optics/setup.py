"""Everything of a lensless camera but its mask: aperture, distances, sensor, light."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from mwdn.errors import ParameterError
from mwdn.optics.propagation import positive
from mwdn.types import Size

# Means and standard deviations in nm. A white LED is a blue chip and the broad light of its phosphor; the filters
# are those of a usual Bayer mosaic. The widths are typical ones, not those of a certain part.
_LED = ((450.0, 10.0, 1.0), (560.0, 50.0, 0.6))
_FILTERS = ((605.0, 35.0), (535.0, 38.0), (460.0, 30.0))


@dataclass(frozen=True)
class Setup:
    """Everything of a camera but its mask. The defaults are the paper's camera.

    Args:
        distance_mm: from the mask to the sensor. The PSF grows sharper in angle with it, the field of view narrower.
        source_mm: from the point to the mask; infinity for a star.
        aperture_mm: height and width of the opening at the mask.
        pixels: rows and columns of the sensor that are used.
        pixel_um: distance of the pixels.
        bin: pixels that are averaged to one, along each axis.
        band_nm: shortest and longest wavelength.
        wavelengths: how many of the band are computed, evenly spaced; one stands for the middle of the band.
        colour: a white LED seen by a sensor with red, green and blue filters; otherwise even light on a grey sensor.

    Raises:
        ParameterError: a number that no camera can have.
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
        positive(distance_mm=self.distance_mm, source_mm=self.source_mm, pixel_um=self.pixel_um)
        positive(aperture_mm=min(self.aperture_mm), pixels=min(self.pixels), bin=self.bin, wavelengths=self.wavelengths)
        if math.isinf(self.distance_mm):
            raise ParameterError("`distance_mm` (inf) must be finite: a lensless camera has its sensor near the mask.")
        if not 0 < self.band_nm[0] <= self.band_nm[1]:
            raise ParameterError(f"`band_nm` {self.band_nm} must be the shortest and the longest wavelength, positive.")
        if self.bin > min(self.pixels):
            raise ParameterError(f"`bin` ({self.bin}) must be at most {min(self.pixels)}, the smaller side in pixels.")

    @property
    def size(self) -> Size:
        """Rows and columns of a measurement, after binning."""
        return self.pixels[0] // self.bin, self.pixels[1] // self.bin

    @property
    def pitch_um(self) -> float:
        """Distance of the measurement's pixels, after binning."""
        return self.pixel_um * self.bin

    def spectrum(self) -> tuple[list[float], Tensor]:
        """Wavelengths in nm, and their part in each channel's light: (1 or 3, wavelengths), float64, rows of sum 1."""
        first, last = self.band_nm
        if self.wavelengths == 1:
            return [(first + last) / 2], torch.ones(3 if self.colour else 1, 1, dtype=torch.float64)
        nm = torch.linspace(first, last, self.wavelengths, dtype=torch.float64)
        if not self.colour:
            return nm.tolist(), torch.full((1, self.wavelengths), 1 / self.wavelengths, dtype=torch.float64)
        led = torch.stack([part * _bell(nm, mean, width) for mean, width, part in _LED]).sum(0)
        weights = torch.stack([led * _bell(nm, mean, width) + 1e-12 for mean, width in _FILTERS])
        return nm.tolist(), weights / weights.sum(-1, keepdim=True)


def _bell(x: Tensor, mean: float, width: float) -> Tensor:
    return torch.exp(-0.5 * ((x - mean) / width).square())

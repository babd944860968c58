"""A liquid crystal display as a mask: rectangular cells with colour filters and dark gaps between them."""

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from mwdn.arguments import checked
from mwdn.errors import ParameterError, ShapeError
from mwdn.optics.masks import Mask, check_samples, mask_psf
from mwdn.optics.propagation import check_positive
from mwdn.optics.psf import unit_sum
from mwdn.optics.setup import Setup
from mwdn.types import Plane, Psf

COLOURS_NM = (605.0, 535.0, 460.0)
"""Middle of the red, green and blue filters of a sensor, as in `mwdn.optics.setup`."""


@checked
@dataclass(frozen=True)
class Lcd:
    """A display whose cells are switched between opaque and clear.

    The defaults are the display of DigiCam: 1.8 inches, 384 x 160 cells (3 colours in the rows), 28.03 x 35.04 mm.

    Args:
        pitch_um: distance of the cells, down and across.
        opening_um: height and width of the clear part of a cell.
        stripes: rows of cells are red, green, blue in turn; otherwise all cells are clear.
        sample_um: pitch at which light is computed; light bends by at most ``wavelength / (2 sample_um)``, here 2.6
            degrees, twice as far as the second dark fringe of a cell of 60 um.
    """

    pitch_um: tuple[float, float] = (73.03, 219.25)
    opening_um: tuple[float, float] = (60.0, 180.0)
    stripes: bool = True
    sample_um: float = 6.0

    def __post_init__(self) -> None:
        check_positive(sample_um=self.sample_um, pitch_um=min(self.pitch_um), opening_um=min(self.opening_um))
        if any(opening > pitch for opening, pitch in zip(self.opening_um, self.pitch_um, strict=True)):
            raise ParameterError(f"`opening_um` {self.opening_um} must be at most `pitch_um` {self.pitch_um}.")

    def amplitude(self, transmission: Plane, channel: int | None = None) -> Mask:
        """The mask for one colour.

        Args:
            transmission: (rows, columns) of the cells' power, in [0, 1].
            channel: 0, 1, 2 for red, green, blue; ``None`` for light that passes every filter.
        """
        places = []
        for count, pitch, opening in zip(transmission.shape, self.pitch_um, self.opening_um, strict=True):
            samples = round(count * pitch / self.sample_um)
            place = (torch.arange(samples) + 0.5) * self.sample_um / pitch
            cell = place.long().clamp(max=count - 1)
            clear = ((place - cell) - 0.5).abs() <= opening / pitch / 2
            places.append((cell, clear))
        (rows, row_clear), (columns, column_clear) = places
        check_samples(len(rows), len(columns))
        if self.stripes and channel is not None:
            row_clear = row_clear & (rows % 3 == channel)
        values = transmission.float().sqrt()[rows][:, columns] * row_clear[:, None] * column_clear
        return Mask("amplitude", values, self.sample_um)


def lcd_psf(transmission: Tensor, setup: Setup, lcd: Lcd = Lcd()) -> Psf:
    """PSF of a camera with a display as its mask: (1, 3, *setup.size), each colour of unit sum.

    Each colour is computed at the middle of its filter; colours of one display differ because their cells do.

    Args:
        transmission: (rows, columns) of the cells' power, in [0, 1]; their middle is on the axis.
        setup: distances and sensor; its aperture and wavelengths are not used.
        lcd: geometry of the display.

    Raises:
        ShapeError: ``transmission`` has other axes.
        ParameterError: numbers outside [0, 1], or a colour without a clear cell.
    """
    if transmission.ndim != 2:
        raise ShapeError(f"`transmission` {tuple(transmission.shape)} must be (rows, columns) of cells.")
    low, high = float(transmission.min()), float(transmission.max())
    if not (low >= 0 and high <= 1):  # NaN fails this too
        raise ParameterError(f"`transmission` ({low:g} to {high:g}) must be in [0, 1]. Divide it by its full scale.")
    size_mm = tuple(n * pitch / 1e3 for n, pitch in zip(transmission.shape, lcd.pitch_um, strict=True))
    planes = []
    for channel, wavelength in enumerate(COLOURS_NM):
        one = replace(
            setup, aperture_mm=(size_mm[0], size_mm[1]), band_nm=(wavelength, wavelength), wavelengths=1, colour=False
        )
        plane = mask_psf(lcd.amplitude(transmission, channel), one)
        if not float(plane.sum()) > 0:
            raise ParameterError("`transmission` lets no light of a colour through. Check the mask's file.")
        planes.append(unit_sum(plane))
    return torch.cat(planes, 1)

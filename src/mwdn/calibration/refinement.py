"""Terms of a camera beyond its PSF, measured with known pictures: gains, displaced envelope, sensor field, stray light.

With place r over the PSF, x over the sensor and p over the scene, all from -1 to 1 over the frame, a camera measures

    b = S(x) (h'(r) * v) + B(x),    h'(r) = g(r) E(r - d) / E(r) h(r)

S is the sensor's field, B stray light that no scene causes, g a gain of each colour over the PSF, d the displacement of
the aperture's shadow E against the mask's pattern (`mwdn.optics.aperture`). S, B and g are polynomials, so they fit
frames of any size.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from mwdn.arguments import checked
from mwdn.errors import ParameterError
from mwdn.optics.aperture import displaced_envelope
from mwdn.optics.polynomials import frame_places, polynomial, polynomial_order
from mwdn.optics.psf import unit_sum
from mwdn.types import Image, Measurement, Psf, Size, size_of

Coefficients = tuple[tuple[float, ...], ...]
"""Coefficients of polynomials: a row for each colour, or one for all."""

TERMS = ("psf_gain", "envelope_shift", "sensor_field", "stray_light")
"""Fields of `Refinement`, which are keys of a camera file, too."""

MIN_FIELD = 0.05
"""Lower limit of gains and fields: a polynomial may fall below 0 where it was not measured."""


@checked
@dataclass(frozen=True)
class Refinement:
    """Terms found by `mwdn calibrate --pairs`; empty ones do nothing.

    Args:
        psf_gain: g of each colour, or of all.
        envelope_shift: d down and right, over the frame's shorter side.
        sensor_field: S.
        stray_light: B of each colour, or of all, as a fraction of the full scale.

    Raises:
        ParameterError: a row has not 1, 3, 6, 10 ... coefficients, or there are neither 1 nor 3 equally long rows.
    """

    psf_gain: Coefficients = ()
    envelope_shift: tuple[float, float] | None = None
    sensor_field: Coefficients = ()
    stray_light: Coefficients = ()

    def __post_init__(self) -> None:
        for name in ("psf_gain", "sensor_field", "stray_light"):
            rows: Coefficients = getattr(self, name)
            lengths = {len(row) for row in rows}
            if rows and (len(rows) not in (1, 3) or len(lengths) != 1 or polynomial_order(*lengths) is None):
                raise ParameterError(
                    f"`{name}` ({len(rows)} rows of {sorted(lengths)}) must have 1 or 3 rows of equal length: 1, 3, 6, "
                    "10, 15 ... coefficients of a polynomial."
                )

    def __bool__(self) -> bool:
        return self != Refinement()

    def psf(self, psf: Psf) -> Psf:
        """The refined PSF (1, C, H, W) of a calibrated one, each channel of unit sum.

        Raises:
            ParameterError: three rows for a grey PSF.
        """
        if self.envelope_shift is None and not self.psf_gain:
            return psf  # not normalised again: rounding would change its hash
        if self.envelope_shift is not None:
            psf = displaced(psf, self.envelope_shift)
        if self.psf_gain:
            psf = psf * self._field("psf_gain", psf).clamp(min=MIN_FIELD)
        return unit_sum(psf)

    def measurement(self, measurement: Measurement) -> Measurement:
        """``(b - B) / S``: the measurement of an even sensor without stray light.

        Raises:
            ParameterError: three rows for a grey measurement.
        """
        if self.stray_light:
            measurement = measurement - self._field("stray_light", measurement)
        if self.sensor_field:
            measurement = measurement / self._field("sensor_field", measurement).clamp(min=MIN_FIELD)
        return measurement

    def field_map(self, size: Size) -> Tensor | None:
        """S over the sensor, (1, rows, height, width); ``None`` for an even sensor."""
        return smooth_field(self.sensor_field, size) if self.sensor_field else None

    def stray_map(self, size: Size) -> Tensor | None:
        """B over the sensor, (1, rows, height, width); ``None`` for none."""
        return smooth_field(self.stray_light, size) if self.stray_light else None

    def _field(self, name: str, image: Image) -> Tensor:
        rows: Coefficients = getattr(self, name)
        if len(rows) == 3 and image.shape[1] == 1:
            raise ParameterError(f"`{name}` has a row for each colour, but the frame is grey. Refine with grey pairs.")
        return smooth_field(rows, size_of(image)).to(image)


def displaced(psf: Psf, shift: tuple[float, float]) -> Psf:
    """A PSF (1, C, H, W) whose envelope is displaced by parts of the shorter side. Its sum may change."""
    return displaced_envelope(psf, torch.tensor([shift], dtype=psf.dtype) * min(psf.shape[-2:]))


def smooth_field(rows: Coefficients, size: Size) -> Tensor:
    """Polynomials over a frame, (1, rows, height, width)."""
    return polynomial(torch.tensor(rows, dtype=torch.float64), *frame_places(size))[None].float()

"""Whether a grey frame is the raw data of a colour sensor, from its own spectrum.

A frame behind a colour filter array with colours R, G, B and red at pixel (0, 0) is, with x the column and y the row,

    I = (R + 2 G + B) / 4  +  (-1)^(x + y) (R - 2 G + B) / 4  +  ((-1)^x + (-1)^y) (R - B) / 4.

The colours change slowly compared with the pixels, so the three modulated terms are narrow peaks of the spectrum at
(1/2, 1/2), (1/2, 0) and (0, 1/2) cycles per pixel. A grey frame has no peaks there: fine detail and noise are spread
evenly. The terms at (1/2, 0) and (0, 1/2) are equal if red and blue share the main diagonal ("rggb", "bggr"), and
opposite if green does ("grbg", "gbrg"). Rows or columns of unequal gain give one of the two only.

Red and blue cannot be told apart: exchanged, they give the same spectrum for a scene with exchanged colours.
"""

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from mwdn.calibration import Calibration
from mwdn.diagnosis.verdict import Verdict
from mwdn.fourier.transforms import frequency_grid, spectrum
from mwdn.types import Frame

PEAK_RADIUS = 0.03
"""Radius of a peak in cycles per pixel: colours that change over 30 pixels and more."""

RING = 0.12
"""Outer radius of the ring around a peak that shows fine detail and noise."""

MIN_CONTRAST = 5.0
"""Smallest density of a mosaic's peak over that of its ring, which holds fine detail, noise and sharp colours. Raw
frames have 6 to 300,000, grey, colour and binned ones 0.5 to 4.4; those interpolated from a mosaic keep up to 51."""

MIN_AMPLITUDE = 0.005
"""Smallest amplitude of a mosaic over the mean brightness. Raw frames have 0.0086 and more, those interpolated from a
mosaic 0.0025 and less."""

MIN_COHERENCE = 0.5
"""Smallest coherence of the peaks at (1/2, 0) and (0, 1/2) that shows the diagonal of green; 1 without noise."""

EXAMINED_SIDE_PX = 1024
"""Pixels along each side that are examined, in the middle of the frame."""

MIN_MOSAIC_PX = 64
"""Pixels along each side that a frame must have: a peak then holds 6 of them."""


class Peaks(NamedTuple):
    """Peaks of a grey frame's spectrum at the three frequencies of a mosaic.

    Args:
        contrast: density of the peak at (1/2, 1/2) over its ring's, or of the weaker of the two others if it is larger.
        amplitude: of the modulation, relative to the mean brightness.
        coherence: of the peaks at (1/2, 0) and (0, 1/2), -1 to 1; its sign tells the diagonal of green.
        checkerboard: mean of (-1)^(x + y) I over the mean of I: negative if the main diagonal is darker.
    """

    contrast: float
    amplitude: float
    coherence: float
    checkerboard: float

    @property
    def found(self) -> bool:
        """Whether they are those of a mosaic."""
        return self.contrast > MIN_CONTRAST and self.amplitude > MIN_AMPLITUDE

    @property
    def orders(self) -> tuple[str, str]:
        """The two orders that fit. Filters of equal red and blue light: green lets most light through."""
        is_coherent = abs(self.coherence) > MIN_COHERENCE
        green_is_off_diagonal = self.coherence > 0 if is_coherent else self.checkerboard < 0
        return ("rggb", "bggr") if green_is_off_diagonal else ("grbg", "gbrg")


def mosaic(frame: Frame, calibration: Calibration) -> Verdict:
    """Whether a frame is the raw data of a colour sensor, and whether ``--mosaic`` says so.

    The value is "rggb|bggr" or "grbg|gbrg": the frame does not show which order of such a pair is right.

    Args:
        frame: (H, W, C), numbers as stored.
        calibration: the camera's.
    """
    given = calibration.frames.mosaic or ""
    if frame.shape[-1] != 1:
        return Verdict("capture", "mosaic", "good", "The frame has colours.")
    if min(frame.shape[:2]) < MIN_MOSAIC_PX:
        return Verdict("capture", "mosaic", "unknown", "The frame is too small to show whether it is raw.", given)
    peaks = find_peaks(torch.from_numpy(frame[..., 0].astype(np.float32)))
    measured = f"alternate pixels differ by {peaks.amplitude:.1%} of the mean"
    if not peaks.found:
        text = f"The frame shows no mosaic of colour filters: {measured}"
        if not given:
            return Verdict("capture", "mosaic", "good", f"{text}.")
        return Verdict("capture", "mosaic", "doubt", f"{text}, but `--mosaic {given}` is given. Leave it out.")
    first, second = peaks.orders
    if given in peaks.orders:
        return Verdict("capture", "mosaic", "good", f"The frame is raw data of a colour sensor: {measured}.", given)
    text = (
        f"The frame looks like the raw data of a colour sensor: {measured}"
        + (f", and `--mosaic {given}` has green on the wrong diagonal" if given else "")
        + f". If red and blue of the picture are exchanged, use `--mosaic {second}`."
    )
    return Verdict("capture", "mosaic", "doubt", text, f"{first}|{second}", f"--mosaic {first}")


def find_peaks(plane: Tensor) -> Peaks:
    """Measure the peaks of a picture (H, W) of at least `MIN_MOSAIC_PX` pixels along each side."""
    height, width = (min(length, EXAMINED_SIDE_PX) // 2 * 2 for length in plane.shape)
    top, left = ((length - cut) // 4 * 2 for length, cut in zip(plane.shape, (height, width), strict=True))
    image = plane[top : top + height, left : left + width].float()
    # The window keeps jumps at the border of the frame out of the peaks.
    image = image * torch.hann_window(height)[:, None] * torch.hann_window(width)
    x, y = 1 - 2 * (torch.arange(width) % 2), 1 - 2 * (torch.arange(height) % 2)[:, None]
    F = spectrum(torch.stack([image, image * x, image * y, image * x * y])[None], (height, width))[0]
    rows, columns = frequency_grid((height, width))
    distance = torch.hypot(rows, columns)
    inside, ring = distance < PEAK_RADIUS, (distance > 1.5 * PEAK_RADIUS) & (distance < RING)
    energy = F.abs().square()
    peaks = energy[:, inside].mean(1)
    level = energy[:, ring].mean(1)
    contrast = (peaks / level.clamp(min=1e-30))[1:]
    across, along = F[1, inside], F[2, inside]
    coherence = (across * along.conj()).real.sum() / (across.norm() * along.norm()).clamp(min=1e-30)
    return Peaks(
        contrast=float(torch.maximum(contrast[2], torch.minimum(contrast[0], contrast[1]))),
        amplitude=float(((peaks - level)[1:].clamp(min=0).sum() / peaks[0].clamp(min=1e-30)).sqrt()),
        coherence=float(coherence),
        checkerboard=float(F[3, 0, 0].real / F[0, 0, 0].real.clamp(min=1e-30)),
    )

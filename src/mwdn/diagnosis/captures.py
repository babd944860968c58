"""All checks of one raw frame."""

import torch
from torch.nn import functional as F

from mwdn.calibration import Calibration
from mwdn.calibration.psf_levels import SATURATED_PART
from mwdn.diagnosis.encoding import gamma
from mwdn.diagnosis.mosaic import mosaic
from mwdn.diagnosis.noise import noise
from mwdn.diagnosis.verdict import Verdict
from mwdn.errors import ImageError
from mwdn.io.arrays import as_frame
from mwdn.types import Frame, Measurement

MIN_PEAK = 0.03
"""Fraction of the full scale that the brightest thousandth of a capture must reach."""

NEGATIVE = 0.15
"""Part of a measurement's light that may be below 0. The noise of a small object through PhlatCam's PSF causes 0.003 at
2,000 electrons and 0.10 at 100; the paper's PSF leaves no dark pixels."""

MAX_AMBIENT = 0.05
"""Fraction of the light that may be ambient without a remark."""


def examine_capture(frame: Frame, calibration: Calibration, *, for_viewing: bool = False) -> tuple[Verdict, ...]:
    """Run all checks that need nothing but a raw frame and the camera's calibration.

    A new check is one more entry here: a function that returns a `Verdict`.

    Args:
        frame: (H, W) or (H, W, C), as `FrameFormat.read` returns it.
        calibration: the camera's.
        for_viewing: the capture's file is of a type for viewing (`mwdn.io.formats.is_for_viewing`).
    """
    frame = as_frame(frame, finite=False)
    raw = mosaic(frame, calibration)
    verdicts = *(check(frame, calibration) for check in (saturation, darkness, noise, ambient_light)), raw
    if raw.state == "doubt":  # the noise test needs a known mosaic
        return verdicts
    return *verdicts, gamma(frame, calibration, for_viewing=for_viewing)


def refuse_dark(measurement: Measurement) -> None:
    """Raise an `ImageError` if a measurement has no light."""
    if measurement.amax() <= 0:
        raise ImageError("The sensor saw no light: no pixel is brighter than the dark frame, or black.")


def saturation(frame: Frame, calibration: Calibration) -> Verdict:
    """Whether so many pixels are saturated that even the right PSF may look wrong; floats have no known maximum."""
    part = calibration.saturated_part(frame)
    text = f"{part:.1%} of the capture's pixels are saturated"
    if part > SATURATED_PART:
        return Verdict("capture", "saturation", "doubt", f"{text}: how bright their light was is not known.")
    return Verdict("capture", "saturation", "good", f"{text}.")


def darkness(frame: Frame, calibration: Calibration) -> Verdict:
    """Whether too much was subtracted, or the capture uses so little of the range that noise and rounding dominate.

    Floats have no known range.
    """
    if frame.dtype.kind == "f" or calibration.offset is not None:
        measurement = calibration.correct(frame)
        below = float(measurement.clamp(max=0).abs().sum() / measurement.abs().sum().clamp(min=1e-30))
        if below > NEGATIVE:
            text = f"{below:.0%} of the capture's light is below 0: more was subtracted than the sensor saw."
            return Verdict("capture", "darkness", "doubt", text)
    if frame.dtype.kind == "f":
        return Verdict("capture", "darkness", "unknown", "The file holds floats, so its full scale is not known.")
    pixels = torch.from_numpy(frame.max(axis=-1).astype("float32")).flatten()
    brightest = float(pixels.kthvalue(pixels.numel() - pixels.numel() // 1000).values)
    part = brightest / calibration.frames.full_scale(frame)
    text = f"The brightest thousandth of the capture starts at {part:.1%} of the full scale"
    if part < MIN_PEAK:
        bits = calibration.frames.possible_bit_depth(frame)
        text = f"{text}: too dark" + (", or in the lower bits of its file." if bits else ".")
        return Verdict("capture", "darkness", "doubt", text, "darkness", f"--bit-depth {bits}" if bits else "")
    return Verdict("capture", "darkness", "good", f"{text}.")


def ambient_light(frame: Frame, calibration: Calibration) -> Verdict:
    """Largest share of the light that can be the room's: that of the darkest spot of the brightest half.

    The room's light is even, or comes from one side. One capture cannot tell it from bright surroundings, so this is
    never a doubt.
    """
    measurement = calibration.correct(frame)
    smooth = F.avg_pool2d(measurement, min(5, *measurement.shape[-2:]), 1)
    halves = [half for axis in (-2, -1) for half in smooth.tensor_split(2, axis) if half.numel()]
    floor = torch.stack([half.flatten(2).amin(-1).clamp(min=0).sum() for half in halves]).amax()
    part = float(floor / measurement.mean((-2, -1)).sum().clamp(min=1e-30))
    text = f"At most {part:.0%} of the capture's light is ambient light"
    if part < MAX_AMBIENT:
        return Verdict("capture", "ambient-light", "good", f"{text}.")
    text = f"{text}: the room's light, or bright surroundings."
    return Verdict("capture", "ambient-light", "unknown", text, options="--ambient FILE")

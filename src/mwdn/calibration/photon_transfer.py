"""Gain, read noise and full well of a sensor, from pairs of flat frames: photon transfer."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from mwdn.calibration.frame_format import FrameFormat
from mwdn.calibration.noise_model import clipped_variance, fit_line
from mwdn.errors import ParameterError
from mwdn.io.arrays import as_frame
from mwdn.optics.sensor import Sensor
from mwdn.types import Frame

SAME_LIGHT = 0.05
"""Relative difference of the light of two flat frames up to which they count as a pair."""

COLLAPSE = 0.7
"""Variance over that of the line, below which the pixels are full: electrons that spill over add no noise."""


@dataclass(frozen=True)
class PhotonTransfer:
    """Result of photon transfer for a sensor.

    Args:
        electrons_per_count: gain of the converter.
        read_noise: standard deviation in electrons, quantisation excluded.
        full_well: electrons at saturation, of the converter or of the pixels, whichever is first.
        black_level: mean of a dark frame, as a fraction of the full scale.
        bit_depth: of the converter.
        error: relative standard error of the gain.
        clipped: the black level is so low that the converter cuts off the noise of darkness.
    """

    electrons_per_count: float
    read_noise: float
    full_well: float
    black_level: float
    bit_depth: int
    error: float
    clipped: bool = False

    @property
    def sensor(self) -> Sensor:
        """The sensor for simulation."""
        return Sensor(self.full_well, self.read_noise, self.bit_depth, self.black_level)


def photon_transfer(
    flats: Sequence[Frame],
    darks: Sequence[Frame],
    format: FrameFormat = FrameFormat(),
    *,
    bad: Tensor | None = None,
    black: float | None = None,
) -> PhotonTransfer:
    """Measure gain, read noise and full well from pairs of flat frames and a pair of dark ones.

    Half the variance of the difference of two frames of the same light is that of one frame, without the fixed pattern
    of the pixels: ``variance = signal / g + read^2 / g^2 + 1 / 12``, in counts, with g electrons per count. Both sides
    are linear in the signal, so their means over the pixels obey it even if the light is uneven. A weighted line
    through the dark pair and the flat pairs gives g and the read noise.

    Args:
        flats: (H, W) or (H, W, C), consecutive pairs of the same light, at any number of levels; 20 to 80 % of
            saturation.
        darks: of the same size, consecutive pairs, at least one, of the same exposure as the flats.
        format: of the frames; linear in light.
        bad: (1, 1, H, W), bool, pixels that are left out.
        black: level without any light, as a fraction of the full scale; that of the dark frames unless given. If they
            are brighter, light of the room is in them, and its noise is no read noise.

    Raises:
        ImageError: an array is no frame.
        ParameterError: too few frames, frames of several sizes, an encoded file, unequal light within a pair, or
            nothing but saturated flats.
    """
    flats, darks = ([as_frame(frame, finite=False) for frame in frames] for frames in (flats, darks))
    if format.gamma is not None or any(frame.dtype.kind == "f" for frame in (*flats, *darks)):
        raise ParameterError("Photon transfer needs the sensor's integers, linear in light: no floats, no `gamma`.")
    if len(flats) < 2 or len(darks) < 2:
        raise ParameterError(
            f"Photon transfer needs two flat frames of the same light and two dark ones, not {len(flats)} and "
            f"{len(darks)}: `--flat a.png b.png --dark c.png d.png`."
        )
    if len(sizes := {frame.shape for frame in (*flats, *darks)}) > 1:
        raise ParameterError(
            f"All frames of a photon transfer must have one size, not {' and '.join(map(str, sorted(sizes)))}. Use the "
            "same camera settings."
        )
    good = ~(np.zeros(flats[0].shape[:2], bool) if bad is None else bad[0, 0].numpy())
    full = format.full_scale(darks[0])
    dark_level = float(np.mean([frame[good].mean(dtype=np.float64) for frame in darks]))
    black = dark_level if black is None else min(black * full, dark_level)
    dark_pairs = zip(darks[::2], darks[1::2], strict=False)
    dark_variance = float(np.mean([_half_variance(*pair, good) for pair in dark_pairs]))
    signals, variances = [dark_level - black], [max(dark_variance, 1 / 12)]
    for number, (first, second) in enumerate(zip(flats[::2], flats[1::2], strict=False), 1):
        means = [float(frame[good].mean(dtype=np.float64)) - black for frame in (first, second)]
        if min(means) <= 0 or max(means) / min(means) > 1 + SAME_LIGHT:
            raise ParameterError(
                f"Flat frames {2 * number - 1} and {2 * number} must have the same light, but have levels "
                f"of {means[0]:.0f} and {means[1]:.0f} counts above black. Give them in pairs of the same exposure."
            )
        if max(format.saturated(frame)[0] for frame in (first, second)) > 1e-3 * good.size:
            continue
        signals.append(sum(means) / 2)
        variances.append(_half_variance(first, second, good))
    if len(signals) < 2:
        raise ParameterError("All flat frames are saturated. Expose them to about half of the full scale.")
    return _fit(signals, variances, black, full, int(good.sum()) * flats[0].shape[-1])


def _half_variance(first: Frame, second: Frame, good: np.ndarray) -> float:
    difference = first[good].astype(np.float32) - second[good]
    difference -= difference.mean(0, dtype=np.float64).astype(np.float32)
    return clipped_variance(torch.from_numpy(difference)) / 2


def _fit(signals: list[float], variances: list[float], black: float, full: float, count: int) -> PhotonTransfer:
    order = np.argsort(signals)
    x = torch.tensor(signals, dtype=torch.float64)[torch.from_numpy(order)]
    y = torch.tensor(variances, dtype=torch.float64)[torch.from_numpy(order)]
    used = len(x)
    # The brightest pairs may have full pixels: leave the brightest out while it is far below the line through the
    # others.
    while used > 3 and _collapsed(x[:used], y[:used]):
        used -= 1
    slope, _ = fit_line(x[:used], y[:used], 1 / y[:used].square())
    if slope <= 0:
        raise ParameterError(
            "The flat frames are no noisier than the dark ones, so they are no raw frames of a sensor. "
            "Save frames without processing (no denoising, no JPEG)."
        )
    gain = 1 / slope
    well = float(x[used - 1]) if used < len(x) else full - black
    read = max(float(y[0]) - slope * float(x[0]) - 1 / 12, 0.0) ** 0.5 * gain  # x[0]: of the dark pair
    spread = 2**0.5 * float(y[used - 1]) / count**0.5 / (slope * float(x[used - 1]))
    deviation = float(y[0]) ** 0.5
    return PhotonTransfer(
        gain, read, gain * well, black / full, int(full).bit_length(), spread, clipped=black < 3 * deviation
    )


def _collapsed(x: torch.Tensor, y: torch.Tensor) -> bool:
    """Whether the brightest pair's variance lies far below the line through the others."""
    slope, floor = fit_line(x[:-1], y[:-1], 1 / y[:-1].square())
    return float(y[-1]) < COLLAPSE * (slope * float(x[-1]) + floor)

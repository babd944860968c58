"""The mean of several frames of the same light, without outlying frames and outlying pixels."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from mwdn.calibration.frame_format import FrameFormat
from mwdn.calibration.frame_operations import bin_pixels
from mwdn.calibration.noise_model import NoiseModel, fit_noise
from mwdn.errors import ImageError, ParameterError
from mwdn.io.arrays import as_frame
from mwdn.optics.displacement import displacement
from mwdn.types import Frame, Image

Kind = Literal["PSF", "dark", "flat"]
"""What the frames show: a point source, no light, or even light."""

MAX_TOTAL_BYTES = 2**32
"""Limit of the stored bytes of frames that are averaged at once: 4 GiB, 170 frames of 12 megapixels."""

LIGHT_TOLERANCE = 0.05
"""Relative difference of a frame's light from the median of all, above which the frame is left out. Smaller
differences, as of a lamp that flickers, are divided out."""

MOVED_PX = 0.5
"""Displacement above which a frame is left out, because it would widen the lines of the PSF."""

MIN_LIKENESS = 0.7
"""Correlation with the other frames, in coarse pixels, below which a frame shows another pattern, unless noise accounts
for it. Real captures of objects have up to 0.58 with their camera's PSF."""

NOISE_MARGIN = 10.0
"""Energy of the difference of two frames in coarse pixels, over that of its noise, up to which it counts as noise."""

CLIP = 5.0
"""Standard deviations above which a pixel of one frame is an outlier; 6e-7 of the good pixels are, too."""

_ROWS = 2**22  # numbers of one frame processed at once: some tens of MB for the frames of a band
_SIDE = 1024  # pixels of the longer side of the frames whose displacement is measured
_COARSE_SIDE = 64  # of those whose likeness is measured: they have less noise


@dataclass(frozen=True, eq=False)
class FrameAverage:
    """The mean of frames of the same light.

    Args:
        image: (1, C, H, W), mean in linear units of the full scale; a dark frame is subtracted if one was given.
        count: number of frames averaged.
        saturated: (1, 1, H, W), bool, pixels that are saturated in more than half of the frames.
        noise: of one frame; ``None`` for a single one.
        rejected: reason for each frame left out, by its name.
    """

    image: Image
    count: int
    saturated: Tensor
    noise: NoiseModel | None = None
    rejected: dict[str, str] = field(default_factory=dict)


def average_frames(
    frames: Sequence[Frame],
    format: FrameFormat = FrameFormat(),
    *,
    names: Sequence[str] = (),
    kind: Kind = "PSF",
    dark: Image | None = None,
) -> FrameAverage:
    """Average frames of the same light, with outliers rejected.

    A frame is left out if its light differs from the others' by more than `LIGHT_TOLERANCE`, or if its pattern is
    another one (`MIN_LIKENESS`) or displaced by `MOVED_PX`. A pixel of a frame is left out if it differs from the
    median of all frames by more than `CLIP` standard deviations of the noise, which is measured from the frames
    themselves. With two frames, the higher of two such values is left out, because a cosmic hit only adds light.

    Args:
        frames: (H, W) or (H, W, C), as stored, all of one shape and type.
        format: of the frames; only its numbers count (bit depth, gamma), not its crop, mosaic and bin.
        names: of the frames, for messages; numbered if two are the same.
        kind: what they show. Darkness has no light to compare, and even light no pattern.
        dark: (1, C or 1, H, W), subtracted from each; in linear units of the full scale.

    Raises:
        ImageError: no frames, no frame, frames of another size, or more than `MAX_TOTAL_BYTES`.
        ParameterError: most frames are outliers, or two disagree.
    """
    frames = [as_frame(frame, finite=False) for frame in frames]
    names = list(names) or [f"frame {number}" for number in range(1, len(frames) + 1)]
    if len(set(names)) < len(names):  # an outlier would exclude all frames of its name
        names = [f"{name} ({number})" for number, name in enumerate(names, 1)]
    _check_alike(frames, names)
    if dark is not None and tuple(dark.shape[-2:]) != frames[0].shape[:2]:
        got, wanted = (" x ".join(map(str, size)) for size in (frames[0].shape[:2], dark.shape[-2:]))
        raise ImageError(f"`{names[0]}` ({got}) must be like the dark frames ({wanted}). Use the same camera settings.")
    format = format.encoding
    rejected = _outlying(frames, format, names, kind, dark) if len(frames) > 1 else {}
    kept = [number for number, name in enumerate(names) if name not in rejected]
    if 2 * len(kept) < len(frames) or (len(frames) == 2 and rejected):
        exposures = "; if they have several exposures, give those: `exposures`" if kind == "PSF" else ""
        raise ParameterError(
            f"The {kind} frames disagree: {_listed(rejected)}. Take them again, three or more{exposures}."
        )
    scales = _scales([frames[i] for i in kept], format, kind, dark)
    noise = _noise([frames[i] for i in kept], format, scales, dark)
    parts = []
    rows = max(1, _ROWS // (frames[0].shape[1] * frames[0].shape[2] * max(1, len(kept) // 4)))
    for top in range(0, frames[0].shape[0], rows):
        band = slice(top, top + rows)
        stack = _linear([frames[i][band] for i in kept], format, scales, None if dark is None else dark[..., band, :])
        parts.append(_clipped_mean(stack, noise))
    saturated = _saturated([frames[i] for i in kept], format)
    image = torch.cat(parts, -2)
    return FrameAverage(image, len(kept), saturated, noise, rejected)


def _check_alike(frames: Sequence[Frame], names: Sequence[str]) -> None:
    if not frames:
        raise ImageError("Give at least one frame.")
    for frame, name in zip(frames, names, strict=True):
        if frame.shape != frames[0].shape or frame.dtype != frames[0].dtype:
            got, wanted = (f"{' x '.join(map(str, one.shape))}, {one.dtype}" for one in (frame, frames[0]))
            raise ImageError(f"`{name}` ({got}) must be like `{names[0]}` ({wanted}). Use the same camera settings.")
    if (size := sum(frame.nbytes for frame in frames)) > MAX_TOTAL_BYTES:
        raise ImageError(f"{len(frames)} frames ({size:,} bytes) are more than {MAX_TOTAL_BYTES:,}. Give fewer frames.")


def _linear(frames: Sequence[Frame], format: FrameFormat, scales: Sequence[float], dark: Image | None) -> Tensor:
    """(n, C, H, W), linear, less the dark frame, all with the light of the median frame."""
    images = torch.cat([format.normalise(frame) for frame in frames])
    images = images if dark is None else images - dark
    return images / torch.tensor(scales)[:, None, None, None]


def _small(frame: Frame, format: FrameFormat, dark: Image | None) -> Image:
    """A frame less the dark frame, in units of the full scale, binned to at most `_SIDE` pixels a side."""
    image = format.normalise(frame)
    return _binned(image if dark is None else image - dark, _SIDE)


def _binned(image: Tensor, side: int) -> Tensor:
    return bin_pixels(image, max(1, min(-(-max(image.shape[-2:]) // side), min(image.shape[-2:]) // 2)))


def _light(image: Image) -> float:
    """Mean above the darkest 5 %: stray light and the black level do not depend on the source."""
    floor = image.flatten().kthvalue(max(1, image.numel() // 20)).values
    return float((image - floor).mean())


def _outlying(
    frames: Sequence[Frame], format: FrameFormat, names: Sequence[str], kind: Kind, dark: Image | None
) -> dict[str, str]:
    """The reason for each frame that is unlike the others."""
    small = [_small(frame, format, dark) for frame in frames]
    factor = frames[0].shape[0] // small[0].shape[-2]
    if kind == "dark":
        return _unusual_levels(small, names)
    # The median of two is the darker one of each pixel, and so like both: each is compared with the other one.
    references = small[::-1] if len(small) == 2 else [torch.cat(small).median(0, keepdim=True).values] * len(small)
    levels = [_light(image) if kind == "PSF" else float(image.mean()) for image in small]
    usual = float(np.median(levels))
    rejected = {}
    for name, image, reference, level in zip(names, small, references, levels, strict=True):
        if usual <= 0 or abs(level / usual - 1) > LIGHT_TOLERANCE:
            rejected[name] = f"`{name}` has {level / max(usual, 1e-12):.2f} times the light of the others"
        elif kind == "PSF":
            down, right, _ = displacement(image, reference)
            reasons = []
            if max(abs(down), abs(right)) * factor >= MOVED_PX:
                reasons.append(f"is displaced by ({down * factor:.1f}, {right * factor:.1f}) px")
            if _shows_another(image, reference):
                reasons.append("shows another pattern")
            if reasons:
                rejected[name] = f"`{name}` {', or '.join(reasons)}"
    return rejected


def _shows_another(image: Image, reference: Image) -> bool:
    """Whether two frames differ by more than their noise, and are less alike than `MIN_LIKENESS`, in coarse pixels."""
    difference = image - reference
    coarse, pair = _binned(difference, _COARSE_SIDE), [_binned(each, _COARSE_SIDE) for each in (image, reference)]
    # Noise is white: neighbours differ by twice its variance, and averages of n pixels have 1 / n of it.
    noise = difference.diff(dim=-1).square().mean() / 2 * coarse.numel() / difference.numel()
    is_noise = bool((coarse - coarse.mean()).square().mean() <= NOISE_MARGIN * noise)
    return not is_noise and displacement(*pair).correlation < MIN_LIKENESS


def _unusual_levels(small: Sequence[Image], names: Sequence[str]) -> dict[str, str]:
    """Dark frames whose mean differs from the median of all by over 1 % of the full scale: some light came in."""
    levels = [float(image.mean()) for image in small]
    usual = float(np.median(levels))
    return {
        name: f"`{name}` has a mean of {level:.3f} of the full scale, the others {usual:.3f}"
        for name, level in zip(names, levels, strict=True)
        if abs(level - usual) > 0.01
    }


def _scales(frames: Sequence[Frame], format: FrameFormat, kind: Kind, dark: Image | None) -> list[float]:
    """Light of each frame relative to the median: 1 for dark frames, for single ones, and without a dark frame."""
    if kind == "dark" or dark is None or len(frames) < 3:
        return [1.0] * len(frames)
    levels = [float((format.normalise(frame) - dark).mean()) for frame in frames]
    usual = float(np.median(levels))
    return [level / usual for level in levels] if min(levels) > 0 else [1.0] * len(frames)


def _noise(
    frames: Sequence[Frame], format: FrameFormat, scales: Sequence[float], dark: Image | None
) -> NoiseModel | None:
    """Noise of one frame, from the first two that were kept; of about a million pixels."""
    if len(frames) < 2:
        return None
    stride = max(1, round((frames[0].size / 2**20) ** 0.5))
    thin = None if dark is None else dark[..., ::stride, ::stride]
    first, second = _linear([f[::stride, ::stride] for f in frames[:2]], format, scales[:2], thin)
    step = 0.0 if frames[0].dtype.kind == "f" else 1 / format.full_scale(frames[0])
    # Saturated pixels have no noise.
    good = ~_saturated([frame[::stride, ::stride] for frame in frames[:2]], format)[0, 0].expand_as(first)
    if int(good.sum()) < 1000:
        return None
    return fit_noise((first + second)[good] / 2, (first - second)[good] / 2**0.5, step=step)


def _saturated(frames: Sequence[Frame], format: FrameFormat) -> Tensor:
    """(1, 1, H, W), pixels that are saturated in more than half of the frames; in a single frame it is a cosmic hit."""
    counts = np.zeros(frames[0].shape[:2], np.int32)
    for frame in frames:
        count, maximum = format.saturated(frame)
        if count:
            counts += (frame >= maximum).any(-1)
    return torch.from_numpy(2 * counts > len(frames))[None, None]


def _clipped_mean(stack: Tensor, noise: NoiseModel | None) -> Image:
    """Mean (1, C, H, W) over the frames without outliers."""
    if noise is None:
        return stack.mean(0, keepdim=True)
    two = len(stack) == 2
    centre = stack.amin(0, keepdim=True) if two else stack.median(0, keepdim=True).values
    # The difference of two frames has twice the variance of one.
    limit = CLIP * (2 if two else 1) ** 0.5 * noise.variance(centre).sqrt()
    good = (stack - centre).abs() <= limit
    return (stack * good).sum(0, keepdim=True) / good.sum(0, keepdim=True)


def _listed(rejected: dict[str, str]) -> str:
    reasons = list(rejected.values())
    return "; ".join(reasons[:2]) + (f"; and {len(reasons) - 2} more" if len(reasons) > 2 else "")

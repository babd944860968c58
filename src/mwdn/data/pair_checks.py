"""Checks of a file of pairs before it is used: its shapes, its kind, and the camera that it belongs to."""

import math
from dataclasses import replace
from shlex import quote

from mwdn.calibration.psf import Calibration
from mwdn.calibration.psf_identity import other_psf
from mwdn.calibration.refinement import Refinement
from mwdn.data.pairs import PairFile
from mwdn.errors import ParameterError, ShapeError
from mwdn.types import Psf

REFINED = "refined"
"""Attribute of files whose measurements need no refinement of the camera: "align" has corrected them, "simulate" has
made them without its sensor field and stray light."""


DISPLAY_WHITE = "display_white"
"""Attribute of aligned files: the display's white as a fraction of the full scale. Measurements are divided by it."""


def missing_refinement(file: PairFile, refinement: Refinement) -> Refinement:
    """The refinement that a file's measurements still need, in their units: none if the file is `REFINED`."""
    if REFINED in file.attributes:
        return Refinement()
    white = display_white(file)
    return replace(refinement, stray_light=tuple(tuple(b / white for b in row) for row in refinement.stray_light))


def display_white(file: PairFile) -> float:
    """`DISPLAY_WHITE` of a file; 1 if it has none."""
    white = file.attributes.get(DISPLAY_WHITE)
    return white if isinstance(white, float) and 0 < white < math.inf else 1.0


def check_pairs(file: PairFile, psf: Psf) -> None:
    """Check that a file's pairs are measurements with their scenes, and fit the PSF.

    Raises:
        ParameterError: they are a session's raw frames.
        ShapeError: they have another size or other channels.
    """
    refuse_raw(file)
    (h, w, channels), (H, W), colours = file.measurement_shape, psf.shape[-2:], psf.shape[1]
    if (h, w) != (H, W):
        factor = H // h
        way_out = "Use the PSF of their camera, cropped and binned as they are: `crop`, `bin`, `psf_bin`."
        if factor > 1 and (h * factor, w * factor) == (H, W):
            # `psf_bin` alone would also crop a larger part of the PSF's file.
            way_out = (
                f"The PSF is {factor} times as large: multiply `bin`, which is 1 unless given, by {factor}. If the "
                "PSF has a bin of its own, `psf_bin`, multiply it, too."
            )
        raise ShapeError(f"`psf` ({H} x {W}) and the measurements of `{file.path}` ({h} x {w}) must match. {way_out}")
    if colours not in (1, channels):
        raise ShapeError(
            f"`psf` ({colours} channels) must be grey, or have the channels of the measurements of `{file.path}` "
            f"({channels}). Calibrate in the mode in which they were taken."
        )
    if message := other_scene_size(file):
        raise ShapeError(message)
    scene_channels = file.scene_shape[2]
    if scene_channels != channels:
        raise ShapeError(
            f"The scenes of `{file.path}` ({scene_channels} channels) must have the channels of its measurements "
            f"({channels}). Import them again: `mwdn import` averages the scenes' colours for a grey camera."
        )


def other_scene_size(file: PairFile) -> str | None:
    """Why pairs whose scenes have another size than the measurements cannot be used; ``None`` for others."""
    (h, w, _), (a, b, _) = file.measurement_shape, file.scene_shape
    if (a, b) == (h, w):
        return None
    return (
        f"The scenes of `{file.path}` ({a} x {b}) must have the size of its measurements ({h} x {w}). Import them "
        "again: with `--scene-place TOP LEFT` if they show a part of the frame; with `--crop` of the captures if "
        "these show more; with `--scene-size` only if both show the same."
    )


def refuse_raw(file: PairFile) -> None:
    """Raise a `ParameterError` if a file of `mwdn capture` was not aligned: raw frames, and pictures of the display."""
    if file.raw_bits is not None:
        raise ParameterError(
            f"`{file.path}` holds raw frames of {file.raw_bits} bits and the pictures as displayed, not yet pairs of "
            f"measurement and scene. Align them first: `mwdn align {quote(str(file.path))} --camera camera.toml -o "
            "aligned.h5`."
        )


def other_camera(file: PairFile, calibration: Calibration) -> str | None:
    """A warning if a file's pairs have another PSF than the calibration, otherwise ``None``."""
    own_hash = other_psf(calibration, file.attributes)
    return own_hash and (
        f"`{file.path}` holds pairs of the camera of PSF {own_hash}, but the PSF given is {calibration.psf_hash}. "
        "Expect blur, ghosts and low scores, unless both belong to one camera: another crop, bin or background of the "
        "same PSF file also gives another hash."
    )

"""EXIF orientation of a capture and of the PSF."""

from mwdn.diagnosis.verdict import Verdict
from mwdn.io.exif import TURNS

_BACK = TURNS | {6: TURNS[8], 8: TURNS[6]}
"""Inverse of each turn of `TURNS`; all but the two quarter turns are their own inverse."""


def exif_turn(capture: int, psf: int) -> Verdict:
    """Whether a capture and the PSF are to be shown with different turns.

    The tag moves no pixels, and frames are read as the sensor stored them, so different tags alone do no harm: the
    camera was held in another way. But many programs that save a picture turn its pixels and reset the tag to 1. Then
    one of the two frames is not as the sensor stored it.

    Args:
        capture: EXIF orientation of its file, from `mwdn.io.exif.orientation`; 1 is upright.
        psf: that of the PSF's file.

    Returns:
        ``doubt`` if they differ. Where one of them is 1, ``value`` is the turn that makes a PSF fit if the pixels of
        that file were turned.
    """
    if capture == psf:
        return Verdict("capture", "exif", "good", f"The capture and the PSF have EXIF orientation {psf}.")
    text = f"The capture has EXIF orientation {capture}, the PSF {psf}. Frames are not turned."
    if 1 not in (capture, psf):
        return Verdict("capture", "exif", "doubt", text)
    turn = _BACK[capture] if psf == 1 else TURNS[psf]
    text += " If the picture is wrong, a program has turned the pixels of the file with orientation 1."
    return Verdict("capture", "exif", "doubt", text, turn, f"--psf-orientation {turn}")


def settle_exif(verdicts: tuple[Verdict, ...]) -> tuple[Verdict, ...]:
    """Drop a doubt of `exif_turn` if the capture itself shows that the PSF is in the right orientation."""
    if not any(verdict.topic == "orientation" and verdict.state == "good" for verdict in verdicts):
        return verdicts
    return tuple(verdict for verdict in verdicts if verdict.topic != "exif" or verdict.state == "good")

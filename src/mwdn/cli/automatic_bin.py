"""The camera of `mwdn reconstruct` without ``--bin``: binned as far as that loses little."""

from collections.abc import Iterable
from contextlib import suppress
from dataclasses import replace

from mwdn.calibration import Calibration
from mwdn.cli.camera import CameraOptions
from mwdn.diagnosis.resolution import binning
from mwdn.errors import MwdnError
from mwdn.solvers import SOLVERS
from mwdn.weights.bundled import BUNDLED


def binned(
    calibration: Calibration, camera: CameraOptions, method: str, captures: Iterable[str]
) -> tuple[Calibration, list[str]] | None:
    """Bin a calibration as far as that loses little, for methods that work for any camera.

    Args:
        calibration: of this camera, with the ``bin`` of 1.
        camera: its options.
        method: name of a solver or a bundled network; for any other, which may be trained for one PSF, nothing is
            binned.
        captures: files. If the first that can be read has another size than the PSF, nothing is binned: the width of
            the PSF's lines in the capture's pixels is not known.

    Returns:
        The calibration, and sentences about it for the user; ``None`` if nothing is binned.
    """
    if method not in BUNDLED and method not in SOLVERS:
        return None
    verdict = binning(calibration)
    bin, psf_bin = int(verdict.value), camera.psf_format.psf_bin
    if bin == 1 or not _sizes_agree(calibration, captures):
        return None
    psf_format = replace(camera.psf_format, psf_bin=psf_bin and psf_bin * bin)
    options = replace(camera, frames=replace(camera.frames, bin=bin), psf_format=psf_format)
    reason = verdict.text[0].lower() + verdict.text[1:].rstrip(".")
    refuse = "`--bin 1` refuses; `--full-size` gives pictures at the frame's size"
    calibration, sentence = options.read()
    return calibration, [sentence, f"Binned by {bin}: {reason} ({refuse})."]


def _sizes_agree(calibration: Calibration, captures: Iterable[str]) -> bool:
    """Whether the first readable capture has the PSF's size; true if none can be read."""
    for capture in captures:
        with suppress(MwdnError):
            measurement = calibration.to_measurement(calibration.frames.read(capture))
            return measurement.shape[-2:] == calibration.psf.shape[-2:]
    return True

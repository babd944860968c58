"""`mwdn inspect`: measure the quality of a PSF."""

from dataclasses import replace
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter
from rich.markup import escape

from mwdn.calibration import Calibration
from mwdn.calibration.corrections import Corrections
from mwdn.calibration.places import psfs_elsewhere
from mwdn.calibration.report import inspect_psf
from mwdn.calibration.verdict import headline, verdict
from mwdn.cli.camera import CameraOptions
from mwdn.cli.folders import no_empty_folder
from mwdn.cli.terminal import Json, print_json, results, say
from mwdn.io.files import check_folder, refuse_foreign, refuse_overwrite, write_json

_STYLES = {"bad": "bold red", "weak": "yellow", "good": "green"}


@no_empty_folder
def inspect(
    camera: CameraOptions = CameraOptions(),
    *,
    json: Json = False,
    out: Annotated[Path, Parameter(name=["--out", "-o"])] = Path("results/inspect"),
) -> None:
    """Report the quality of a PSF: exposure, background, sharpness, spectrum, noise gain, resolution.

    Args:
        camera: the PSF and its format.
        json: print the report as JSON instead of text.
        out: folder for the page and the JSON file, which are named after the PSF's file, or the camera file.
    """
    # matplotlib takes a second to load, and no other command needs it.
    from mwdn.calibration.report_page import write_page

    psf = camera.psf_file
    # The PSF that `mwdn calibrate FRAMES` writes has the camera file's name and a hash.
    is_part = camera.camera is not None and psf.stem.startswith(f"{camera.camera.stem}-psf-")
    page = out / f"{camera.camera.stem if camera.camera and is_part else psf.stem}.png"
    json_file = page.with_suffix(".json")
    for output in (page, json_file):
        refuse_overwrite(output, *camera.files)
    refuse_foreign(out, (json_file.name, page.name), b'"headline"')
    calibration = load_at_psf_resolution(camera)
    check_folder(out)
    depth, off_axis = psfs_elsewhere(calibration)
    report = inspect_psf(calibration, calibration.frames.read(psf), depth=depth, off_axis=off_axis)
    findings = verdict(report)
    content = {
        "file": str(psf),
        "headline": headline(report),
        "verdict": [finding._asdict() for finding in findings],
        **report.content(),
    }
    write_json(json_file, content)  # first: it marks both files as of this command
    write_page(page, report, calibration.psf, psf.name)
    if json:
        print_json(content)
        return
    results.print(f"[bold]{escape(headline(report))}[/]", highlight=False, soft_wrap=True)
    for weight, text in findings:
        results.print(f"[{_STYLES[weight]}]{weight:4}[/] {escape(text)}", highlight=False, soft_wrap=True)
    say(f"Look at {page}")


def load_at_psf_resolution(camera: CameraOptions, corrections: Corrections = Corrections()) -> Calibration:
    """The calibration for frames at the PSF's resolution; frames of captures of another one do not correct it."""
    psf_bin = camera.psf_format.psf_bin
    if psf_bin is None or psf_bin == camera.frames.bin:
        return camera.load(corrections)
    psf_format = replace(camera.psf_format, psf_bin=None)
    changed = replace(camera, frames=camera.frames.with_bin(psf_bin), psf_format=psf_format, dark=None)
    return changed.load(corrections, psf_done=True)

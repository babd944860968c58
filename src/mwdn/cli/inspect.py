"""`mwdn inspect`: measure the quality of a PSF."""

import json as format_json
from dataclasses import replace
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter
from rich.markup import escape

from mwdn.calibration.report import inspect_psf
from mwdn.calibration.verdict import headline, verdict
from mwdn.cli.camera import CameraOptions, console
from mwdn.io.files import check_folder, refuse_overwrite, write_json

_STYLES = {"bad": "bold red", "mind": "yellow", "good": "green"}


def inspect(
    camera: CameraOptions,
    *,
    json: Annotated[bool, Parameter(negative=())] = False,
    out: Annotated[Path, Parameter(name=["--out", "-o"])] = Path("results/inspect"),
) -> None:
    """Report the quality of a PSF: exposure, background, sharpness, spectrum, noise gain, resolution.

    Args:
        camera: the PSF and its format.
        json: print the report as JSON instead of text.
        out: folder for the page and the JSON file, which are named after the PSF's file.
    """
    # matplotlib takes a second to load, and no other command needs it.
    from mwdn.calibration.report_page import write_page

    page = out / f"{camera.psf.stem}.png"
    json_file = page.with_suffix(".json")
    for output in (page, json_file):
        refuse_overwrite(output, camera.psf, camera.dark)
    calibration = at_psf_resolution(camera).load()
    check_folder(out)
    report = inspect_psf(calibration, camera.frames.read(camera.psf))
    findings = verdict(report)
    content = {
        "file": str(camera.psf),
        "headline": headline(report),
        "verdict": [finding._asdict() for finding in findings],
        **report.content(),
    }
    write_page(page, report, calibration.psf, camera.psf.name)
    write_json(json_file, content)
    if json:
        console.print(format_json.dumps(content, indent=2), highlight=False, markup=False, soft_wrap=True)
        return
    console.print(f"[bold]{escape(headline(report))}[/]", highlight=False, soft_wrap=True)
    for weight, text in findings:
        console.print(f"[{_STYLES[weight]}]{weight:4}[/] {escape(text)}", highlight=False, soft_wrap=True)
    console.print(f"Look at {page}", highlight=False, markup=False, soft_wrap=True)


def at_psf_resolution(camera: CameraOptions) -> CameraOptions:
    """The options for frames at the PSF's resolution, if the captures have another; their dark frame is left out."""
    if camera.psf_bin is None or camera.psf_bin == camera.frames.bin:
        return camera
    return replace(camera, frames=camera.frames.with_bin(camera.psf_bin), psf_bin=None, dark=None)

"""The report of a PSF for a client."""

from typing import Any

from mwdn.calibration import Calibration
from mwdn.calibration.report import inspect_psf
from mwdn.calibration.verdict import headline, verdict


def psf_report(calibration: Calibration) -> dict[str, Any]:
    """What `mwdn inspect` says, without the levels of the file."""
    report = inspect_psf(calibration)
    findings = [finding._asdict() for finding in verdict(report)]
    return {"headline": headline(report), "verdict": findings, **report.content()}

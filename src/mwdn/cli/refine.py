"""`mwdn calibrate --pairs`: refine a camera file with known pictures."""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean
from typing import TYPE_CHECKING, Any

from mwdn.calibration import Calibration
from mwdn.calibration.camera_file import read_camera, write_camera
from mwdn.calibration.pair_model import Terms
from mwdn.calibration.refinement import TERMS, Refinement
from mwdn.calibration.scene_encoding import scene_gamma, unexplained_by_gamma
from mwdn.calibration.term_selection import MIN_PAIRS, Selection, Step, left_out, select_terms
from mwdn.cli.progress import show_progress
from mwdn.cli.terminal import counted, say, warn
from mwdn.errors import ParameterError
from mwdn.io.files import write_json
from mwdn.types import Measurement, Scene

if TYPE_CHECKING:
    from mwdn.data.pairs import PairFile

METHOD = "pyramid"
"""Solver that judges the pictures: it takes seconds, and has learned nothing that could hide an error."""

NO_TERMS: dict[str, Any] = {"psf_gain": (), "envelope_shift": None, "sensor_field": (), "stray_light": ()}


@dataclass(frozen=True)
class Pictures:
    """Pictures of pairs that a refinement was not fitted to, after the best gain and offset.

    Args:
        step: last term of the refinement.
        psnr: of each pair, in dB.
        ssim: of each pair.
        lpips: of each pair; NaN without its weights.
    """

    step: Step
    psnr: tuple[float, ...]
    ssim: tuple[float, ...]
    lpips: tuple[float, ...]

    @property
    def has_lpips(self) -> bool:
        """Whether the weights of LPIPS were there."""
        return not math.isnan(self.lpips[0])


def check_pair_file(pairs: Path) -> None:
    """Raise an `MwdnError` unless this is a file of enough pairs, none of them black or with NaN."""
    from mwdn.data.pair_checks import refuse_raw
    from mwdn.data.pair_writer import PAIR_PARTS
    from mwdn.data.pairs import PairFile, refuse_non_finite

    with PairFile(pairs) as file:
        refuse_raw(file)
        if len(file) < MIN_PAIRS:
            raise ParameterError(f"`pairs` ({len(file)}) must be {MIN_PAIRS} or more: each in turn is left out.")
        for number in range(len(file)):
            pair = file[number]
            refuse_non_finite(pair, number)
            for name, picture in zip(PAIR_PARTS, pair, strict=True):
                if picture.amax() <= 0:
                    raise ParameterError(f"The {name} of pair {number}, counted from 0, is black. Leave this pair out.")


def refine(camera: Path, pairs: Path, report: Path) -> None:
    """Find the terms of a camera file's refinement and write them to it.

    Args:
        camera: the camera file.
        pairs: captured by this camera.
        report: numbers of the refinement, ending in .json; a page (.png) is written beside it.

    Raises:
        MwdnError: the pairs do not fit the camera, or a file cannot be written. The camera file stays as it was.
    """
    from mwdn.calibration.refinement_page import write_refinement_page
    from mwdn.data.pair_checks import REFINED, check_pairs, display_white, other_camera
    from mwdn.data.pairs import PairFile

    calibration = Calibration.load(camera, **NO_TERMS, white_balance=None)
    with PairFile(pairs) as file:
        check_pairs(file, calibration.psf)
        if file.measurement_shape[2] != calibration.psf.shape[1]:
            raise ParameterError(
                f"The pairs of `{pairs}` are in colour, but the PSF is grey. Make grey pairs, with `grey`, or take a "
                "picture of the PSF in colour."
            )
        warn(other_camera(file, calibration))
        white = display_white(file)
        if file.attributes.get(REFINED) == "align":
            raise ParameterError(
                f"`{pairs}` was aligned with a refined camera, whose terms would be lost. Align the session again with "
                "the camera file as it was before its refinement."
            )
        encoding = unexplained_by_gamma(calibration.psf, lambda: _all(file))
        say(*_encoding_lines(encoding))
        selection = select_terms(calibration.psf, lambda: _all(file), report=lambda step: say(_sentence(step)))
        pictures = _pictures(calibration, selection, file)
    best = max(pictures, key=lambda each: fmean(each.psnr))
    refinement = selection.fit(best.step.terms).refinement()
    values = {**read_camera(camera), **NO_TERMS}
    values |= {name: getattr(refinement, name) or None for name in TERMS}
    if refinement.stray_light:  # `mwdn align` has divided the measurements by the display's white
        values["stray_light"] = tuple(tuple(white * value for value in row) for row in refinement.stray_light)
    values.pop("psf_sha256", None)
    write_camera(camera, values)
    content = _content(selection, pictures, best, {name: values[name] for name in TERMS})
    write_json(report, content | {"scene_gamma": [{"gamma": g, "unexplained": part} for g, part in encoding.items()]})
    write_refinement_page(report.with_suffix(".png"), calibration.psf, refinement, _lines(pictures, best))
    say(
        *_lines(pictures, best),
        *_new_hash(calibration, calibration.refined(refinement)),
        f"Look at {report.with_suffix('.png')}; all numbers are in {report}",
    )


def _encoding_lines(unexplained: dict[float, tuple[float, ...]]) -> list[str]:
    """A sentence if the scenes seem to be encoded."""
    gamma = scene_gamma(unexplained)
    if gamma is None:
        return []
    linear, decoded = fmean(unexplained[1.0]), fmean(unexplained[gamma])
    return [
        f"The scenes seem to be encoded: {linear:.1%} of the measurements are unexplained, {decoded:.1%} if the scenes "
        f"are decoded with a gamma of {gamma:g}. To decode them: mwdn import --scene-gamma {gamma:g}"
    ]


def _new_hash(before: Calibration, after: Calibration) -> list[str]:
    """A sentence if the refinement has changed the PSF."""
    if before.psf_hash == after.psf_hash:
        return []
    return [f"PSF {after.psf_hash} with its gain; pairs and weights of {before.psf_hash} are still its own."]


def _pictures(calibration: Calibration, selection: Selection, file: "PairFile") -> list[Pictures]:
    """Reconstruct each pair with the refinement of the others, for each of the terms that were taken in turn."""
    from mwdn.evaluation.metrics import Perceptual, Protocol, measure
    from mwdn.inference.reconstructor import Reconstructor

    steps = [step for step in selection.taken if step.term != "field_dependence"]
    perceptual, results = Perceptual.load(), []
    with show_progress() as progress:
        progress.start("Reconstructing left-out pairs", len(steps) * len(file))
        for number, step in enumerate(steps):
            refinements: dict[int, Refinement] = {}
            for part in left_out(len(file)):
                refinements |= dict.fromkeys(part, selection.fit(step.terms, without=part).refinement())
            scores = []
            for pair, (b, v) in enumerate(_all(file)):
                reconstruct = Reconstructor(METHOD, calibration.refined(refinements[pair]))
                scene = reconstruct(refinements[pair].measurement(b))
                scores.append(measure(scene, v, Protocol(), variant="best-gain", perceptual=perceptual))
                progress.update(number * len(file) + pair + 1, step.term or "as calibrated")
            names = ("psnr", "ssim", "lpips")
            results.append(Pictures(step, *(tuple(round(float(s[name]), 4) for s in scores) for name in names)))
    return results


def _all(file: "PairFile") -> Iterator[tuple[Measurement, Scene]]:
    for pair in range(len(file)):
        measurement, scene = file[pair]
        yield measurement[None], scene[None]


def _sentence(step: Step) -> str:
    what = f"{_name(step)} of order {step.order}" if step.term else "The calibration as it is"
    taken = " (taken)" if step.taken and step.term else ""
    return f"{what}: leaves {step.mean:.1%} of left-out measurements unexplained{taken}"


def _name(step: Step) -> str:
    return step.term.replace("_", " ").replace("psf", "PSF")


def _lines(pictures: list[Pictures], best: Pictures) -> list[str]:
    lines = []
    for each in pictures:
        name = f"with {_name(each.step)}" if each.step.term else "as calibrated"
        kept = " (kept up to here)" if each is best else ""
        lpips = f", LPIPS {fmean(each.lpips):.3f}" if each.has_lpips else ""
        lines.append(f"{counted(len(each.psnr), 'left-out pair')} {name}: {fmean(each.psnr):.2f} dB{lpips}{kept}")
    return lines


def _content(selection: Selection, pictures: list[Pictures], best: Pictures, terms: dict[str, Any]) -> dict[str, Any]:
    tried = [
        {"term": step.term, "order": step.order, "unexplained": step.unexplained, "taken": step.taken}
        for step in selection.steps
    ]
    scored = [
        {
            "terms": _orders(each.step.terms),
            "psnr": each.psnr,
            "ssim": each.ssim,
            "lpips": each.lpips if each.has_lpips else None,
        }
        for each in pictures
    ]
    return {"method": METHOD, "tried": tried, "pictures": scored, "kept": _orders(best.step.terms), **terms}


def _orders(terms: Terms) -> dict[str, int]:
    return {name: order for name, order in vars(terms).items() if order}

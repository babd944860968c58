"""Detectors against captures whose state is known: right, wrong, or an honest "cannot tell".

    python benchmarks/diagnosis.py ../shared/data [--count 200] [--seed 28] [--only gamma mosaic]

First the real captures (`known_captures.py`), then simulated variants (`variants.py`), then for each property the share
of right, wrong and unknown answers. Beside the results, a file `.md` has these shares and a table of the real captures.
A run that was interrupted goes on. Thresholds are chosen with other seeds than 28.

A detector is right if its `Verdict.value` is the truth, or lists it: "rggb|bggr". An unknown state is neither right nor
wrong.
"""

import argparse
import json
import time
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

import numpy as np
import torch

from known_captures import Variant, real_captures
from mwdn import Calibration
from mwdn.diagnosis import Verdict
from mwdn.diagnosis.captures import ambient_light, noise
from mwdn.diagnosis.encoding import gamma
from mwdn.diagnosis.mosaic import mosaic
from mwdn.diagnosis.orientation import fit_orientations
from mwdn.diagnosis.psf_encoding import psf_gamma
from mwdn.diagnosis.sizes import fitting_size
from mwdn.io.files import atomic
from variants import Sources, draw

Detector = Callable[[Variant, Calibration], Verdict]


def fitted_bin(frame: np.ndarray, calibration: Calibration) -> Verdict:
    """Of captures with the PSF's size the bin is 1."""
    measurement = calibration.to_measurement(frame)
    if measurement.shape[-2:] == calibration.psf.shape[-2:]:
        return Verdict("psf", "size", "good", "PSF and capture have one size.", "1")
    return fitting_size(measurement, calibration)


def gamma_of_psf(variant: Variant, calibration: Calibration) -> Verdict:
    """With the capture's gamma as it is detected. The type of the PSF's file is not used."""
    capture = gamma(variant.frame, calibration, for_viewing=variant.is_jpeg)
    return psf_gamma(variant.frame, calibration, capture.value)


DETECTORS: dict[str, Detector] = {
    "gamma": lambda variant, calibration: gamma(variant.frame, calibration, for_viewing=variant.is_jpeg),
    "psf-gamma": gamma_of_psf,
    "mosaic": lambda variant, calibration: mosaic(variant.frame, calibration),
    "orientation": lambda variant, calibration: (
        fit_orientations(calibration.correct(variant.frame), calibration.psf).verdict
    ),
    "bin": lambda variant, calibration: fitted_bin(variant.frame, calibration),
    "noise": lambda variant, calibration: noise(variant.frame, calibration),
    "ambient": lambda variant, calibration: ambient_light(variant.frame, calibration),
}
"""A detector for each property of `Variant.truth`."""


def judge(variant: Variant, name: str) -> dict[str, object]:
    """One row: what the detector of this property says."""
    calibration, start = variant.calibration(name), time.perf_counter()
    verdict = DETECTORS[name](variant, calibration)
    seconds, candidates = time.perf_counter() - start, verdict.value.split("|")
    is_right = variant.truth[name] in candidates
    return {
        "capture": variant.name,
        "property": name,
        "truth": variant.truth[name],
        "detected": verdict.value,
        "state": verdict.state,
        "answer": "unknown" if verdict.state == "unknown" else "right" if is_right else "wrong",
        "among": len(candidates),
        "text": verdict.text,
        "seconds": round(seconds, 3),
    }


def judge_all(variants: Iterable[Variant], only: list[str], progress: Path) -> Iterator[dict[str, object]]:
    """A row for each property that has a detector; those in the file of progress are not judged again."""
    lines = progress.read_text().splitlines() if progress.is_file() else []
    done = {(row["capture"], row["property"]): row for row in map(json.loads, lines)}
    with progress.open("a") as file:
        for variant in variants:
            for name in (name for name in DETECTORS if name in variant.truth and (not only or name in only)):
                row = done.get((variant.name, name)) or judge(variant, name)
                if (variant.name, name) not in done:
                    print(json.dumps(row), file=file, flush=True)
                if row["answer"] == "wrong":
                    print(*(f"{key}: {row[key]}" for key in ("capture", "property", "truth", "text")), variant.drawn)
                yield row


def shares(rows: list[dict[str, object]]) -> Iterator[str]:
    """A table: for each property the share of right, wrong and unknown answers."""
    yield "| property | captures | right | of these with several candidates | wrong | cannot tell | slowest |"
    yield "| --- | --- | --- | --- | --- | --- | --- |"
    for name in dict.fromkeys(row["property"] for row in rows):
        those = [row for row in rows if row["property"] == name]
        several = sum(row["answer"] == "right" and row["among"] > 1 for row in those)
        right, wrong, unknown = (sum(row["answer"] == a for row in those) for a in ("right", "wrong", "unknown"))
        parts = " | ".join(f"{100 * count / len(those):.1f} %" for count in (right, several, wrong, unknown))
        yield f"| {name} | {len(those)} | {parts} | {max(row['seconds'] for row in those):.2f} s |"


def table(rows: list[dict[str, object]]) -> Iterator[str]:
    """A table of captures: for each property the truth, or how the answer differs from it."""
    names = list(dict.fromkeys(row["property"] for row in rows))
    yield f"| capture, PSF | {' | '.join(names)} |"
    yield "| --- " * (len(names) + 1) + "|"
    for capture in dict.fromkeys(row["capture"] for row in rows):
        cells = {row["property"]: _cell(row) for row in rows if row["capture"] == capture}
        yield f"| {capture} | {' | '.join(cells.get(name, '') for name in names)} |"


def _cell(row: dict[str, object]) -> str:
    truth, detected = (str(row[key]).replace("|", " or ") or "none" for key in ("truth", "detected"))
    if row["answer"] == "unknown":
        return f"{truth}: cannot tell"
    return truth if truth == detected else f"{truth}: {detected}" + " (wrong)" * (row["answer"] == "wrong")


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("data", type=Path)
    parser.add_argument("--count", type=int, default=200)
    parser.add_argument("--seed", type=int, default=28)
    parser.add_argument("--only", nargs="*", default=[], help="properties")
    parser.add_argument("--out", type=Path, default=Path("benchmarks/results/diagnosis.json"))
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    progress = arguments.out.with_suffix(f".seed-{arguments.seed}.progress")
    real = list(judge_all(real_captures(arguments.data), arguments.only, progress))
    sources = Sources(arguments.data)
    draws = (draw(sources, arguments.seed, number) for number in range(arguments.count))
    simulated = list(judge_all(draws, arguments.only, progress))
    titles = "Real captures", f"{arguments.count} simulated captures, seed {arguments.seed}"
    times = "Times: on one thread, of a machine that may have had other work."
    report = ["# Detectors of `mwdn.diagnosis`", "", f"Written by `benchmarks/diagnosis.py`. {times}"]
    for title, rows in zip(titles, (real, simulated), strict=True):
        report += ["", f"## {title}", "", *shares(rows)]
    print(*report, sep="\n")
    report += ["", "## Each real capture", "", "What is true, and after the colon what was detected, if it differs."]
    report += ["", *table(real)]
    lines = [",\n".join(json.dumps(row) for row in rows) for rows in (real, simulated)]
    results = '{{"seed": {}, "real": [\n{}],\n"variants": [\n{}]}}\n'.format(arguments.seed, *lines)
    for out, text in ((arguments.out, results), (arguments.out.with_suffix(".md"), "\n".join(report) + "\n")):
        with atomic(out) as temporary:
            temporary.write_text(text)
    progress.unlink()


if __name__ == "__main__":
    main()

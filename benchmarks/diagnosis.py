"""Detectors against captures whose state is known: right, wrong, or an honest "cannot tell".

    python benchmarks/diagnosis.py ../shared/data [--count 200] [--seed 28] [--only gamma mosaic]

First the real captures (a table: capture, true state, detected), then simulated variants (`benchmarks/variants.py`),
then for each property the share of right, wrong and unknown answers. Thresholds are chosen with other seeds than 28.

A detector is right if its `Verdict.value` is the truth, or lists it: "rggb|bggr". An unknown state is neither right nor
wrong.
"""

import argparse
import json
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import torch

from mwdn import Calibration
from mwdn.diagnosis import Verdict
from mwdn.diagnosis.captures import ambient_light, noise
from mwdn.diagnosis.encoding import gamma
from mwdn.diagnosis.mosaic import mosaic
from mwdn.diagnosis.orientation import fit_orientations
from mwdn.diagnosis.sizes import fitting_size
from mwdn.io.files import atomic
from variants import Sources, Variant, draw, real_captures

Detector = Callable[[np.ndarray, Calibration], Verdict]


def fitted_bin(frame: np.ndarray, calibration: Calibration) -> Verdict:
    """Of captures with the PSF's size the bin is 1."""
    measurement = calibration.to_measurement(frame)
    if measurement.shape[-2:] == calibration.psf.shape[-2:]:
        return Verdict("psf", "size", "good", "PSF and capture have one size.", "1")
    return fitting_size(measurement, calibration)


DETECTORS: dict[str, Detector] = {
    "gamma": gamma,
    "mosaic": mosaic,
    "orientation": lambda frame, calibration: fit_orientations(calibration.correct(frame), calibration.psf).verdict,
    "bin": fitted_bin,
    "noise": noise,
    "ambient": ambient_light,
}
"""A detector for each property of `Variant.truth`: called with the capture's frame and the calibration."""


def judge(variant: Variant, only: list[str]) -> Iterator[dict[str, object]]:
    """One row for each property of the variant that has a detector."""
    for name, detect in DETECTORS.items():
        if name not in variant.truth or (only and name not in only):
            continue
        calibration, start = variant.calibration(name), time.perf_counter()
        verdict = detect(variant.frame, calibration)
        truth = variant.truth[name]
        candidates = verdict.value.split("|")
        answer = "unknown" if verdict.state == "unknown" else "right" if truth in candidates else "wrong"
        yield {
            "capture": variant.name,
            "property": name,
            "truth": truth,
            "detected": verdict.value,
            "state": verdict.state,
            "answer": answer,
            "among": len(candidates),
            "text": verdict.text,
            "seconds": round(time.perf_counter() - start, 3),
            "drawn": variant.drawn,
        }


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


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("data", type=Path)
    parser.add_argument("--count", type=int, default=200)
    parser.add_argument("--seed", type=int, default=28)
    parser.add_argument("--only", nargs="*", default=[], help="properties")
    parser.add_argument("--out", type=Path, default=Path("benchmarks/results/diagnosis.json"))
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    print("| capture | property | truth | detected | state |\n| --- | --- | --- | --- | --- |")
    real = []
    for capture in real_captures(arguments.data):
        for row in judge(capture, arguments.only):
            real.append(row)
            print("|", " | ".join(str(row[key]) for key in ("capture", "property", "truth", "detected", "state")), "|")
    sources = Sources(arguments.data)
    simulated = []
    for number in range(arguments.count):
        for row in judge(draw(sources, arguments.seed, number), arguments.only):
            simulated.append(row)
            if row["answer"] == "wrong":
                print(*(f"{key}: {row[key]}" for key in ("capture", "property", "truth", "text", "drawn")), sep=", ")
    for title, rows in (("Real captures", real), (f"{arguments.count} variants", simulated)):
        print("", f"{title}:", "", *shares(rows), sep="\n")
    with atomic(arguments.out) as temporary:
        record = {"seed": arguments.seed, "real": real, "variants": simulated}
        temporary.write_text(json.dumps(record, indent=1) + "\n")


if __name__ == "__main__":
    main()

"""One method of a benchmark on one data set: its numbers and its first pictures, kept as they are found."""

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from mwdn import solvers
from mwdn.benchmark.recipe import Method
from mwdn.benchmark.sets import Opened, file_hash
from mwdn.data.captures import find_captures, read_captures
from mwdn.evaluation import First, Perceptual, Scores, evaluate
from mwdn.inference.reconstructor import Reconstructor
from mwdn.io.files import atomic_write, save_text
from mwdn.version import __version__

TIMED = 3
"""Pictures for the time on the CPU, where the scores come from a GPU."""

CAPTURES = 6
"""Real captures that are shown, at most."""


@dataclass(frozen=True, eq=False)
class Scored:
    """What was found.

    Args:
        scores: under the protocol of the data set.
        cpu: time and memory on the CPU, where the scores come from a GPU.
        missing: metrics that could not be measured, and why.
        pictures: (N, C, H, W), reconstructions of the first test pictures.
        captures: (N, C, H, W), reconstructions of the real captures, if there are any.
    """

    scores: Scores
    cpu: Scores | None
    missing: dict[str, str]
    pictures: Tensor
    captures: Tensor


def bind(method: Method, checkpoint: Path | None, opened: Opened, device: torch.device | str) -> Reconstructor:
    """A method that knows the calibration of a data set.

    Args:
        method: which.
        checkpoint: of a network.
        opened: the data set.
        device: where to compute.
    """
    if checkpoint is not None:
        return Reconstructor(checkpoint, opened.calibration, device=device)
    return Reconstructor(solvers.build(method.name, **method.options), opened.calibration, device=device)


def identity(method: Method, checkpoint: Path | None, opened: Opened) -> dict[str, Any]:
    """What scores depend on: they are kept as long as it is the same."""
    weights = file_hash(checkpoint) if checkpoint is not None else None
    part = opened.data.part()
    scored = {"pairs": len(opened.test), "data": opened.identity, "protocol": part.name, "variant": part.variant}
    kept = {"method": [method.name, method.options], "weights": weights, "version": __version__, **scored}
    return json.loads(json.dumps(kept))


def score(
    method: Method,
    checkpoint: Path | None,
    opened: Opened,
    folder: Path,
    *,
    device: torch.device,
    perceptual: Callable[[], Perceptual],
    shown: int,
) -> Scored:
    """Score a method, unless its scores are there.

    Args:
        method: which.
        checkpoint: of a network.
        opened: the data set.
        folder: for the scores of this data set.
        device: where to compute.
        perceptual: loads the networks of the metrics, when they are needed.
        shown: how many reconstructions to keep.

    Raises:
        MwdnError: the method cannot be used, or does not fit the pairs.
    """
    path = folder / f"{method.label}.json"
    wanted = {**identity(method, checkpoint, opened), "device": device.type, "shown": shown, **_captured(opened)}
    kept = read_kept(path, wanted)
    if kept is None:
        kept = _measure(bind(method, checkpoint, opened, device), opened, path, perceptual(), shown)
        save_text(path, json.dumps({"identity": wanted, **kept}, indent=1))  # last: what it says is there, is
    cpu = Scores.read(kept["cpu"]) if kept["cpu"] else None
    pictures = {name: torch.from_numpy(np.load(_pictures(path, name))) for name in ("pictures", "captures")}
    return Scored(Scores.read(kept["scores"]), cpu, kept["missing"], **pictures)


def read_kept(path: Path, wanted: dict[str, Any]) -> dict[str, Any] | None:
    """A file's content, if it is of this identity."""
    if not path.is_file():
        return None
    content = json.loads(path.read_text(encoding="utf-8"))
    return content if content["identity"] == wanted else None


def _measure(bound: Reconstructor, opened: Opened, path: Path, perceptual: Perceptual, shown: int) -> dict[str, Any]:
    methods = {"it": bound}
    report = evaluate(methods, opened.test, opened.data.part(), perceptual=perceptual, shown=shown)
    cpu = None
    if bound.device.type != "cpu":
        there = Reconstructor(bound.method, opened.calibration, device="cpu")
        timed = evaluate({"it": there}, First(opened.test, TIMED), opened.data.part(), perceptual=Perceptual.none())
        cpu = timed.methods["it"].content()
    size = opened.calibration.size
    captures = _captures(opened)
    found = [bound(one[None]) for one in captures] if captures is not None else [torch.zeros(0, 3, *size)]
    for name, pictures in (("pictures", [row[2] for row in report.rows]), ("captures", found)):
        with atomic_write(_pictures(path, name)) as temporary:
            np.save(temporary, torch.cat(pictures).numpy())
    return {"scores": report.methods["it"].content(), "cpu": cpu, "missing": report.missing}


def _captured(opened: Opened) -> dict[str, Any]:
    return {"captures": list(opened.data.captures)}


def _captures(opened: Opened) -> Tensor | None:
    """Real captures of the data set, at most `CAPTURES`."""
    if not opened.data.captures:
        return None
    return read_captures(find_captures(opened.data.captures)[:CAPTURES], opened.calibration)


def measurements(opened: Opened) -> Tensor:
    """The real captures, (N, C, H, W); none where there are none."""
    captures = _captures(opened)
    return torch.zeros(0, 3, *opened.calibration.size) if captures is None else captures


def _pictures(path: Path, name: str) -> Path:
    return path.with_name(f"{path.stem}-{name}.npy")

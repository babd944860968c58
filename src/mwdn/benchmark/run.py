"""A benchmark from its recipe to its page; begun again, it goes on where it was interrupted."""

import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path

import torch
from torch import Tensor

from mwdn.benchmark.exports import csv_text, json_content
from mwdn.benchmark.locks import held, shared
from mwdn.benchmark.pages import write_html, write_markdown
from mwdn.benchmark.recipe import Benchmark, Method
from mwdn.benchmark.results import Found
from mwdn.benchmark.robustness import Sweep, pairs_at, sweep
from mwdn.benchmark.scoring import Scored, bind, identity, score
from mwdn.benchmark.sections import sections
from mwdn.benchmark.sets import Opened, open_set
from mwdn.benchmark.training import train
from mwdn.data.photographs import Photographs
from mwdn.evaluation import Perceptual
from mwdn.evaluation.alexnet import SMALLEST
from mwdn.io.files import save_text
from mwdn.runtime.distributed import local_device
from mwdn.training.trainer import Report

PAGE = "index.html"


@dataclass(frozen=True)
class Watch:
    """Who is told of the progress.

    Args:
        stage: of what begins, and of how many parts it has; 0 if nobody knows.
        done: how many are done, and a note.
    """

    stage: Callable[[str, int], None] = lambda title, parts: None
    done: Callable[[int, str], None] = lambda parts, note: None

    def track(self, title: str, rows: list[range]) -> Iterator[range]:
        """Pass rows through, and tell of each."""
        self.stage(title, len(rows))
        for number, row in enumerate(rows):
            yield row
            self.done(number + 1, "")


def run(
    benchmark: Benchmark, out: Path, *, device: str | None = None, command: str = "", watch: Watch = Watch()
) -> Found:
    """Make data, train, score, sweep, and write the page.

    What is finished stays: files of pairs, trained networks, scores. A network whose training was interrupted goes on
    from its last saved state. Several processes with one ``out`` share the networks, see `mwdn.benchmark.locks`.

    Args:
        benchmark: the recipe.
        out: folder: ``index.html``, ``benchmark.md``, ``benchmark.json``, ``benchmark.csv``, and in folders ``data``,
            ``runs``, ``scores``, ``robustness`` what they are made of.
        device: where to compute; a GPU if there is one unless given.
        command: that was given, for the page.
        watch: told of the progress.

    Raises:
        MwdnError: a file cannot be read, a method does not fit, training diverges, or ``out`` holds another benchmark.
    """
    place = local_device(device)
    with held(out, "data"):
        opened = {n: open_set(n, data, out / "data", place, watch.track) for n, data in benchmark.data.items()}
    _train_all(benchmark, opened, out, place, watch)
    with held(out, "scores"):  # by one process, while the others wait: times are measured
        scored = _score_all(benchmark, opened, out, place, watch)
    sweeps = _sweep(benchmark, opened, out, place, watch)
    found = Found(benchmark, opened, scored, sweeps, out / "runs", place, command)
    with held(out, "page"):
        write(found, out)
    return found


def write(found: Found, out: Path) -> None:
    """Write the page in its four forms.

    Raises:
        ImageError: the disk refuses.
    """
    title = found.benchmark.title
    parts = sections(found)
    write_html(out / PAGE, title, parts)
    write_markdown(out / "benchmark.md", title, parts)
    save_text(out / "benchmark.json", json.dumps(json_content(found), indent=1) + "\n")
    save_text(out / "benchmark.csv", csv_text(found))


def _train_all(benchmark: Benchmark, opened: dict[str, Opened], out: Path, place: torch.device, watch: Watch) -> None:
    runs = {
        f"runs/{name}/{method.label}": (name, method)
        for name, each in opened.items()
        if each.training is not None
        for method in benchmark.methods
        if method.learned
    }
    for part in shared(out, list(runs)):
        name, method = runs[part]
        watch.stage(f"{name}: training {method.label}", benchmark.schedule.steps)
        train(method, opened[name], benchmark, out / part, device=place, show=partial(_told, watch))


def _told(watch: Watch, report: Report) -> None:
    psnr = f", {report.validation.psnr:.2f} dB" if report.validation else ""
    watch.done(report.step, f"loss {report.loss:.4f}{psnr}")


def _same(perceptual: Perceptual) -> Perceptual:
    return perceptual


def _checkpoint(method: Method, opened: Opened, out: Path) -> Path | None:
    if not method.learned:
        return None
    return out / "runs" / (opened.data.trained_on or opened.name) / method.label / "best.safetensors"


def _score_all(
    benchmark: Benchmark, opened: dict[str, Opened], out: Path, place: torch.device, watch: Watch
) -> dict[str, dict[str, Scored]]:
    @cache
    def loaded() -> Perceptual:
        return Perceptual.load(benchmark.alexnet or None, benchmark.heads or None)

    found: dict[str, dict[str, Scored]] = {}
    for name, each in opened.items():
        found[name] = {}
        sides = each.data.part().crop(each.calibration.psf).shape[-2:]
        small = Perceptual.none(f"the part {each.data.part().name} has less than {SMALLEST} pixels a side, for AlexNet")
        perceptual = loaded if min(sides) >= SMALLEST else partial(_same, small)
        for number, method in enumerate(benchmark.methods):
            watch.stage(f"{name}: scoring {method.label}", len(benchmark.methods))
            watch.done(number, "")
            found[name][method.label] = score(
                method,
                _checkpoint(method, each, out),
                each,
                out / "scores" / name,
                device=place,
                perceptual=perceptual,
                shown=benchmark.shown,
            )
    return found


def _sweep(
    benchmark: Benchmark, opened: dict[str, Opened], out: Path, place: torch.device, watch: Watch
) -> dict[str, Sweep]:
    wanted = benchmark.robustness
    if not (wanted.data and wanted.sizes):
        return {}
    each, methods, sweeps = opened[wanted.data], {m.label: m for m in benchmark.methods}, {}

    @cache
    def photographs() -> Photographs:  # read once, and only if a number is missing
        return Photographs(each.data.test_photos)

    @cache
    def pairs(axis: str, size: float) -> tuple[Tensor, Tensor]:
        watch.stage(f"{wanted.data}: pairs, {axis} {size:g}", 0)
        return pairs_at(each, photographs(), wanted.count, axis, size)

    parts = {f"robustness/{wanted.data}/{label}": label for label in methods}
    for part in shared(out, list(parts)):
        label = parts[part]
        watch.stage(f"{wanted.data}: robustness of {label}", 0)
        checkpoint = _checkpoint(methods[label], each, out)
        sweeps[label] = sweep(
            partial(bind, methods[label], checkpoint, each, place),
            identity(methods[label], checkpoint, each),
            each,
            wanted,
            out / f"{part}.json",
            pairs,
        )
    return {label: sweeps[label] for label in methods}

"""`mwdn evaluate`: compare methods on pairs of measurements and scenes."""

from collections.abc import Iterable
from dataclasses import replace
from itertools import count
from pathlib import Path
from typing import Annotated, Any, Literal

from cyclopts import Parameter
from rich.markup import escape

from mwdn import evaluation
from mwdn.cli.camera import CameraOptions
from mwdn.cli.folders import no_empty_folder
from mwdn.cli.method_options import MethodOptions, read_options
from mwdn.cli.progress import show_progress
from mwdn.cli.terminal import Json, complain, results, say, warn
from mwdn.cli.weights import ask_for_lpips
from mwdn.data.pair_checks import check_pairs, missing_refinement, other_camera
from mwdn.data.pairs import PairFile, Part
from mwdn.data.recorded import Division, RefinedPairs
from mwdn.errors import MwdnError, ParameterError, one_line
from mwdn.evaluation import Perceptual, Report, Variant
from mwdn.evaluation.alexnet import ALEXNET_MIN_PX
from mwdn.evaluation.evaluate import Pairs
from mwdn.inference.reconstructor import Reconstructor
from mwdn.io.files import check_folder, refuse_foreign, refuse_overwrite
from mwdn.weights.bundled import BUNDLED, stored_metadata


@no_empty_folder
def evaluate(  # noqa: PLR0913
    *methods: str,
    data: Path,
    camera: CameraOptions = CameraOptions(),
    protocol: str = "full",
    variant: Variant | None = None,
    split: str | None = None,
    part: Literal["test", "validation", "train"] | None = None,
    first: int | None = None,
    lpips: bool | None = None,
    out: Annotated[Path, Parameter(name=["--out", "-o"])] = Path("results/evaluate"),
    device: str | None = None,
    json: Json = False,
    **options: MethodOptions,
) -> int:
    """Compare methods on pairs of measurements and scenes: quality, time, memory.

    Options of solvers: --regularisation 1e-4, --iterations 50 ... apply to each of the methods that has them; `mwdn
    methods admm` lists those of admm.

    Args:
        methods: names of solvers or bundled networks, see `mwdn methods`, or paths of checkpoints.
        data: HDF5 file of pairs.
        camera: calibration of the camera that took them.
        protocol: full, centre-128 (the paper's), or rows and columns such as 60:270,60:440 (DiffuserCam's).
        variant: raw, clipped to [0, 1], or best-gain (one gain and offset per picture). The default is raw for
            centre-128 and clipped otherwise.
        split: use one part of the pairs only, as `mwdn train` divides them: paper (8:1:1), diffusercam, phlatcam,
            in-order, random or folds. All pairs unless given.
        part: of --split: test (the default), validation or train.
        first: use only this many pairs.
        lpips: LPIPS and feature MSE: download their public weights (234 MiB, once) if they are missing, or leave both
            metrics out. By default they are used if they are there; a terminal asks before a download.
        out: folder for report.json and comparison.png.
        device: cpu, cuda, cuda:1 ...; a GPU if there is one unless given.
        json: print the content of report.json instead of a table.
        **options: options of the methods.
    """
    method_options = read_options(methods, options, evaluate)
    _refuse_capture_options(camera)
    region, file = evaluation.Protocol.parse(protocol), PairFile(data)
    calibration = replace(camera.load(), white_balance=None)  # scenes of pairs are in the camera's own colours
    check_pairs(file, calibration.psf)
    rows: range | list[int] = range(len(file))
    if split is not None:
        rows = _rows(file, split, part or "test", methods)
    elif part is not None:
        raise ParameterError(f"`--part {part}` is a part of a split. Say which one: `--split paper`, as in training.")
    pairs: Pairs = Part(file, rows)
    if first is not None:
        pairs = evaluation.First(pairs, first)
    if refinement := missing_refinement(file, calibration.refinement):
        pairs = RefinedPairs(pairs, refinement)
    reconstructors = {
        method: Reconstructor(method, calibration, device=device, **own) for method, own in method_options.items()
    }
    learned = [] if part == "train" else [_learned(method, file, rows[:first]) for method in methods]
    warn(*(reconstruct.warning for reconstruct in reconstructors.values()), other_camera(file, calibration), *learned)
    refuse_overwrite(out / evaluation.SHEET, *camera.files)
    refuse_foreign(out, (evaluation.JSON, evaluation.SHEET), b'"protocol"')
    if min(region.crop(calibration.psf).shape[-2:]) >= ALEXNET_MIN_PX:
        lpips = ask_for_lpips(lpips)
    perceptual = Perceptual.none("--no-lpips") if lpips is False else Perceptual.load(download=lpips is True)
    check_folder(out)
    with show_progress() as progress:
        progress.start("Evaluating", len(reconstructors) * len(pairs))
        done = count(1)
        report = evaluation.evaluate(
            reconstructors,
            pairs,
            region,
            variant=variant,
            perceptual=perceptual,
            progress=lambda name, _: progress.update(next(done), name),
        )
    report.write(out)
    _print_report(report, json=json)
    for name, reason in report.failed.items():
        complain(f"[red]{escape(one_line(name))}:[/]", MwdnError(f"no scores: {reason}"))
    say(f"Look at {out}")
    return 1 if report.failed else 0


def _refuse_capture_options(camera: CameraOptions) -> None:
    """Raise a `ParameterError` for options that act on raw captures alone; a camera file may have them."""
    given = {"`ambient`": camera.ambient, "`gamma`": camera.frames.gamma}
    names = [name for name, value in given.items() if value is not None]
    if names and camera.camera is None:
        raise ParameterError(
            f"The captures of a file of pairs are corrected already: leave out {' and '.join(names)}. Corrections are "
            "for `mwdn import` and `mwdn align`, which write the file."
        )


def _rows(file: PairFile, split: str, name: str, methods: Iterable[str]) -> range | list[int]:
    """Positions of one part of a split, divided as in the training of the methods."""
    rows = _division(split, methods).parts(len(file))[name]
    if not rows:
        raise ParameterError(f"The split '{split}' of {len(file):,} pairs has no {name} part. Choose another `--part`.")
    return rows


def _division(split: str, methods: Iterable[str]) -> Division:
    """The division of the pairs that the checkpoints were trained with, if it is this split; else its defaults.

    Raises:
        ParameterError: they were trained with different ones: the test part of one is in the training part of another.
    """
    divisions = {_trained_with(metadata) for metadata in map(_metadata, methods) if metadata}
    trained = {division for division in divisions if division.split == split}
    if len(trained) > 1:
        raise ParameterError(f"The checkpoints divided '{split}' in different ways. Evaluate each by itself.")
    return trained.pop() if trained else Division(split)


def _trained_with(metadata: dict[str, Any]) -> Division:
    """The division of the pairs that a checkpoint of this metadata was trained with."""
    table = metadata.get("recipe", {}).get("pairs", {})
    known = {name: table[name] for name in ("split", "seed", "folds", "fold") if name in table}
    return Division(fractions=tuple(table.get("fractions", Division.fractions)), **known)


def _metadata(method: str) -> dict[str, Any] | None:
    """`stored_metadata`, except for bundled networks, which were trained without recorded pairs."""
    return None if method in BUNDLED else stored_metadata(method)


def _learned(method: str, file: PairFile, rows: range | list[int]) -> str | None:
    """A warning if a checkpoint was trained on pairs that it is evaluated on, otherwise ``None``."""
    metadata, of_file = _metadata(method), f" of {len(file):,} recorded"
    if metadata is None or not str(metadata.get("pairs", "")).endswith(of_file):
        return None
    division = _trained_with(metadata)
    parts = division.parts(len(file))
    if metadata["pairs"] != f"{len(parts['train']):,}{of_file}":
        return (
            f"`{method}` was trained on {metadata['pairs']} pairs. If `{file.path}` is the file of its training, they "
            "may be among these: which ones is not known."
        )
    known = len({*parts["train"]} & {*rows})
    if not known:
        return None
    other = "test" if parts.get("test") else "validation"
    return (
        f"`{method}` was trained on {known:,} of these {len(rows):,} pairs if `{file.path}` is the file of its "
        f"training. It was not trained on those of `--split {division.split} --part {other}`."
    )


def _print_report(report: Report, *, json: bool) -> None:
    """Print the content of report.json, or a table; a narrow one if the terminal has too few columns."""
    if json:
        results.out(report.json(), highlight=False)
        return
    table = report.table()
    width = results.measure(table, options=results.options.update(width=1000)).maximum
    results.print(report.table(narrow=True) if width > results.width else table)

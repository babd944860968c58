"""Scores of one method on one data set, saved with its first reconstructions."""

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from mwdn.benchmark.methods import MEAN, Method
from mwdn.benchmark.sets import Dataset
from mwdn.data.recorded import RecordedPairs
from mwdn.errors import ImageError, ParameterError
from mwdn.evaluation import First, Perceptual, Scores, evaluate
from mwdn.inference.methods import find_method
from mwdn.inference.reconstructor import Reconstructor
from mwdn.io.files import atomic_write, file_sha256, write_text
from mwdn.io.npy import read_array
from mwdn.io.reading import read_json, unexpected_content
from mwdn.optics.psf import psf_hash
from mwdn.types import Measurement, Psf, Scene
from mwdn.version import __version__
from mwdn.weights.bundled import find_weights

TIMED = 3
"""Pictures to time on the CPU when the scores come from a GPU."""


@dataclass(frozen=True, eq=False)
class MethodResult:
    """Scores and reconstructions of a method on a data set.

    Args:
        scores: under the data set's protocol.
        cpu: time and memory on the CPU if the scores come from a GPU.
        missing: metrics that could not be measured, and why.
        pictures: (N, C, H, W), reconstructions of the first test pictures.
        captures: (N, C, H, W), reconstructions of the real captures.
    """

    scores: Scores
    cpu: Scores | None
    missing: dict[str, str]
    pictures: Tensor
    captures: Tensor


@dataclass(frozen=True, eq=False)
class MeanPicture:
    """The same picture for every capture: a baseline that a useful method must exceed.

    Args:
        scene: (1, C, H, W), mean of all training scenes.
    """

    scene: Scene

    @classmethod
    def of(cls, dataset: Dataset) -> "MeanPicture":
        """The mean of a data set's training scenes, of which there are as many as its recipe says."""
        pairs = dataset.training[0] if dataset.training else None
        if not isinstance(pairs, RecordedPairs):
            raise ParameterError(f"`mean_picture` needs a number of training pairs in `{dataset.name}`: give `train`.")
        total = sum(pairs.file[row][1].double() for row in pairs.rows)
        return cls((total / len(pairs)).float()[None])  # type: ignore[union-attr]

    def __call__(self, measurement: Measurement, psf: Psf) -> Scene:
        """The mean, for each measurement."""
        return self.scene.to(measurement).expand(len(measurement), -1, -1, -1)


def make_reconstructor(
    method: Method, checkpoint: Path | None, dataset: Dataset, device: torch.device | str
) -> Reconstructor:
    """A method for the camera of a data set.

    Args:
        method: solver or network.
        checkpoint: weights of a network trained here; ``None`` for a solver or a bundled network.
        dataset: whose calibration is used.
        device: where to compute.
    """
    if method.name == MEAN:
        return Reconstructor(MeanPicture.of(dataset), dataset.calibration, device=device)
    if checkpoint is not None:
        return Reconstructor(checkpoint, dataset.calibration, device=device)
    return Reconstructor(find_method(method.name, **method.options), dataset.calibration, device=device)


def identity(method: Method, checkpoint: Path | None, dataset: Dataset) -> dict[str, Any]:
    """Everything the scores depend on: saved scores with another identity are measured again."""
    weights = checkpoint or find_weights(method.name)
    content = {
        "method": [method.name, method.options],
        "weights": file_sha256(weights)[:16] if weights is not None else None,
        "version": __version__,
        "pairs": len(dataset.test),
        "data": dataset.identity,
        "protocol": dataset.protocol.name,
        "variant": dataset.protocol.variant,
    }
    return json.loads(json.dumps(content))


def score(
    method: Method,
    checkpoint: Path | None,
    dataset: Dataset,
    folder: Path,
    *,
    device: torch.device,
    perceptual: Callable[[], Perceptual],
    shown: int,
) -> MethodResult:
    """Score a method, or read its saved scores.

    Args:
        method: solver or network.
        checkpoint: weights of a network; ``None`` for a solver.
        dataset: its test pairs are reconstructed.
        folder: for the scores of this data set.
        device: where to compute.
        perceptual: loads the networks of the metrics; called only if the saved scores, if any, lack a metric.
        shown: how many reconstructions to save.

    Raises:
        MwdnError: the method cannot be used, or does not fit the pairs.
    """
    path = folder / f"{method.label}.json"
    captures = list(dataset.recipe.captures)
    record_identity = identity(method, checkpoint, dataset)
    record_identity |= {"device": device.type, "shown": shown, "captures": captures}
    # Their files and those of the camera may change under the same names. Earlier records lack it.
    captured = psf_hash(dataset.captures)
    record = read_record(path, record_identity)
    lacking = record.get("missing", {}) if record else {}
    if lacking and not perceptual().missing.keys() >= lacking.keys():
        record = None  # measured without weights that are here now
    if record is None or (captures and record.get("captured") != captured):
        reconstruct = make_reconstructor(method, checkpoint, dataset, device)
        measured = _measure(reconstruct, dataset, path, perceptual(), shown) if record is None else record
        _write_pictures(path, "captures", [reconstruct(measurement[None]) for measurement in dataset.captures], dataset)
        record = {"identity": record_identity, **measured, "captured": captured}
        write_text(path, json.dumps(record, indent=1))  # after the pictures
    return saved_result(path, record)


def saved_result(path: Path, record: dict[str, Any]) -> MethodResult:
    """The saved result of a method; a `ParameterError` that names the damaged file and the way out."""
    try:
        pictures = {name: read_array(_pictures_file(path, name), _check_pictures) for name in ("pictures", "captures")}
    except ImageError as error:
        raise ParameterError(f"{error} To measure the method again, remove `{path.name}` beside it.") from error
    tensors = {name: torch.from_numpy(array) for name, array in pictures.items()}
    with unexpected_content(path):
        cpu = Scores.read(record["cpu"]) if record["cpu"] else None
        return MethodResult(Scores.read(record["scores"]), cpu, dict(record["missing"]), **tensors)


def _check_pictures(shape: tuple[int, ...], dtype: Any) -> None:  # noqa: ANN401
    if len(shape) != 4 or dtype != np.float32:
        raise ImageError(f"holds {dtype} of the shape {shape}, not pictures (N, C, H, W) of float32.")


def read_record(path: Path, identity: dict[str, Any]) -> dict[str, Any] | None:
    """Content of a file of saved results; ``None`` if it is missing or has another identity."""
    if not path.is_file():
        return None
    with unexpected_content(path):
        content: dict[str, Any] = read_json(path)
        return content if content["identity"] == identity else None


def _measure(
    reconstruct: Reconstructor, dataset: Dataset, path: Path, perceptual: Perceptual, shown: int
) -> dict[str, Any]:
    """Reconstruct the test pairs; write the first pictures, return the scores."""
    report = evaluate({"method": reconstruct}, dataset.test, dataset.protocol, perceptual=perceptual, shown=shown)
    cpu = None
    if reconstruct.device.type != "cpu":
        on_cpu = Reconstructor(reconstruct.method, dataset.calibration, device="cpu")
        few = First(dataset.test, TIMED)
        timing = evaluate({"method": on_cpu}, few, dataset.protocol, perceptual=Perceptual.none())
        cpu = timing.methods["method"].content()
    _write_pictures(path, "pictures", [row[2] for row in report.rows], dataset)
    return {"scores": report.methods["method"].content(), "cpu": cpu, "missing": report.missing}


def _write_pictures(path: Path, name: str, pictures: list[Tensor], dataset: Dataset) -> None:
    with atomic_write(_pictures_file(path, name)) as temporary:
        np.save(temporary, torch.cat(pictures or [torch.zeros(0, 3, *dataset.calibration.size)]).numpy())


def _pictures_file(path: Path, name: str) -> Path:
    return path.with_name(f"{path.stem}-{name}.npy")

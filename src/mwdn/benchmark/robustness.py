"""Robustness: PSNR of each method as the camera drifts further from its calibration than in training."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from mwdn.benchmark.dataset_recipe import DatasetRecipe
from mwdn.benchmark.recipe import SWEPT, Robustness
from mwdn.benchmark.scoring import read_record
from mwdn.benchmark.sets import Dataset, simulated_pairs
from mwdn.data.mismatch import EXACT
from mwdn.data.photographs import Photographs
from mwdn.errors import ParameterError
from mwdn.evaluation import measure
from mwdn.inference.reconstructor import Reconstructor
from mwdn.io.files import write_text
from mwdn.io.reading import unexpected_content
from mwdn.optics import Sensor
from mwdn.training.experiment import FILE_START

Sweep = dict[str, dict[float, list[float]]]
"""PSNR of each picture, by axis and then by size of the mismatch."""


def noisier(sensor: Sensor, factor: float) -> Sensor:
    """A sensor with ``factor`` times the noise at every brightness.

    The variance of shot noise is signal / full well; read noise is a standard deviation in electrons.

    Raises:
        ParameterError: the factor is not positive.
    """
    if not factor > 0:
        raise ParameterError(f"`noise` ({factor:g}) of [robustness] must be positive: a factor.")
    return replace(sensor, full_well=sensor.full_well / factor**2, read_noise=sensor.read_noise / factor)


def check_axes(robustness: Robustness, dataset: Dataset) -> None:
    """Check before the training that all sizes can be tested later.

    Raises:
        ParameterError: a size is out of range; or more than the noise is to change of a camera whose PSFs are measured
            or random.
    """
    if robustness.sizes and robustness.count < 1:
        raise ParameterError(f"`count` ({robustness.count}) of [robustness] must be at least 1.")
    for axis, sizes in robustness.sizes.items():
        for size in sizes:
            _changed(dataset.recipe, axis, size)
    axes = [axis for axis in robustness.sizes if axis != "noise"]
    if axes and dataset.recipe.mismatch != EXACT:
        raise ParameterError(
            f"[robustness] can only have `noise` for `{dataset.name}`, not `{axes[0]}`: its `mismatch` draws another "
            "camera for each pair. Set `deviation` instead of `mismatch`."
        )
    if axes and dataset.calibration.places.field_psfs:
        raise ParameterError(
            f"[robustness] can only have `noise` for `{dataset.name}`, not `{axes[0]}`: its camera's `field_psfs` are "
            "measured, and no other PSFs are simulated."
        )


def pairs_at(dataset: Dataset, photographs: Photographs, count: int, axis: str, size: float) -> tuple[Tensor, Tensor]:
    """Test pairs through the data set's camera with more of one mismatch; the scenes are the same for all sizes.

    Args:
        dataset: a simulated data set.
        photographs: of the test.
        count: number of pairs.
        axis: one of `SWEPT`.
        size: of the mismatch, added to what the camera had in training; for noise a factor.

    Returns:
        measurements and scenes, (count, C, H, W).
    """
    recipe = _changed(dataset.recipe, axis, size)
    source = simulated_pairs(recipe, dataset.calibration, photographs, torch.device("cpu"))
    batches = [source.batch([FILE_START + number]) for number in range(count)]
    return torch.cat([batch.measurement for batch in batches]), torch.cat([batch.scene for batch in batches])


def _changed(recipe: DatasetRecipe, axis: str, size: float) -> DatasetRecipe:
    """A data set with more noise, or with a larger deviation."""
    if axis == "noise":
        return replace(recipe, sensor=noisier(recipe.sensor, size))
    return replace(recipe, deviation=recipe.deviation.plus(axis, size))


def sweep(
    make_reconstructor: Callable[[], Reconstructor],
    identity: dict[str, Any],
    dataset: Dataset,
    robustness: Robustness,
    path: Path,
    pairs: Callable[[str, float], tuple[Tensor, Tensor]],
) -> Sweep:
    """Measure the PSNR of a method at every size of every axis; each one is saved at once.

    Args:
        make_reconstructor: called only if a value is missing.
        identity: everything the values depend on, see `mwdn.benchmark.scoring.identity`.
        dataset: a simulated data set.
        robustness: the axes and sizes.
        path: file of the values.
        pairs: test pairs of an axis and a size, see `pairs_at`.
    """
    identity = {**identity, "count": robustness.count}
    saved = read_record(path, identity) or {"psnr": {}}
    with unexpected_content(path):
        psnr = {axis: {size: [*map(float, row)] for size, row in rows.items()} for axis, rows in saved["psnr"].items()}
    reconstruct: Reconstructor | None = None
    for axis, sizes in robustness.sizes.items():
        for size in sizes:
            axis_key, size_key = _keys(axis, size)
            if size_key in psnr.get(axis_key, {}):
                continue
            reconstruct = reconstruct or make_reconstructor()
            measurements, scenes = pairs(axis, size)
            reconstructions = torch.cat([reconstruct(measurement[None]) for measurement in measurements])
            values = measure(reconstructions, scenes, dataset.protocol)["psnr"].tolist()
            psnr.setdefault(axis_key, {})[size_key] = values
            write_text(path, json.dumps({"identity": identity, "psnr": psnr}, indent=1))
    keys = {axis: {size: _keys(axis, size) for size in sizes} for axis, sizes in robustness.sizes.items()}
    return {axis: {size: psnr[a][s] for size, (a, s) in by_size.items()} for axis, by_size in keys.items()}


def _keys(axis: str, size: float) -> tuple[str, str]:
    """Keys in the file: the camera of the training is the start of every axis and is measured once."""
    return ("none", "0") if size == SWEPT[axis] else (axis, repr(size))

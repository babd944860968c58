"""What becomes of methods where the camera differs more from its calibration than in training."""

import json
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from mwdn.benchmark.recipe import AXES, Robustness
from mwdn.benchmark.scoring import read_kept
from mwdn.benchmark.sets import Opened, simulated
from mwdn.data.photographs import Photographs
from mwdn.data.writing import atomic
from mwdn.evaluation import measure
from mwdn.learning.session import FILE_START
from mwdn.optics import Sensor
from mwdn.reconstruct import Reconstructor

Sweep = dict[str, dict[float, list[float]]]
"""PSNR of each picture by the size, by the axis."""


def noisier(sensor: Sensor, factor: float) -> Sensor:
    """A sensor with ``factor`` times the noise of this one at every brightness.

    The variance of shot noise is signal / full well, and the deviation of read noise is in electrons.
    """
    return replace(sensor, full_well=sensor.full_well / factor**2, read_noise=sensor.read_noise / factor)


def pairs_at(
    opened: Opened, axis: str, size: float, count: int, *, photographs: Photographs | None = None
) -> tuple[Tensor, Tensor]:
    """Test pairs through the data set's camera with more of one mismatch; photographs and places are the same.

    Args:
        opened: a simulated data set.
        axis: of `AXES`.
        size: of the mismatch, beyond what the camera had in training; of the noise, as a multiple.
        count: of pairs.
        photographs: those of the test, if they have been read.

    Returns:
        measurements and scenes, (count, 3, H, W).
    """
    data = opened.data
    if axis == "noise":
        data = replace(data, sensor=noisier(data.sensor, size))
    else:
        data = replace(data, deviation=data.deviation.plus(axis, size))
    photographs = photographs or Photographs(data.test_photos)
    source = simulated(data, opened.calibration, photographs, torch.device("cpu"))
    parts = [source.batch([FILE_START + number]) for number in range(count)]
    return torch.cat([part.measurement for part in parts]), torch.cat([part.scene for part in parts])


def sweep(
    methods: Mapping[str, Callable[[], Reconstructor]],
    identities: Mapping[str, dict[str, Any]],
    opened: Opened,
    wanted: Robustness,
    folder: Path,
    *,
    tell: Callable[[str], None] = lambda text: None,
) -> dict[str, Sweep]:
    """PSNR of every method at every size of every axis, each kept as soon as it is known.

    Args:
        methods: how to bind each, by its label.
        identities: what the numbers of each depend on.
        opened: a simulated data set.
        wanted: the sizes.
        folder: for the numbers.
        tell: told what is being done.
    """
    paths = {label: folder / f"{label}.json" for label in methods}
    asked = {label: {**identities[label], "count": wanted.count} for label in methods}
    known = {label: (read_kept(paths[label], asked[label]) or {"psnr": {}})["psnr"] for label in methods}
    bound: dict[str, Reconstructor] = {}
    photographs: Photographs | None = None
    for axis, sizes in wanted.sizes.items():
        for size in sizes:
            # At its beginning every axis is the camera of the training.
            place, key = ("none", "0") if size == AXES[axis] else (axis, repr(size))
            missing = [label for label in methods if key not in known[label].get(place, {})]
            if not missing:
                continue
            tell(f"robustness: {axis} {size:g}")
            photographs = photographs or Photographs(opened.data.test_photos)
            measurements, scenes = pairs_at(opened, axis, size, wanted.count, photographs=photographs)
            for label in missing:
                bound[label] = bound.get(label) or methods[label]()
                found = [bound[label](one[None]) for one in measurements]
                values = measure(torch.cat(found), scenes, opened.data.part())["psnr"]
                known[label].setdefault(place, {})[key] = values.tolist()
                with atomic(paths[label]) as temporary:
                    content = {"identity": asked[label], "psnr": known[label]}
                    temporary.write_text(json.dumps(content, indent=1), encoding="utf-8")
    return {label: _sorted(found, wanted) for label, found in known.items()}


def _sorted(found: dict[str, dict[str, list[float]]], wanted: Robustness) -> Sweep:
    return {
        axis: {size: found["none"]["0"] if size == AXES[axis] else found[axis][repr(size)] for size in sizes}
        for axis, sizes in wanted.sizes.items()
    }

"""What becomes of methods where the camera differs more from its calibration than in training."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from mwdn.benchmark.recipe import AXES, Robustness
from mwdn.benchmark.scoring import read_kept
from mwdn.benchmark.sets import Opened, simulated
from mwdn.data.photographs import Photographs
from mwdn.evaluation import measure
from mwdn.inference.reconstructor import Reconstructor
from mwdn.io.files import save_text
from mwdn.optics import Sensor
from mwdn.training.experiment import FILE_START

Sweep = dict[str, dict[float, list[float]]]
"""PSNR of each picture by the size, by the axis."""


def noisier(sensor: Sensor, factor: float) -> Sensor:
    """A sensor with ``factor`` times the noise of this one at every brightness.

    The variance of shot noise is signal / full well, and the deviation of read noise is in electrons.
    """
    return replace(sensor, full_well=sensor.full_well / factor**2, read_noise=sensor.read_noise / factor)


def pairs_at(opened: Opened, photographs: Photographs, count: int, axis: str, size: float) -> tuple[Tensor, Tensor]:
    """Test pairs through the data set's camera with more of one mismatch; photographs and places are the same.

    Args:
        opened: a simulated data set.
        photographs: those of the test.
        count: of pairs.
        axis: of `AXES`.
        size: of the mismatch, beyond what the camera had in training; of the noise, as a multiple.

    Returns:
        measurements and scenes, (count, 3, H, W).
    """
    data = opened.data
    if axis == "noise":
        data = replace(data, sensor=noisier(data.sensor, size))
    else:
        data = replace(data, deviation=data.deviation.plus(axis, size))
    source = simulated(data, opened.calibration, photographs, torch.device("cpu"))
    parts = [source.batch([FILE_START + number]) for number in range(count)]
    return torch.cat([part.measurement for part in parts]), torch.cat([part.scene for part in parts])


def sweep(
    bind: Callable[[], Reconstructor],
    identity: dict[str, Any],
    opened: Opened,
    wanted: Robustness,
    path: Path,
    pairs: Callable[[str, float], tuple[Tensor, Tensor]],
) -> Sweep:
    """PSNR of a method at every size of every axis, each kept as soon as it is known.

    Args:
        bind: the method.
        identity: what its numbers depend on.
        opened: a simulated data set.
        wanted: the sizes.
        path: for the numbers.
        pairs: of an axis and a size, see `pairs_at`.
    """
    asked = {**identity, "count": wanted.count}
    known = (read_kept(path, asked) or {"psnr": {}})["psnr"]
    bound: Reconstructor | None = None
    for axis, sizes in wanted.sizes.items():
        for size in sizes:
            place, key = _place(axis, size)
            if key in known.get(place, {}):
                continue
            bound = bound or bind()
            measurements, scenes = pairs(axis, size)
            found = torch.cat([bound(one[None]) for one in measurements])
            known.setdefault(place, {})[key] = measure(found, scenes, opened.data.part())["psnr"].tolist()
            save_text(path, json.dumps({"identity": asked, "psnr": known}, indent=1))
    places = {axis: {size: _place(axis, size) for size in sizes} for axis, sizes in wanted.sizes.items()}
    return {axis: {size: known[at][key] for size, (at, key) in found.items()} for axis, found in places.items()}


def _place(axis: str, size: float) -> tuple[str, str]:
    """Where a size is kept: at its beginning every axis is the camera of the training."""
    return ("none", "0") if size == AXES[axis] else (axis, repr(size))

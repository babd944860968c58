"""The comparison of methods on one set of pairs, under one protocol."""

import ctypes
import sys
import time
import typing
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import nn

from mwdn.data.pair_writer import NAMES
from mwdn.errors import ParameterError
from mwdn.evaluation.alexnet import SMALLEST
from mwdn.evaluation.metrics import METRICS, Perceptual, Protocol, Variant, measure
from mwdn.evaluation.report import Report, Scores
from mwdn.types import Measurement, Scene

Bound = Callable[[Measurement], Scene]
"""A method bound to its camera, (1, C, H, W) to (1, C, H, W): a `Reconstructor`, or any function like it."""


@typing.runtime_checkable
class Pairs(typing.Protocol):
    """Pairs (measurement, scene), each (C, H, W), by their positions: a list or a `PairFile`."""

    def __len__(self) -> int: ...

    def __getitem__(self, index: int, /) -> tuple[torch.Tensor, torch.Tensor]: ...


@dataclass(frozen=True)
class First:
    """The first pairs of many, read only when asked for.

    Args:
        pairs: all of them.
        count: how many to keep; all, if there are no more.

    Raises:
        ParameterError: fewer than one.
    """

    pairs: Pairs
    count: int

    def __post_init__(self) -> None:
        if self.count < 1:
            raise ParameterError(f"`first` ({self.count}) must be at least 1: `--first 10`.")

    def __len__(self) -> int:
        return min(self.count, len(self.pairs))

    def __getitem__(self, index: int) -> tuple[torch.Tensor, torch.Tensor]:
        return self.pairs[range(len(self))[index]]


def evaluate(
    methods: Mapping[str, Bound],
    pairs: Pairs,
    protocol: Protocol,
    *,
    variant: Variant | None = None,
    perceptual: Perceptual | None = None,
    shown: int = 4,
    progress: Callable[[str, int], None] | None = None,
) -> Report:
    """Reconstruct every measurement by every method, one at a time, and compare with the scenes.

    Args:
        methods: by the names that the report shall use.
        pairs: measurements and scenes; scenes in [0, 1], of the size of the reconstructions.
        protocol: the part of each picture that counts.
        variant: what is done to a reconstruction first; that of the protocol unless given.
        perceptual: networks for `lpips` and `feature_mse`; unless given they are found or downloaded, and what
            cannot be had, or needs larger pictures, is reported as missing.
        shown: number of pictures that the report keeps for its sheet.
        progress: called with the method's name and the position of each picture that is done.

    Raises:
        ParameterError: no method or no pair, or a pair holds NaN or infinity.
        ShapeError: a reconstruction and its scene differ in shape, or the protocol does not fit.
    """
    if not methods:
        raise ParameterError("`methods` must not be empty. Name one: admm, wiener, universal, or a checkpoint's path.")
    _check(pairs)
    if min(protocol.crop(pairs[0][1][None]).shape[-2:]) < SMALLEST:
        perceptual = Perceptual.none(f"the part {protocol.name} has less than {SMALLEST} pixels a side, for AlexNet")
    perceptual = perceptual or Perceptual.load()
    first = [pairs[i] for i in range(min(shown, len(pairs)))]
    rows = [[scene[None], measurement[None]] for measurement, scene in first]
    scores = {}
    for name, method in methods.items():
        peak = _warm_up(method, pairs[0][0][None])
        values: dict[str, list[float]] = {metric: [] for metric in METRICS}
        seconds = []
        for i in range(len(pairs)):
            measurement, scene = pairs[i]
            reconstruction, elapsed = _timed(method, measurement[None])
            seconds.append(elapsed)
            found = measure(reconstruction.cpu(), scene[None], protocol, variant=variant, perceptual=perceptual)
            for metric, value in found.items():
                values[metric].append(value.item())
            if i < len(rows):
                rows[i].append(reconstruction.cpu())
            if progress:
                progress(name, i)
        columns = {metric: tuple(column) for metric, column in values.items()}
        scores[name] = Scores(columns, tuple(seconds), peak, _device(method).type, learnable_numbers(method))
    return Report(protocol.name, variant or protocol.variant, scores, perceptual.missing, rows)


def _check(pairs: Pairs) -> None:
    """Find what no method can be judged by before the first one is."""
    if not len(pairs):
        raise ParameterError("`pairs` must not be empty: the file holds none. Make it again, with `mwdn import`.")
    for i in range(len(pairs)):
        for name, picture in zip(NAMES, pairs[i], strict=True):
            if not picture.isfinite().all():
                raise ParameterError(
                    f"The {name} of pair {i}, counted from 0, holds NaN or infinity. Make the file again without it."
                )


def learnable_numbers(method: Bound) -> int:
    """Parameters of the network inside a method; 0 where there is none."""
    network = getattr(method, "method", method)
    return sum(p.numel() for p in network.parameters()) if isinstance(network, nn.Module) else 0


def _device(method: Bound) -> torch.device:
    """Where a method computes: its ``device``, or else the CPU."""
    return torch.device(getattr(method, "device", "cpu"))


@torch.no_grad()
def _timed(method: Bound, measurement: Measurement) -> tuple[Scene, float]:
    """Reconstruct, and take the seconds with the way to the device and back."""
    device = _device(method)
    _synchronise(device)
    start = time.perf_counter()
    reconstruction = method(measurement)
    _synchronise(device)
    return reconstruction, time.perf_counter() - start


def _synchronise(device: torch.device) -> None:
    if device.type == "cuda":
        torch.cuda.synchronize(device)


def _warm_up(method: Bound, measurement: Measurement) -> int | None:
    """Reconstruct twice, so that plans, caches and clocks have settled; returns the peak memory in bytes.

    On a GPU, all that torch holds there at its highest, weights included. On a CPU, by how much the memory of the
    whole process rises above what it holds before. Where that peak cannot be forgotten (Linux can), above the highest
    it ever held: 0 if the method needs less than another one before it.
    """
    device = _device(method)
    if device.type == "cuda":
        torch.cuda.reset_peak_memory_stats(device)
    _forget_peak()
    before = _highest_resident()
    for _ in range(2):
        _timed(method, measurement)
    if device.type == "cuda":
        return torch.cuda.max_memory_allocated(device)
    after = _highest_resident()
    return None if before is None or after is None or device.type != "cpu" else after - before


def _forget_peak() -> None:
    """Let `_highest_resident` begin again at what the process holds now; see proc_pid_clear_refs(5).

    What methods before have freed, and glibc keeps for the next ones, is given back first: it would hide their need.
    """
    with suppress(OSError, AttributeError, TypeError):
        ctypes.CDLL(None).malloc_trim(0)
    with suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5", encoding="ascii")


def _highest_resident() -> int | None:
    """Highest resident memory of this process so far, in bytes; unknown on Windows."""
    if sys.platform == "win32":
        return None
    import resource

    highest = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return highest if sys.platform == "darwin" else highest * 1024

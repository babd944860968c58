"""Compare methods on one set of pairs under one protocol."""

import ctypes
import sys
import time
import typing
import warnings
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import torch
from torch import nn

from mwdn.arguments import checked
from mwdn.data.pairs import refuse_non_finite
from mwdn.errors import MwdnError, ParameterError, ShapeError, without_traceback
from mwdn.evaluation.alexnet import ALEXNET_MIN_PX
from mwdn.evaluation.distances import WINDOW
from mwdn.evaluation.metrics import METRICS, Perceptual, Protocol, Variant, measure
from mwdn.evaluation.report import Report, Scores
from mwdn.types import Measurement, Scene

Method = Callable[[Measurement], Scene]
"""Reconstruction for one camera, (1, C, H, W) to (1, C, H, W): a `Reconstructor`, or any such function."""

MAX_SCENE = 2.0
"""Largest number of scenes without a warning: a highlight may exceed white."""


@typing.runtime_checkable
class Pairs(typing.Protocol):
    """Pairs (measurement, scene), each (C, H, W), by index: a list or a `PairFile`."""

    def __len__(self) -> int: ...

    def __getitem__(self, index: int, /) -> tuple[torch.Tensor, torch.Tensor]: ...


@dataclass(frozen=True)
class First:
    """The first pairs of a sequence, read when indexed.

    Args:
        pairs: the sequence.
        count: number of pairs, at most.

    Raises:
        ParameterError: `count` is below 1.
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


@checked
def evaluate(
    methods: Mapping[str, Method],
    pairs: Pairs,
    protocol: Protocol,
    *,
    variant: Variant | None = None,
    perceptual: Perceptual | None = None,
    shown: int = 4,
    progress: Callable[[str, int], None] | None = None,
) -> Report:
    """Reconstruct every measurement with every method, one at a time, and compare with the scenes.

    Args:
        methods: by their names in the report.
        pairs: measurements and scenes; scenes in [0, 1], of the size of the reconstructions.
        protocol: the part of each picture that is compared.
        variant: adjustment of a reconstruction before the comparison; the protocol's unless given.
        perceptual: networks for `lpips` and `feature_mse`; unless given, loaded if their files are there, see
            `Perceptual.load`. Metrics without weights, or with too small pictures, are reported as missing.
        shown: number of pictures that the report keeps for its contact sheet.
        progress: called with the method's name and the picture's index after each picture.

    Returns:
        The scores of each method. If a method raises an `MwdnError`, the report has the reason in place of its scores.

    Raises:
        ParameterError: no method, no pair, NaN or infinity in a pair, or an argument of another type.
        ShapeError: the protocol's part exceeds the scenes, or is too small for SSIM.
        MwdnError: every method fails; this is the first one's error.
    """
    if not methods:
        raise ParameterError("`methods` must not be empty. Name one: admm, wiener, universal, or a checkpoint.")
    _check_pairs(pairs)
    side = min(protocol.crop(pairs[0][1][None]).shape[-2:])
    if side < WINDOW:
        raise ShapeError(f"`protocol` ({protocol.name}) must leave at least {WINDOW} x {WINDOW} pixels, for SSIM.")
    if side < ALEXNET_MIN_PX:
        perceptual = Perceptual.none(
            f"the part {protocol.name} has less than {ALEXNET_MIN_PX} pixels a side, for AlexNet"
        )
    perceptual = perceptual or Perceptual.load()
    first = [pairs[i] for i in range(min(shown, len(pairs)))]
    rows = [[scene[None], measurement[None]] for measurement, scene in first]
    compare = partial(measure, protocol=protocol, variant=variant, perceptual=perceptual)
    scores: dict[str, Scores] = {}
    failed: dict[str, MwdnError] = {}
    for name, method in methods.items():
        try:
            scores[name], pictures = _score(name, method, pairs, compare, len(rows), progress)
        except MwdnError as error:
            if len(methods) == 1:
                raise  # with its traceback
            failed[name] = without_traceback(error)
        else:
            for row, picture in zip(rows, pictures, strict=True):
                row.append(picture)
    if not scores:
        raise next(iter(failed.values()))
    reasons = {name: str(error) for name, error in failed.items()}
    return Report(protocol.name, variant or protocol.variant, scores, perceptual.missing, rows, reasons)


def _score(
    name: str,
    method: Method,
    pairs: Pairs,
    compare: Callable[[Scene, Scene], Mapping[str, torch.Tensor]],
    shown: int,
    progress: Callable[[str, int], None] | None,
) -> tuple[Scores, list[Scene]]:
    """Scores of one method on all pairs, and its pictures of the first ``shown`` pairs."""
    peak = _warm_up(method, pairs[0][0][None])
    values: dict[str, list[float]] = {metric: [] for metric in METRICS}
    pictures: list[Scene] = []
    seconds, wrong = [], 0
    for i in range(len(pairs)):
        measurement, scene = pairs[i]
        reconstruction, elapsed = _timed(method, measurement[None])
        seconds.append(elapsed)
        wrong += not reconstruction.isfinite().all()
        for metric, number in compare(reconstruction.cpu(), scene[None]).items():
            values[metric].append(number.item())
        if i < shown:
            pictures.append(reconstruction.cpu())
        if progress:
            progress(name, i)
    if wrong:
        warnings.warn(
            f"`{name}` returned NaN or infinity for {wrong:,} of {len(pairs):,} pictures: its scores mean nothing.",
            stacklevel=4,
        )
    columns = {metric: tuple(column) for metric, column in values.items()}
    return Scores(columns, tuple(seconds), peak, _device(method).type, learnable_numbers(method)), pictures


def _check_pairs(pairs: Pairs) -> None:
    """Check all pairs before the first reconstruction."""
    if not len(pairs):
        raise ParameterError("`pairs` must not be empty: the file holds none. Make it anew with `mwdn import`.")
    brightest = 0.0
    for i in range(len(pairs)):
        pair = pairs[i]
        refuse_non_finite(pair, i)
        brightest = max(brightest, float(pair[1].max()))
    if brightest > MAX_SCENE:
        warnings.warn(
            f"The scenes have values up to {brightest:.3g}, but scores are defined for 0 to 1. Divide the scenes by "
            "their white, and write the file again.",
            stacklevel=4,
        )


def learnable_numbers(method: Method) -> int:
    """Number of parameters of the network inside a method; 0 without a network."""
    network = getattr(method, "method", method)
    return sum(p.numel() for p in network.parameters()) if isinstance(network, nn.Module) else 0


def _device(method: Method) -> torch.device:
    """The ``device`` of a method; the CPU if it has none."""
    return torch.device(getattr(method, "device", "cpu"))


@torch.no_grad()
def _timed(method: Method, measurement: Measurement) -> tuple[Scene, float]:
    """Reconstruct; returns the result and the seconds, transfers to and from the device included."""
    device = _device(method)
    _synchronise(device)
    start = time.perf_counter()
    reconstruction = method(measurement)
    _synchronise(device)
    return reconstruction, time.perf_counter() - start


def _synchronise(device: torch.device) -> None:
    if device.type == "cuda":
        torch.cuda.synchronize(device)


def _warm_up(method: Method, measurement: Measurement) -> int | None:
    """Reconstruct twice to fill caches and settle clocks; returns the peak memory in bytes.

    On a GPU: the peak of torch's allocations, weights included. On a CPU: the rise of the process's peak resident
    memory. Only Linux can reset that peak. Elsewhere it is the rise above all earlier peaks: 0 for a method that needs
    less than one before it.
    """
    device = _device(method)
    if device.type == "cuda":
        torch.cuda.reset_peak_memory_stats(device)
    _reset_peak()
    before = _peak_resident()
    for _ in range(2):
        _timed(method, measurement)
    if device.type == "cuda":
        return torch.cuda.max_memory_allocated(device)
    after = _peak_resident()
    return None if before is None or after is None or device.type != "cpu" else after - before


def _reset_peak() -> None:
    """Reset `_peak_resident` to the memory in use now; see proc_pid_clear_refs(5).

    Memory that earlier methods freed and glibc kept is returned to the system first: reusing it would not count.
    """
    with suppress(OSError, AttributeError, TypeError):
        ctypes.CDLL(None).malloc_trim(0)
    with suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5", encoding="ascii")


def _peak_resident() -> int | None:
    """Peak resident memory of this process in bytes; unknown on Windows."""
    if sys.platform == "win32":
        return None
    import resource

    highest = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return highest if sys.platform == "darwin" else highest * 1024

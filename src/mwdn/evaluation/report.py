"""Results of a comparison: numbers, a table, a contact sheet."""

import json
import math
import statistics
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from rich import box
from rich.markup import escape
from rich.table import Table
from torch import Tensor

from mwdn.errors import UnknownNameError
from mwdn.evaluation.metrics import LARGER_IS_BETTER, METRICS, bootstrap
from mwdn.io.contact_sheets import contact_sheet
from mwdn.io.files import write_json
from mwdn.io.images import write_picture
from mwdn.version import __version__

JSON = "report.json"
SHEET = "comparison.png"

_TITLES = {"psnr": "PSNR / dB", "ssim": "SSIM", "lpips": "LPIPS", "feature_mse": "feature MSE", "mse": "MSE"}
_FORMATS = {"psnr": ".2f", "ssim": ".3f", "lpips": ".3f", "feature_mse": ".4g", "mse": ".3g"}


@dataclass(frozen=True)
class Scores:
    """Results of one method on all pictures.

    Args:
        values: by metric, one number per picture; NaN where missing.
        seconds: for each picture after warm-up, from the measurement in host memory to the reconstruction.
        peak_bytes: memory for one picture, ``None`` if unknown. On a GPU the peak of torch's allocations, weights
            included. On a CPU the rise of the process's memory, without weights.
        device: type of device, cpu or cuda.
        learnable: number of learnable parameters.
    """

    values: dict[str, tuple[float, ...]]
    seconds: tuple[float, ...]
    peak_bytes: int | None
    device: str
    learnable: int

    def summary(self, metric: str, confidence: float = 0.95) -> tuple[float, float, float]:
        """Mean over the pictures and its confidence interval, by `bootstrap`; NaN for a missing metric.

        Raises:
            UnknownNameError: unknown metric.
            ParameterError: `confidence` is outside (0, 1).
        """
        if metric not in self.values:
            raise UnknownNameError("metric", metric, self.values)
        return bootstrap(self.values[metric], confidence)

    @property
    def median_seconds(self) -> float:
        """Median time for one picture."""
        return statistics.median(self.seconds)

    def content(self) -> dict[str, Any]:
        """All numbers, with means and intervals, as plain values for JSON."""
        content = {
            "learnable": self.learnable,
            "device": self.device,
            "peak_bytes": self.peak_bytes,
            "median_seconds": self.median_seconds,
            "mean_low_high": {metric: self.summary(metric) for metric in self.values},
            "values": self.values,
            "seconds": self.seconds,
        }
        return _finite(content)

    @classmethod
    def read(cls, content: Mapping[str, Any]) -> "Scores":
        """Inverse of `content`, except that an infinite PSNR becomes NaN."""
        numbers = {m: tuple(math.nan if v is None else float(v) for v in row) for m, row in content["values"].items()}
        seconds = tuple(map(float, content["seconds"]))
        if not seconds:
            raise ValueError("no picture was measured")
        peak = content["peak_bytes"]
        return cls(numbers, seconds, peak and int(peak), str(content["device"]), int(content["learnable"]))


@dataclass(frozen=True)
class Report:
    """All methods under one protocol.

    Args:
        protocol: name of the part that was compared.
        variant: adjustment of reconstructions before the comparison.
        methods: scores by the method's name.
        missing: metrics that could not be measured, with the reason.
        rows: of the contact sheet, one per picture: scene, measurement, then one reconstruction per method, each
            (1, C, H, W).
        failed: methods without scores, with the reason.
    """

    protocol: str
    variant: str
    methods: dict[str, Scores]
    missing: dict[str, str]
    rows: list[list[Tensor]] = field(repr=False)
    failed: dict[str, str] = field(default_factory=dict)

    @property
    def pictures(self) -> int:
        """Number of pictures compared."""
        return len(next(iter(self.methods.values())).seconds)

    def table(self, more: Mapping[str, Mapping[str, str]] | None = None, *, narrow: bool = False) -> Table:
        """Means with 95 % confidence intervals, the best in bold; time, memory, learnable parameters.

        Args:
            more: further columns: heading to text by method.
            narrow: one number per line, for a terminal of 80 columns.
        """
        more = more or {}
        noun = "picture" if self.pictures == 1 else "pictures"
        what = "the scores" if self.pictures == 1 else "mean [95 % confidence]"
        title = f"{self.pictures:,} {noun}, protocol {self.protocol}, {self.variant}: {what}"
        style: dict[str, Any] = {"box": box.SIMPLE_HEAD, "padding": 0, "show_edge": False, "leading": 1}
        caption = self._missing() or None
        table = Table(title=title, caption=caption, caption_justify="left", **(style if narrow else {}))
        table.add_column("method", overflow="fold")
        measured = [metric for metric in METRICS if metric not in self.missing]
        for heading in (*(_TITLES[metric] for metric in measured), "ms / picture", "memory", "learnable", *more):
            short = heading.replace(" / ", "\n").replace(" ", "\n")
            table.add_column(short if narrow else heading, justify="right", no_wrap=narrow)
        best = {metric: self._best(metric) for metric in measured}
        for name, scores in self.methods.items():
            cells = [_cell(metric, scores, name in best[metric]) for metric in measured]
            cells += [*_costs(scores), *(escape(column.get(name, "")) for column in more.values())]
            table.add_row(escape(name), *(cell.replace(" ", "\n") if narrow else cell for cell in cells))
        return table

    def _missing(self) -> str:
        """One line per reason why metrics are missing."""
        names: dict[str, list[str]] = {}
        for metric, reason in self.missing.items():
            names.setdefault(reason, []).append(_TITLES[metric])
        return "\n".join(f"Without {' and '.join(titles)}: {escape(reason)}" for reason, titles in names.items())

    def json(self) -> str:
        """All numbers as JSON.

        ``null`` stands for a number that is missing, and for the infinite PSNR of a picture without any error.
        """
        return json.dumps(self._content(), indent=2, allow_nan=False)

    def _content(self) -> dict[str, Any]:
        return {
            "version": __version__,
            "torch": torch.__version__,
            "protocol": self.protocol,
            "variant": self.variant,
            "pictures": self.pictures,
            "missing": self.missing,
            "failed": self.failed,
            "methods": {name: scores.content() for name, scores in self.methods.items()},
        }

    def sheet(self) -> Tensor:
        """Contact sheet of the first pictures, (1, 3, H, W) in linear light: scene, measurement, each method.

        NaN and infinity are black.
        """
        rows = [[picture.nan_to_num(0, 0, 0) for picture in row] for row in self.rows]
        return contact_sheet(rows, ["scene", "measurement", *(Path(name).name for name in self.methods)])

    def write(self, out: Path) -> None:
        """Write ``report.json`` and ``comparison.png`` into a folder, atomically.

        Raises:
            ImageError: a file cannot be written.
        """
        write_json(out / JSON, self._content())
        if self.rows:
            write_picture(out / SHEET, self.sheet())

    def _best(self, metric: str) -> set[str]:
        means = {name: statistics.fmean(scores.values[metric]) for name, scores in self.methods.items()}
        numbers = [mean for mean in means.values() if not math.isnan(mean)]
        best = (max if metric in LARGER_IS_BETTER else min)(numbers, default=None)
        return {name for name, mean in means.items() if mean == best}


def _cell(metric: str, scores: Scores, best: bool) -> str:
    mean, low, high = (format(value, _FORMATS[metric]) for value in scores.summary(metric))
    # The backslash keeps rich from parsing the interval as a style. One picture has no interval.
    interval = "" if len(scores.seconds) == 1 else f" \\[{low}, {high}]"
    return f"{f'[bold]{mean}[/bold]' if best else mean}{interval}"


def _costs(scores: Scores) -> tuple[str, str, str]:
    memory = "?" if scores.peak_bytes is None else f"{scores.peak_bytes / 2**20:,.0f} MiB {scores.device}"
    return f"{1000 * scores.median_seconds:.1f}", memory, f"{scores.learnable:,}"


def _finite(content: Any) -> Any:  # noqa: ANN401
    """Replace NaN and infinity, which JSON does not have, by ``None``."""
    if isinstance(content, dict):
        return {key: _finite(value) for key, value in content.items()}
    if isinstance(content, list | tuple):
        return [_finite(value) for value in content]
    return None if isinstance(content, float) and not math.isfinite(content) else content

"""Counters in Prometheus' text format."""

import threading
from collections.abc import Callable, Mapping

MEANINGS = {
    "mwdn_requests_total": ("counter", "Requests answered, by method, route and status."),
    "mwdn_reconstructions_total": ("counter", "Reconstructions that have ended, by method and outcome."),
    "mwdn_reconstruction_seconds_sum": ("counter", "Seconds of all reconstructions, by method."),
    "mwdn_uploaded_bytes_total": ("counter", "Bytes of captures and PSFs."),
    "mwdn_jobs_waiting": ("gauge", "Requests that wait for their turn."),
    "mwdn_jobs_running": ("gauge", "Reconstructions in progress."),
    "mwdn_live_frames_total": ("counter", "Live frames reconstructed."),
    "mwdn_live_dropped_total": ("counter", "Live frames that a newer one replaced, or that the camera lost."),
    "mwdn_live_seconds_total": ("counter", "Seconds for live frames, by stage: correct, reconstruct, encode."),
    "mwdn_live_viewers": ("gauge", "Pages that show the live picture."),
}


class Metrics:
    """Counts, from any thread. A gauge is a function that `render` calls."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._counts: dict[tuple[str, tuple[tuple[str, str], ...]], float] = {}
        self.gauges: dict[str, Callable[[], float]] = {}

    def add(self, name: str, amount: float | int = 1, **labels: str) -> None:
        """Add to a counter of `MEANINGS`."""
        with self._lock:
            key = name, tuple(sorted(labels.items()))
            self._counts[key] = self._counts.get(key, 0) + amount

    def render(self) -> str:
        """All counters and gauges, as text."""
        with self._lock:
            counts = dict(self._counts)
        lines = []
        for name, (kind, meaning) in MEANINGS.items():
            lines += [f"# HELP {name} {meaning}", f"# TYPE {name} {kind}"]
            values = {labels: value for (other, labels), value in sorted(counts.items()) if other == name}
            if name in self.gauges:
                values[()] = self.gauges[name]()
            lines += [f"{name}{_labels(dict(labels))} {value:g}" for labels, value in (values or {(): 0}).items()]
        return "\n".join(lines) + "\n"


def _labels(labels: Mapping[str, str]) -> str:
    signs = str.maketrans({"\\": r"\\", '"': r"\"", "\n": r"\n"})
    parts = [f'{key}="{value.translate(signs)}"' for key, value in labels.items()]
    return f"{{{','.join(parts)}}}" if parts else ""

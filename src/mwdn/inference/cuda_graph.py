"""CUDA graphs: record a computation on a GPU once and replay it."""

import logging
from collections.abc import Callable
from threading import Lock

import torch
from torch import Tensor

_LOCK = Lock()
"""One thread records or replays at a time: a replay reads and writes the same memory for every caller."""


class CudaGraph:
    """A computation recorded for inputs of these shapes; a replay launches its hundreds of kernels at once.

    A computation that cannot be recorded runs normally, after a warning that says why.
    """

    def __init__(self, calculate: Callable[..., Tensor], *inputs: Tensor) -> None:
        self.calculate = calculate
        self.graph: torch.cuda.CUDAGraph | None = None
        self.inputs = [each.clone() for each in inputs]
        with _LOCK:
            self._record()

    def _record(self) -> None:
        stream = torch.cuda.Stream()  # type: ignore[no-untyped-call]
        stream.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(stream):
            for _ in range(3):  # warm-up: libraries choose algorithms and plan transforms
                self.calculate(*self.inputs)
        current = torch.cuda.current_stream()
        current.wait_stream(stream)
        graph = torch.cuda.CUDAGraph()
        try:
            # torch's default capture stream belongs to the first GPU used. Other threads may use the GPU meanwhile.
            with torch.cuda.graph(graph, stream=stream, capture_error_mode="thread_local"):
                self.result = self.calculate(*self.inputs)
        except RuntimeError as error:
            torch.cuda.set_stream(current)  # a failed capture leaves its stream current
            logging.getLogger(__name__).warning("Not recorded as a CUDA graph, so slower: %s", error)
            return
        self.graph = graph

    def __call__(self, *inputs: Tensor) -> Tensor:
        """Result for inputs of the recorded shapes. Threads may call it, in the same CUDA stream."""
        if self.graph is None:
            return self.calculate(*inputs)
        with _LOCK:
            for recorded, given in zip(self.inputs, inputs, strict=True):
                recorded.copy_(given)
            self.graph.replay()
            return self.result.clone()

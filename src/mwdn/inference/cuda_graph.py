"""CUDA graphs: record a computation on a GPU once and replay it."""

import logging
from collections.abc import Callable

import torch
from torch import Tensor


class CudaGraph:
    """A computation recorded for inputs of these shapes; a replay launches its hundreds of kernels at once.

    A computation that cannot be recorded runs normally, after a warning that says why.
    """

    def __init__(self, calculate: Callable[..., Tensor], *inputs: Tensor) -> None:
        self.calculate = calculate
        self.graph: torch.cuda.CUDAGraph | None = None
        self.inputs = [each.clone() for each in inputs]
        stream = torch.cuda.Stream()  # type: ignore[no-untyped-call]
        stream.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(stream):
            for _ in range(3):  # warm-up: libraries choose algorithms and plan transforms
                calculate(*self.inputs)
        current = torch.cuda.current_stream()
        current.wait_stream(stream)
        graph = torch.cuda.CUDAGraph()
        try:
            # torch's default capture stream belongs to the first GPU used. Other threads may use the GPU meanwhile.
            with torch.cuda.graph(graph, stream=stream, capture_error_mode="thread_local"):
                self.result = calculate(*self.inputs)
        except RuntimeError as error:
            torch.cuda.set_stream(current)  # a failed capture leaves its stream current
            logging.getLogger(__name__).warning("Not recorded as a CUDA graph, so slower: %s", error)
            return
        self.graph = graph

    def __call__(self, *inputs: Tensor) -> Tensor:
        """Result for inputs of the recorded shapes."""
        if self.graph is None:
            return self.calculate(*inputs)
        for recorded, given in zip(self.inputs, inputs, strict=True):
            recorded.copy_(given)
        self.graph.replay()
        return self.result.clone()

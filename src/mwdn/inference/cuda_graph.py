"""CUDA graphs: a calculation on a GPU is recorded once and replayed."""

from collections.abc import Callable

import torch
from torch import Tensor


class CudaGraph:
    """A calculation on a GPU, recorded for one shape and replayed: its hundreds of kernels start as one."""

    def __init__(self, calculate: Callable[[Tensor], Tensor], measurement: Tensor) -> None:
        self.calculate = calculate
        self.graph: torch.cuda.CUDAGraph | None = None
        self.measurement = measurement.clone()
        stream = torch.cuda.Stream()  # type: ignore[no-untyped-call]
        stream.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(stream):
            for _ in range(3):  # libraries choose their algorithms and plan their transforms
                calculate(self.measurement)
        current = torch.cuda.current_stream()
        current.wait_stream(stream)
        graph = torch.cuda.CUDAGraph()
        try:
            # torch's own stream for this is of whichever GPU recorded first. Other threads may read or judge meanwhile.
            with torch.cuda.graph(graph, stream=stream, capture_error_mode="thread_local"):
                self.result = calculate(self.measurement)
        except RuntimeError:  # something that cannot be recorded: calculate each time
            torch.cuda.set_stream(current)  # a recording that fails leaves its own
            return
        self.graph = graph

    def __call__(self, measurement: Tensor) -> Tensor:
        """Result for a measurement of the recorded shape."""
        if self.graph is None:
            return self.calculate(measurement)
        self.measurement.copy_(measurement)
        self.graph.replay()
        return self.result.clone()

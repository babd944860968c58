"""A recorded computation, without a GPU: what a replay reads and writes is the same for every caller."""

import sys
from concurrent.futures import ThreadPoolExecutor

import torch

from mwdn.inference.cuda_graph import CudaGraph


class Replay:
    """A graph that doubles its input."""

    def __init__(self, graph):
        self.graph = graph

    def replay(self):
        self.graph.result.copy_(2 * self.graph.inputs[0])


def test_threads_get_their_own_results():
    """One got the picture of another one's measurement."""
    graph = CudaGraph.__new__(CudaGraph)
    graph.inputs, graph.result = [torch.zeros(1, 1, 8, 8)], torch.zeros(1, 1, 8, 8)
    graph.graph = Replay(graph)
    interval = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    try:
        with ThreadPoolExecutor(4) as threads:
            results = list(threads.map(lambda number: graph(torch.full((1, 1, 8, 8), float(number))), range(400)))
    finally:
        sys.setswitchinterval(interval)
    for number, result in enumerate(results):
        assert (result == 2 * number).all()

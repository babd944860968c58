"""Every method under one protocol: trained alike, scored alike, on one page."""

from mwdn.benchmark.recipe import Benchmark, read_benchmark
from mwdn.benchmark.run import Watch, run

__all__ = ["Benchmark", "Watch", "read_benchmark", "run"]

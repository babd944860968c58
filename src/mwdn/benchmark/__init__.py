"""Benchmark: train, score and compare every method of a recipe under one protocol, and write one page."""

from mwdn.benchmark.recipe import Benchmark
from mwdn.benchmark.recipe_reader import read_benchmark
from mwdn.benchmark.run import Watch, run

__all__ = ["Benchmark", "Watch", "read_benchmark", "run"]

"""Pairs of a measurement and a scene: recorded, imported or simulated."""

from mwdn.data.importers import import_pairs, read_pairs
from mwdn.data.pairs import PairFile
from mwdn.data.splits import split

__all__ = ["PairFile", "import_pairs", "read_pairs", "split"]

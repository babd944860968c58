"""Pairs of measurement and scene: recorded, imported, simulated."""

from mwdn.data.importers import import_pairs, read_pairs
from mwdn.data.pairs import PairFile
from mwdn.data.splits import split

__all__ = ["PairFile", "import_pairs", "read_pairs", "split"]

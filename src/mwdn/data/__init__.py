"""Pictures and frames in and out of files, in linear light; files of pairs and their parts."""

from mwdn.data.images import read_frame, read_picture, srgb_decode, srgb_encode, write_linear, write_picture
from mwdn.data.importers import import_pairs, read_pairs
from mwdn.data.pairs import PairFile
from mwdn.data.splits import split
from mwdn.data.writing import atomic

__all__ = [
    "PairFile",
    "atomic",
    "import_pairs",
    "read_frame",
    "read_pairs",
    "read_picture",
    "split",
    "srgb_decode",
    "srgb_encode",
    "write_linear",
    "write_picture",
]

"""Decompress the strips and tiles of TIFF files; damage is an error. Decoders in libtiff leave damaged parts black."""

import zlib
from collections.abc import Callable, Iterator

import numpy as np
from jaxtyping import Shaped

from mwdn.errors import ImageError

Codec = Callable[[bytes, int], bytes]
"""Decompresses data to a number of bytes at most."""

Numbers = Shaped[np.ndarray, "..."]

_CLEAR, _END, _FIRST = 256, 257, 258
_MAX_CODES = 4096 - _FIRST + 1
"""Codes between two clear codes: the first one adds no entry to the table of 4,096."""

# Code k is 9 bits wide until the table has 511 entries: it has 258, and each code but the first adds one; and so on.
_WIDTHS = np.select([np.arange(_MAX_CODES + 1) <= 2**bits - _FIRST - 1 for bits in (9, 10, 11)], [9, 10, 11], 12)
_STARTS = np.concatenate([[0], np.cumsum(_WIDTHS)[:-1]])


def stored(data: bytes, most: int) -> bytes:
    """No compression."""
    return data[:most]


def inflate(data: bytes, most: int) -> bytes:
    """Deflate with its checksum."""
    stream = zlib.decompressobj()
    try:
        numbers = stream.decompress(data, most)
        if not stream.eof:
            stream.decompress(stream.unconsumed_tail, 1)  # up to the checksum, which is compared at the end
    except zlib.error as error:
        raise ImageError(f"is damaged: {error}.") from error
    if not stream.eof:
        raise ImageError("is damaged: compressed data has no end.")
    return numbers


def unpack_bits(data: bytes, most: int) -> bytes:
    """PackBits: a byte n below 128 precedes n + 1 bytes, one above 128 a byte that is repeated 257 - n times."""
    numbers, position = bytearray(), 0
    while position < len(data) and len(numbers) < most:
        head = data[position]
        if head < 128:
            numbers += data[position + 1 : position + 2 + head]
            position += 2 + head
        else:
            numbers += data[position + 1 : position + 2] * (257 - head if head > 128 else 0)
            position += 2 if head > 128 else 1
    return bytes(numbers[:most])


def unpack_lzw(data: bytes, most: int) -> bytes:
    """LZW as in TIFF 6.0, section 13: codes of 9 to 12 bits, the highest bit first."""
    return b"".join(_strings(codes, lengths) for codes, lengths in _tables(data, most))[:most]


def lzw_size(data: bytes, most: int) -> int:
    """Number of bytes that `unpack_lzw` returns, found faster: damage is refused before memory is used."""
    return min(most, sum(int(lengths.sum()) for _, lengths in _tables(data, most)))


def _tables(data: bytes, most: int) -> Iterator[tuple[Numbers, Numbers]]:
    """The codes between each two clear codes, and the lengths of their strings."""
    padded = np.frombuffer(data + bytes(2 * _MAX_CODES), np.uint8)
    if int.from_bytes(data[:2]) >> 7 != _CLEAR:
        raise ImageError("is damaged: LZW data does not begin with a clear code, or is of a kind before 1992.")
    size, bit, end = 0, 9, _CLEAR
    while size < most and end == _CLEAR:
        codes, end = _codes(padded, bit, 8 * len(data))
        bit += int(_STARTS[len(codes)] + _WIDTHS[len(codes)])
        if end == _CLEAR and not len(codes):  # a long run of them would take long
            raise ImageError("is damaged: LZW data has an empty table.")
        lengths = _lengths(codes)
        size += int(lengths.sum())
        yield codes, lengths


def _codes(data: Numbers, bit: int, bits: int) -> tuple[Numbers, int]:
    """The codes from a bit on, up to the next clear code, end code or end of the data, and what ends them."""
    at = bit + _STARTS
    byte = at >> 3
    words = data[byte].astype(np.int64) << 16 | data[byte + 1].astype(np.int64) << 8 | data[byte + 2]
    codes = words >> (24 - (at & 7) - _WIDTHS) & (1 << _WIDTHS) - 1
    codes[at + _WIDTHS > bits] = _END
    ends = np.flatnonzero((codes == _CLEAR) | (codes == _END))
    if not ends.size:
        raise ImageError("is damaged: LZW data has no clear code after 4,096 entries.")
    return codes[: ends[0]], int(codes[ends[0]])


def _lengths(codes: Numbers) -> Numbers:
    """Length of each code's string: entry 258 + k is one byte longer than the string of code k."""
    jump = _parents(codes)
    if (jump >= np.arange(len(codes))).any():  # a link to itself would be followed forever
        raise ImageError("is damaged: an LZW code is not in its table.")
    lengths = (jump >= 0).astype(np.int64)
    while (copies := jump >= 0).any():  # each step follows twice as many links as the one before
        lengths = lengths + np.where(copies, lengths[jump], 0)
        jump = np.where(copies, jump[jump], -1)
    return lengths + 1


def _parents(codes: Numbers) -> Numbers:
    """Number of the code whose string begins each string; below 0 for a single byte."""
    return np.where(codes >= _FIRST, codes - _FIRST, -1)


def _strings(codes: Numbers, lengths: Numbers) -> bytes:
    """Bytes of the codes of one table.

    The string of entry 258 + k is that of code k and the first byte of code k + 1: both are in the output already, one
    after the other. So a code copies a piece of the output, and each byte is found by following copies to a literal.
    """
    starts, parents = np.cumsum(lengths) - lengths, _parents(codes)
    source = np.where(parents >= 0, starts[parents], starts)
    source = np.arange(lengths.sum()) + np.repeat(source - starts, lengths)
    while (source != (further := source[source])).any():
        source = further
    return np.repeat(codes.astype(np.uint8), lengths)[source].tobytes()


CODECS: dict[int, Codec] = {1: stored, 8: inflate, 32946: inflate, 5: unpack_lzw, 32773: unpack_bits}
"""By TIFF's number of the compression."""

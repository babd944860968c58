"""Read TIFF files: tifffile parses the tags; strips and tiles are decompressed here, each complete or an error."""

import itertools
import re
import struct
from typing import Any, BinaryIO, NamedTuple

import numpy as np

from mwdn.errors import ImageError, shown
from mwdn.io.headers import COPY_AGAIN, check_decoded
from mwdn.io.tiff_codecs import CODECS, lzw_size
from mwdn.types import Frame

MAX_PAGES = 64
"""Most pages of a file: the picture, and smaller copies of it."""

_DNG_VERSION = 50706
"""Tag of Adobe's raw format: its numbers mean little without the black level and mosaic that `mwdn.io.raw` reads."""

MAX_PARTS = 2**17
"""Most strips and tiles: 131,072."""

_OTHER_FILE = re.compile(r"""<!DOCTYPE|<!ENTITY|BinaryOnly|FileName\s*=\s*["']""", re.IGNORECASE)


class TiffPicture(NamedTuple):
    """The picture of a TIFF.

    Args:
        numbers: (H, W), (H, W, C) or (N, H, W) as stored.
        orientation: of EXIF, 1 to 8.
    """

    numbers: Frame
    orientation: int


class _Part(NamedTuple):
    """A strip or tile.

    Args:
        place: in the frame: plane, rows, columns.
        shape: (H, W, C).
        size: bytes of its numbers.
        full: bytes of the other strips' numbers: some programs fill the last strip up.
        offset: position in the file.
        stored: bytes in the file.
    """

    place: tuple[int, slice, slice]
    shape: tuple[int, int, int]
    size: int
    full: int
    offset: int
    stored: int


def read_tiff(file: BinaryIO, check: Any) -> TiffPicture:  # noqa: ANN401
    """Read the picture of a TIFF.

    Args:
        file: opened for reading.
        check: called with shape and dtype before anything is decoded; raises `ImageError` for a picture that it does
            not accept.

    Raises:
        ImageError: damaged in any strip or tile, a stack, of another compression, or its picture is in another file;
            the message does not name the file.
    """
    import tifffile

    pages = _count_pages(file)
    file.seek(0)
    with tifffile.TiffFile(file, name="", is_ome=False) as tiff:
        every: list[Any] = [tiff.pages[number] for number in range(pages)]
        if _DNG_VERSION in every[0].tags:
            raise ImageError("is a camera's raw file (DNG). Export it as TIFF; commands also read it as .dng.")
        first = max(every, key=lambda page: page.imagelength * page.imagewidth)  # smaller ones are copies of it
        _check_page(first)
        planes = [page for page in every if page.shape == first.shape]
        imagej = tiff.imagej_metadata or {}
        if len(planes) > 1 and not (imagej.get("channels") == len(planes) == 3):
            raise ImageError(f"is a stack of {len(planes)} pictures; a frame is one. Save each as its own file.")
        if imagej.get("images", len(planes)) != len(planes):
            raise ImageError(
                f"is a stack of {shown(imagej['images'])} pictures; a frame is one. Save each as its own file."
            )
        if len(planes) == 1:
            check(_shape(first), first.dtype)
            return TiffPicture(_decode(first), int(first.tags.valueof(274, 1)))
        check((*first.shape, 3), first.dtype)
        return TiffPicture(np.stack([_decode(page) for page in planes], -1), 1)


def _count_pages(file: BinaryIO) -> int:
    """Number of pages; the chain of their directories must be whole, which tifffile does not check."""
    file.seek(0)
    head = file.read(16)
    order = "<" if head[:2] == b"II" else ">"
    big = struct.unpack(order + "H", head[2:4])[0] == 43
    count, entry, link = (order + "Q", 20, order + "Q") if big else (order + "H", 12, order + "I")
    try:
        offset, seen = struct.unpack_from(link, head, 8 if big else 4)[0], set[int]()
        while offset and len(seen) <= MAX_PAGES:
            if offset in seen:
                raise ImageError(f"is damaged: its list of pages leads in a circle. {COPY_AGAIN}")
            seen.add(offset)
            file.seek(offset)
            entries = struct.unpack(count, file.read(struct.calcsize(count)))[0]
            file.seek(offset + struct.calcsize(count) + entry * entries)
            offset = struct.unpack(link, file.read(struct.calcsize(link)))[0]
    except (struct.error, OSError, OverflowError, ValueError) as error:
        if isinstance(error, ImageError):
            raise
        raise ImageError(f"is cut off: its list of pages leads past its end. {COPY_AGAIN}") from error
    if not seen or len(seen) > MAX_PAGES:
        many = f"a stack of more than {MAX_PAGES} pages; save each picture as its own file"
        raise ImageError(f"is {many}." if seen else f"is cut off: it has no page. {COPY_AGAIN}")
    return len(seen)


def _shape(page: Any) -> tuple[int, ...]:  # noqa: ANN401
    """(H, W) or (H, W, C)."""
    return (*page.shape[1:], page.shape[0]) if page.planarconfig == 2 and page.samplesperpixel > 1 else page.shape


def _check_page(page: Any) -> None:  # noqa: ANN401
    if _OTHER_FILE.search(page.description[:1_000_000]) and "<OME" in page.description:
        raise ImageError("is an OME-TIFF that names other files, which are not read. Save its picture as one TIFF.")
    if page.photometric not in (1, 2, 32803, 34892):  # grey, RGB, two kinds of raw mosaic
        colours = getattr(page.photometric, "name", page.photometric)
        raise ImageError(f"stores its colours as {colours}. Save it as RGB, or as grey with black at 0.")
    if page.compression not in CODECS:
        name = getattr(page.compression, "name", "an unknown kind")
        raise ImageError(
            f"is compressed by {name} ({int(page.compression)}), which is not read. Save it uncompressed, or with "
            "Deflate, LZW or PackBits."
        )
    if page.predictor not in (1, 2, 3) or page.fillorder != 1 or page.imagedepth != 1:
        raise ImageError(
            f"has a predictor ({page.predictor:d}), order of bits ({page.fillorder:d}) or depth ({page.imagedepth}) "
            "that is not read. Save it again as plain TIFF."
        )


def _decode(page: Any) -> Frame:  # noqa: ANN401
    """Numbers of a page, (H, W) or (H, W, C)."""
    parts = _parts(page)
    file, compression = page.parent.filehandle, int(page.compression)
    if compression == 5:
        for part in parts:
            _check_size(part, lzw_size(_read(file, part), part.full + 1))
    planes = page.samplesperpixel if page.planarconfig == 2 else 1
    frame = np.empty((planes, page.imagelength, page.imagewidth, page.samplesperpixel // planes), page.dtype)
    for part in parts:
        area = frame[part.place]
        data = CODECS[compression](_read(file, part), part.size if compression == 1 else part.full + 1)
        _check_size(part, len(data))
        predictor = 1 if compression in (1, 32773) else int(page.predictor)
        numbers = _undo(predictor, data[: part.size], part.shape, page.dtype.newbyteorder(page.parent.byteorder))
        area[:] = numbers[: area.shape[0], : area.shape[1]]
    frame = frame[0] if planes == 1 else np.moveaxis(frame[..., 0], 0, -1)
    return frame if len(page.shape) == 3 else frame[..., 0]


def _parts(page: Any) -> list[_Part]:  # noqa: ANN401
    """Strips or tiles of a page, whose number and size must be possible."""
    if page.bitspersample != 8 * page.dtype.itemsize:
        raise ImageError(f"packs numbers of {page.bitspersample} bits. Save it with 8 or 16 bits.")
    rows, columns, samples = page.imagelength, page.imagewidth, page.samplesperpixel
    height, width = (page.tilelength, page.tilewidth) if page.is_tiled else (min(page.rowsperstrip, rows), columns)
    planes = samples if page.planarconfig == 2 else 1
    pixel, available = page.dtype.itemsize * samples // planes, page.parent.filehandle.size
    check_decoded(rows * columns * samples * page.dtype.itemsize, available)
    check_decoded(height * width * pixel, available)
    number = planes * -(-rows // height) * -(-columns // width)
    if not len(page.dataoffsets) == len(page.databytecounts) == number <= MAX_PARTS:
        found = f"has {len(page.dataoffsets):,} strips or tiles and needs {number:,}, at most {MAX_PARTS:,}"
        raise ImageError(f"is damaged: it {found}. {COPY_AGAIN}")
    corners = itertools.product(range(planes), range(0, rows, height), range(0, columns, width))
    parts = []
    for (plane, top, left), offset, stored in zip(corners, page.dataoffsets, page.databytecounts, strict=True):
        shape = (height if page.is_tiled else min(height, rows - top), width, samples // planes)
        place = (plane, slice(top, top + height), slice(left, left + width))
        parts.append(_Part(place, shape, shape[0] * width * pixel, height * width * pixel, offset, stored))
    return parts


def _read(file: Any, part: _Part) -> bytes:  # noqa: ANN401
    file.seek(part.offset)
    data = file.read(part.stored)
    if len(data) < part.stored or not part.stored:
        raise ImageError(f"is cut off: a strip or tile at byte {part.offset:,} is missing. {COPY_AGAIN}")
    return data


def _check_size(part: _Part, found: int) -> None:
    if found not in (part.size, part.full):
        has = f"{found:,} bytes" if found < part.full else "more"
        raise ImageError(f"is damaged: a strip or tile has {has} where {part.size:,} bytes are needed. {COPY_AGAIN}")


def _undo(predictor: int, data: bytes, shape: tuple[int, int, int], dtype: Any) -> Frame:  # noqa: ANN401
    """Numbers of a strip or tile, (H, W, C): differences of neighbours added up (TIFF 6.0, section 14)."""
    height, _, samples = shape
    if predictor == 3:  # of floats: differences of bytes, the highest byte of a row's numbers first
        encoded = np.frombuffer(data, np.uint8).reshape(height, -1, samples)
        rows = np.cumsum(encoded, axis=1, dtype=np.uint8).reshape(height, dtype.itemsize, -1)
        return np.ascontiguousarray(rows.swapaxes(1, 2)).view(dtype.newbyteorder(">")).reshape(shape)
    numbers = np.frombuffer(data, dtype).reshape(shape)
    if predictor == 2:
        whole = np.dtype(f"u{dtype.itemsize}")
        numbers = numbers.astype(dtype.newbyteorder("=")).view(whole)
        numbers = np.cumsum(numbers, axis=1, dtype=whole).view(dtype.newbyteorder("="))
    return numbers

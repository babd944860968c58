"""Files of every format that is read, damaged by a seeded generator, and what the readers make of them.

``python tests/fuzz/pictures.py --cases 80`` prints the table of docs/reliability.md.
"""

import argparse
import json
import os
import re
import struct
import subprocess
import sys
import tempfile
import time
import zlib
from collections import Counter
from collections.abc import Callable, Iterator
from itertools import islice
from pathlib import Path
from typing import Any

import cv2
import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))
from driver import damaged, outcome

from image_files import chunk, dng, encoded, npy, png16, tiff
from mwdn.errors import MwdnError
from mwdn.io.images import read_frame
from mwdn.io.toml import read_toml

try:
    from mwdn.io.reading import read_json
except ImportError:  # before issue 29

    def read_json(path: Path) -> Any:
        return json.loads(path.read_text())


VISIBLE = 8
"""A picture differs visibly if a channel of any pixel is off by more than this, of 255."""


def scene(dtype: str = "uint8", channels: int = 3) -> np.ndarray:
    """64 x 96: soft blobs with a little noise, as a capture of a lensless camera."""
    random = np.random.default_rng(29)
    soft = cv2.GaussianBlur(random.random((64, 96, 3)), (0, 0), 3)
    soft = (soft - soft.min()) / np.ptp(soft) * 0.9 + random.random(soft.shape) * 0.05
    soft = soft[..., :channels] if channels == 3 else soft[..., 0]
    if dtype.startswith("f"):
        return soft.astype(dtype)
    return (soft * np.iinfo(dtype).max).astype(dtype)


def cv2_tiff(array: np.ndarray, compression: int) -> bytes:
    return cv2.imencode(".tif", array, [cv2.IMWRITE_TIFF_COMPRESSION, compression])[1].tobytes()


def _files() -> dict[str, bytes]:
    pictures = {
        "grey.png": encoded(scene(channels=1), "PNG"),
        "rgb.png": encoded(scene(), "PNG"),
        "rgb16.png": png16(scene("uint16")),
        "crafted.png": encoded(scene(), "PNG"),
        "baseline.jpg": encoded(scene(), "JPEG", quality=90),
        "grey.jpg": encoded(scene(channels=1), "JPEG", quality=90),
        "progressive.jpg": encoded(scene(), "JPEG", quality=90, progressive=True),
        "restart.jpg": encoded(scene(), "JPEG", quality=90, restart_marker_rows=1),
        "lossy.webp": encoded(scene(), "WebP"),
        "lossless.webp": encoded(scene(), "WebP", lossless=True),
        "a.bmp": encoded(scene(), "BMP"),
        "a.ppm": encoded(scene(), "PPM"),
        "a.pgm": encoded(scene("uint16", 1), "PPM"),
        "u1.npy": npy(scene()),
        "f4.npy": npy(scene("f4")),
        "plain.tif": tiff(scene("uint16"), photometric="rgb"),
        "tiled.tif": tiff(scene("uint16"), photometric="rgb", tile=(16, 16)),
        "deflate.tif": tiff(scene("uint16"), photometric="rgb", compression="zlib"),
        "predicted.tif": tiff(scene("uint16"), photometric="rgb", compression="zlib", predictor=True),
        "float.tif": tiff(scene("f4"), photometric="rgb"),
        "lzw.tif": cv2_tiff(scene("uint16"), 5),
        "lzw8.tif": encoded(scene(), "TIFF", compression="tiff_lzw"),
        "packbits.tif": encoded(scene(), "TIFF", compression="packbits"),
        "jpeg.tif": encoded(scene(channels=1), "TIFF", compression="jpeg"),
        "mosaic.dng": dng((scene("uint16", 1) >> 6).astype(np.uint16)),
    }
    text = '# a recipe\n[network]\nname = "mwdn"\nchannels = [32, 64]\n[training]\nsteps = 100\nlr = 1e-4\n'
    return pictures | {"a.toml": text.encode(), "a.json": json.dumps({"seconds": 12.5, "run": [1, "a", None]}).encode()}


FILES = _files()
"""Content by name, whole and valid."""


def with_tag(data: bytes, tag: int, value: int) -> bytes:
    """A little-endian TIFF with another value of one of its tags of 16 or 32 bits, stored as 32."""
    (start,) = struct.unpack_from("<I", data, 4)
    entries = range(start + 2, start + 2 + 12 * struct.unpack_from("<H", data, start)[0], 12)
    entry = next(at for at in entries if data[at : at + 2] == struct.pack("<H", tag))
    return data[: entry + 2] + struct.pack("<HII", 4, 1, value) + data[entry + 12 :]


def _squeezed_tiff(dtype: str, side: int) -> bytes:
    """Zeros by Deflate: 1,000 bytes become one."""
    return tiff(np.zeros((side, side), dtype), compression="zlib", rowsperstrip=side)


def _black_png(side: int) -> bytes:
    stream = zlib.compressobj(1)
    rows = b"".join(stream.compress(bytes(1 + 6 * side)) for _ in range(side)) + stream.flush()
    header = chunk(b"IHDR", struct.pack(">IIBBBBB", side, side, 16, 2, 0, 0, 0))
    return b"\x89PNG\r\n\x1a\n" + header + chunk(b"IDAT", rows) + chunk(b"IEND", b"")


def _scans(count: int) -> bytes:
    data = encoded(np.zeros((4096, 4096), np.uint8), "JPEG", progressive=True)
    return data[:-2] + count * data[data.rindex(b"\xff\xda") : -2] + b"\xff\xd9"


def _claimed_jpeg() -> bytes:
    data = encoded(scene(), "JPEG")
    size = data.index(b"\xff\xc0") + 5
    return data[:size] + struct.pack(">HH", 16384, 16384) + data[size + 4 :]


def _claimed_npy() -> bytes:
    head = npy(np.zeros((1, 1, 3)))
    return head.replace(b"(1, 1, 3), }            ", b"(16384, 16384, 3), }    ")


BOMBS: dict[str, tuple[Callable[[], bytes], int]] = {
    "float64.tif": (lambda: _squeezed_tiff("float64", 14000), 0),
    "black.png": (lambda: _black_png(13000), 0),
    "scans.jpg": (lambda: _scans(800), 0),
    "claimed.jpg": (_claimed_jpeg, 0),
    "claimed.npy": (_claimed_npy, 7 * 2**30),
    "sparse.png": (lambda: FILES["rgb.png"][:-12], 5 * 2**30),
    "sparse.jpg": (lambda: FILES["baseline.jpg"][:-2], 5 * 2**30),
    "sparse.toml": (lambda: b"#", 5 * 2**30),
    "sparse.json": (lambda: b"[", 5 * 2**30),
    "sparse.dng": (lambda: FILES["mosaic.dng"], 5 * 2**30),
    "claimed.dng": (lambda: with_tag(with_tag(FILES["mosaic.dng"], 256, 40000), 257, 40000), 0),
    "deep.toml": (lambda: b"a = " + b"[" * 100_000, 0),
    "deep.json": (lambda: b"[" * 100_000, 0),
    "keys.toml": (lambda: b"a." * 200_000 + b"a = 1", 0),
}
"""Files made to fill the memory or to take long: their content, and the length to which zeros fill them (no disk)."""

SLOW_TO_MAKE = {"float64.tif", "black.png", "scans.jpg"}


def write_bomb(path: Path) -> None:
    content, length = BOMBS[path.name]
    path.write_bytes(content())
    if length:
        os.truncate(path, length)


def repaired(png: bytes) -> bytes:
    """A PNG with right checksums, so that its damage reaches the decoder."""
    content, at = bytearray(png), 8
    while at + 12 <= len(content):
        end = at + 8 + int.from_bytes(content[at : at + 4])
        content[end : end + 4] = struct.pack(">I", zlib.crc32(content[at + 4 : end]))
        at = end + 4
    return bytes(content)


def cases(name: str, seed: int = 29) -> Iterator[bytes]:
    """Damaged copies of a file, the same ones for the same seed."""
    random = np.random.default_rng([seed, *name.encode()])
    while True:
        data = damaged(FILES[name], random)
        data = repaired(data) if name.startswith("crafted") else data
        if data != FILES[name]:
            yield data


def read(path: Path) -> Any:
    """Read a file by the reader of its suffix."""
    if path.suffix == ".toml":
        return read_toml(path)
    if path.suffix == ".json":
        return read_json(path)
    return read_frame(path)


def compare(content: Any, reference: Any) -> str:
    """``taken``; of pictures ``equal``, ``similar`` (off by `VISIBLE` at most) or ``different``."""
    if not isinstance(reference, np.ndarray):
        return "taken"
    if content.shape != reference.shape or content.dtype != reference.dtype:
        return "different"
    most = 255.0 if reference.dtype.kind == "f" else 255.0 / np.iinfo(reference.dtype).max
    off = np.abs(content.astype(float) - reference.astype(float)).max() * most
    return "equal" if off == 0 else "similar" if off <= VISIBLE else "different"


def differs(data: bytes, reference: np.ndarray) -> bool:
    """Whether OpenCV decodes something that looks different, or nothing."""
    pixels = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    if pixels is None or np.atleast_3d(pixels).shape != reference.shape:
        return True
    pixels = np.atleast_3d(pixels)[..., ::-1]
    return bool(np.abs(pixels.astype(int) - reference.astype(int)).max() > VISIBLE)


class StandardError:
    """What C libraries write to file descriptor 2."""

    def __enter__(self) -> "StandardError":
        self.saved, self.file = os.dup(2), tempfile.TemporaryFile()
        os.dup2(self.file.fileno(), 2)
        return self

    def __exit__(self, *args: object) -> None:
        os.dup2(self.saved, 2)
        os.close(self.saved)
        self.file.seek(0)
        self.lines = self.file.read().splitlines()
        self.file.close()


def measure(name: str, count: int, folder: Path) -> tuple[Counter[str], int, float, int]:
    """Outcomes of damaged copies, lines on the terminal, longest time in s, and JPEGs that look different."""
    path = folder / name
    path.write_bytes(FILES[name])
    reference = read(path)
    outcomes: Counter[str] = Counter()
    slowest, visible, taken = 0.0, 0, []
    with StandardError() as terminal:
        for data in islice(cases(name), count):
            path.write_bytes(data)
            start = time.perf_counter()
            result = outcome(lambda: taken.append(read(path)), path)
            slowest = max(slowest, time.perf_counter() - start)
            outcomes[compare(taken.pop(), reference) if result == "taken" else result[:90]] += 1
    if path.suffix == ".jpg":
        with StandardError():
            visible = sum(differs(data, reference) for data in islice(cases(name), count))
    return outcomes, len(terminal.lines), slowest, visible


def explode(name: str, folder: Path) -> str:
    """What becomes of a bomb in a process of its own, its time and its memory."""
    path = folder / name
    write_bomb(path)
    code = f"from pictures import *; judge(Path({str(path)!r}))"
    call = [sys.executable, "-c", code]
    process = subprocess.run(call, cwd=Path(__file__).parent, capture_output=True, text=True, check=False)
    path.unlink()
    return process.stdout.strip() or process.stderr.strip()[-100:] or f"exit code {process.returncode}"


def judge(path: Path) -> None:
    """Print what becomes of a file without limits, as a reader of before issue 29 needs them."""
    start = time.perf_counter()
    try:
        read(path)
        result = "taken"
    except Exception as error:
        result = "refused" if isinstance(error, MwdnError) else type(error).__name__
    seconds = time.perf_counter() - start
    peak = re.search(r"VmHWM:\s*(\d+)", Path("/proc/self/status").read_text())
    print(f"{result}, {seconds:.1f} s, {int(peak[1]) / 2**20 if peak else 0:.1f} GiB")


def main(report: Callable[[str], None] = print) -> None:
    """Print a row for each kind of file, or with ``--bombs`` for each bomb."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cases", type=int, default=80)
    parser.add_argument("--only", default="")
    parser.add_argument("--bombs", action="store_true")
    arguments = parser.parse_args()
    total: Counter[str] = Counter()
    with tempfile.TemporaryDirectory() as folder:
        for name in BOMBS if arguments.bombs else FILES:
            if arguments.only not in name:
                continue
            if arguments.bombs:
                report(f"{name:16} {explode(name, Path(folder))}")
                continue
            try:
                outcomes, lines, slowest, visible = measure(name, arguments.cases, Path(folder))
            except MwdnError as error:
                report(f"{name:16} {error}")
                continue
            report(f"{name:16} {dict(outcomes)} lines {lines}, slowest {slowest:.2f} s, differ {visible}")
            total.update({key.split(":")[0]: number for key, number in outcomes.items()})
    report(f"total {dict(total)}")


if __name__ == "__main__":
    main()

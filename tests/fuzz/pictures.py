"""Files of every format that is read, damaged by a seeded generator, and what the readers make of them.

``python tests/fuzz/pictures.py --cases 80`` prints the table of docs/reliability.md.
"""

import argparse
import json
import os
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))
from image_files import dng, encoded, npy, png16, tiff
from mwdn.errors import MwdnError
from mwdn.io.images import read_frame
from mwdn.io.toml import read_toml

LONGEST = 300
"""Characters of a message, without the file's name."""

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


def damaged(data: bytes, random: np.random.Generator) -> bytes:
    """One to four damages: bits or bytes changed, a run of zeros, a piece cut, doubled or moved."""
    content = bytearray(data)
    for _ in range(random.integers(1, 5)):
        size = len(content)
        if size < 8:
            break
        # Every third damage hits the header, where most numbers mean something.
        at = int(random.integers(0, min(size, 200) if random.random() < 0.33 else size))
        length = int(random.integers(1, 1 + min(64, size - at)))
        match random.integers(0, 8):
            case 0 | 1 | 2:
                content[at] ^= 1 << int(random.integers(0, 8))
            case 3 | 4:
                content[at] = int(random.choice([0, 1, 127, 128, 255, random.integers(0, 256)]))
            case 5:
                content[at : at + length] = bytes(length)
            case 6:
                piece = content[at : at + length]
                del content[at : at + length]
                if random.random() < 0.5:
                    to = int(random.integers(0, len(content) + 1))
                    content[to:to] = piece
            case 7:
                if random.random() < 0.3:
                    del content[at:]
                else:
                    content[at:at] = content[at : at + length]
    return bytes(content)


def cases(name: str, count: int, seed: int = 29) -> Iterator[bytes]:
    """Damaged copies of a file, the same ones for the same seed."""
    random = np.random.default_rng([seed, *name.encode()])
    for _ in range(count):
        data = damaged(FILES[name], random)
        if data != FILES[name]:
            yield data


def read(path: Path) -> Any:
    """Read a file by the reader of its suffix."""
    if path.suffix == ".toml":
        return read_toml(path)
    if path.suffix == ".json":
        from mwdn.io.reading import read_json

        return read_json(path)
    return read_frame(path)


def outcome(path: Path, reference: Any) -> str:
    """``refused``, ``equal``, ``similar`` (taken, off by `VISIBLE` at most), ``different``, or what went wrong."""
    try:
        content = read(path)
    except MwdnError as error:
        message = str(error).replace(str(path), "")
        fine = len(message) <= LONGEST and message.isprintable() and str(path) in str(error)
        return "refused" if fine else f"bad message: {message[:400]!r}"
    except Exception as error:
        return f"traceback: {type(error).__name__}: {error}"
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


def sweep(name: str, count: int, folder: Path) -> tuple[Counter[str], int, float, int]:
    """Outcomes of damaged copies, lines on the terminal, longest time in s, and JPEGs that look different."""
    path = folder / name
    path.write_bytes(FILES[name])
    reference = read(path) if path.suffix != ".json" or "mwdn.io.reading" in sys.modules else None
    outcomes: Counter[str] = Counter()
    slowest, visible = 0.0, 0
    with StandardError() as terminal:
        for data in cases(name, count):
            path.write_bytes(data)
            start = time.perf_counter()
            result = outcome(path, reference)
            slowest = max(slowest, time.perf_counter() - start)
            outcomes[result if ":" not in result else ":".join(result.split(":")[:2])] += 1
    if path.suffix == ".jpg":
        with StandardError():
            visible = sum(differs(data, reference) for data in cases(name, count))
    return outcomes, len(terminal.lines), slowest, visible


def main(report: Callable[[str], None] = print) -> None:
    """Print a row for each kind of file."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cases", type=int, default=80)
    parser.add_argument("--only", default="")
    arguments = parser.parse_args()
    total: Counter[str] = Counter()
    with tempfile.TemporaryDirectory() as folder:
        for name in FILES:
            if arguments.only not in name:
                continue
            try:
                outcomes, lines, slowest, visible = sweep(name, arguments.cases, Path(folder))
            except (MwdnError, ImportError) as error:
                report(f"{name:16} {error}")
                continue
            report(f"{name:16} {dict(outcomes)} lines {lines}, slowest {slowest:.2f} s, differ {visible}")
            total.update({key.split(":")[0]: number for key, number in outcomes.items()})
    report(f"total {dict(total)}")


if __name__ == "__main__":
    main()

"""Files that `pictures.py` and the tests beside it leave out: cameras, masks, recordings, journals, states of runs.

Each kind is the files of a folder, the one of them that is damaged, and its reader.
"""

import copy
import hashlib
import json
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch

from image_files import npy, tiff
from mwdn.benchmark import read_benchmark
from mwdn.calibration import Calibration
from mwdn.capture.captured_pairs import create_captured, open_captured
from mwdn.capture.recipe import read_capture_recipe
from mwdn.capture.recording import record
from mwdn.capture.source import CameraFrame
from mwdn.capture.sources import open_source
from mwdn.data.journal import journal_of
from mwdn.io.toml import RECIPES
from mwdn.optics.mask_files import read_mask, write_mask
from mwdn.optics.masks import Mask
from mwdn.preview.cameras import read_upload
from mwdn.registration.registration import read_projection
from mwdn.training.training_state import read_state, write_state

CAMERA = """
psf = "psf.npy"
dark = "dark.tif"
background = 0.01
psf_bin = 2
upside_down = true
pitch_um = 6.9
distance_mm = 200.0
electrons_per_count = 3.7
read_noise_electrons = 3.0
full_well_electrons = 15000.0
white_balance = [1.0, 1.1, 0.9]
psf_gain = [[1.0, 0.1, -0.1]]
envelope_shift = [0.02, 0.0]
"""

REGISTRATION = {
    "homography": [1.0, 0.1, 3.0, -0.1, 1.0, 2.0, 0.0, 0.0, 1.0],
    "picture_size": [30, 40],
    "camera_size": [48, 64],
    "radial": 0.01,
}


NAMES = (
    *("camera file", "camera's PSF", "camera's dark", "mask", "recording", "captured pairs", "journal"),
    *("sealed journal", "state", "registration", "capture recipe", "benchmark recipe", "upload"),
)
"""Of all kinds."""

UNNAMED = {
    *("camera file", "camera's PSF", "camera's dark", "capture recipe", "benchmark recipe"),
    *("journal", "sealed journal", "upload"),
}
"""Kinds whose messages may name a value or another file instead of the file."""


LIGHT = np.full((6, 8, 3), 1000, np.uint16)


class Kind(NamedTuple):
    """Files by name, the name of the one that is damaged, and what reads it."""

    files: dict[str, bytes]
    name: str
    read: Callable[[Path], object]


def written(folder: Path, files: dict[str, bytes]) -> Path:
    """The folder, with these files in it."""
    folder.mkdir(exist_ok=True)
    for name, content in files.items():
        (folder / name).write_bytes(content)
    return folder


@contextmanager
def _place(name: str) -> Iterator[Path]:
    with tempfile.TemporaryDirectory() as folder:
        yield Path(folder) / name


def _frame(number: int) -> CameraFrame:
    array = np.random.default_rng(number).integers(0, 4096, (8, 10, 1), np.uint16)
    return CameraFrame(array=array, bit_depth=12, mosaic="rggb", timestamp=float(number), number=number)


def _recording(path: Path) -> None:
    with record(path) as recorder:
        for number in range(3):
            recorder.append(_frame(number))


def _mask(path: Path) -> None:
    values = torch.rand(24, 32, generator=torch.Generator().manual_seed(34))
    write_mask(path, Mask("phase", values, pitch_um=2.0, index=1.5, step_um=0.1))


def _state(path: Path) -> None:
    network = torch.nn.Conv2d(3, 4, 3)
    optimiser = torch.optim.Adam(network.parameters())
    network(torch.ones(1, 3, 8, 8)).sum().backward()
    optimiser.step()
    write_state(
        path, {"step": "1", "recipe": "{}"}, network=network, average=copy.deepcopy(network), optimiser=optimiser
    )


def _content(name: str, write: Callable[[Path], None]) -> bytes:
    with _place(name) as path:
        write(path)
        return path.read_bytes()


def _session() -> dict[str, bytes]:
    """A file of captured pairs and its journal, as SIGKILL leaves them after the journal's flush."""
    with _place("a.h5") as path, create_captured(path, _frame(0), LIGHT.shape[:2], {"display_gamma": 2.2}) as pairs:
        pairs.plan(["a.png", "b.png", "c.png"])
        for number, name in enumerate(["a.png", "b.png"]):
            pairs.append(_frame(number), LIGHT, name)
        return {file.name: file.read_bytes() for file in (path, journal_of(path))}


def play(path: Path) -> None:
    """Read all frames of a recording."""
    with open_source(f"replay:{path}") as camera:
        for _ in range(min(len(camera._data), 10)):  # type: ignore[attr-defined]
            camera.read()


def grow(path: Path) -> None:
    """Go on with a session whose file, or the journal beside it, is damaged, as `mwdn capture` does."""
    with open_captured(path.with_name("a.h5")) as pairs:
        assert pairs.names + pairs.planned
        pairs.append(_frame(5), LIGHT, "c.png")


def grow_sealed(path: Path) -> None:
    """As `grow`, after the journal got a right checksum, so that its damage reaches the file."""
    body = path.read_bytes()[:-16]
    path.write_bytes(body + hashlib.blake2b(body, digest_size=16).digest())
    grow(path)


def upload(path: Path) -> None:
    """As the server of `mwdn preview` reads a file that it was sent."""
    read_upload(path.read_bytes(), "capture", 10**6, Calibration.from_array(_psf()).frames.read)


def _psf() -> "np.ndarray":
    return np.random.default_rng(34).random((24, 32, 3), np.float32) ** 9


def kinds() -> dict[str, Kind]:
    """All kinds by name."""
    camera = {
        "camera.toml": CAMERA.encode(),
        "psf.npy": npy(np.kron(_psf(), np.ones((2, 2, 1), np.float32))),
        "dark.tif": tiff(np.full((48, 64, 3), 7, np.uint16), photometric="rgb"),
    }
    session = _session()
    frame = {"frame.tif": tiff((_psf() * 65535).astype(np.uint16), photometric="rgb")}
    recipes = {f"{name}.toml": (RECIPES / f"{name}.toml").read_bytes() for name in ("capture", "benchmark-small")}
    return {
        "camera file": Kind(camera, "camera.toml", Calibration.load),
        "camera's PSF": Kind(camera, "psf.npy", lambda path: Calibration.load(path.with_name("camera.toml"))),
        "camera's dark": Kind(camera, "dark.tif", lambda path: Calibration.load(path.with_name("camera.toml"))),
        "mask": Kind({"mask.tif": _content("mask.tif", _mask)}, "mask.tif", read_mask),
        "recording": Kind({"a.h5": _content("a.h5", _recording)}, "a.h5", play),
        "captured pairs": Kind({"a.h5": session["a.h5"]}, "a.h5", grow),
        "journal": Kind(session, ".a.h5.journal", grow),
        "sealed journal": Kind(session, ".a.h5.journal", grow_sealed),
        "state": Kind({"s": _content("s", _state)}, "s", lambda path: read_state(path, path.read_bytes())),
        "registration": Kind({"r.json": json.dumps(REGISTRATION).encode()}, "r.json", read_projection),
        "capture recipe": Kind(recipes, "capture.toml", read_capture_recipe),
        "benchmark recipe": Kind(recipes, "benchmark-small.toml", read_benchmark),
        "upload": Kind(frame, "frame.tif", upload),
    }

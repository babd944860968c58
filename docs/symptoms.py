"""The pictures of docs/troubleshooting.md: each fault on a simulated camera, and the same after what the page says.

    python docs/symptoms.py [NAME ...] [--out docs/symptoms]

Each fault is put into the files of a PSF and a capture, `mwdn reconstruct` is run on them without and with the remedy,
and both pictures are drawn side by side. The camera is that of `mwdn demo`.
"""

import argparse
import contextlib
import io
import json
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from PIL import Image
from torch.nn import functional as F

from mwdn import Sensor, convolve, read_frame
from mwdn.cli.app import main as mwdn
from mwdn.cli.demo import MASK, SETUP
from mwdn.io.files import atomic
from mwdn.io.images import srgb_encode, write_frame
from mwdn.io.pictures import dark_scene
from mwdn.optics.design import design_camera

SIZE, SIDE = SETUP.size, 200
GOOD_LIGHT = Sensor(full_well=60_000, bit_depth=14)


@dataclass
class Files:
    """What the camera delivers, in linear light, (1, 3, H, W); a fault changes one of them."""

    psf: torch.Tensor
    light: torch.Tensor
    """On the sensor; 1 saturates it."""
    sensor: Sensor = GOOD_LIGHT
    turn: Callable[[np.ndarray], np.ndarray] = lambda frame: frame
    room: torch.Tensor | None = None
    gamma: bool = False


@dataclass(frozen=True)
class Symptom:
    """A fault and its remedy.

    Args:
        fault: changes the files.
        options: of the command line that shows the symptom.
        remedy: options of the command line that does not.
        mended: changes the files for the second run, where no option helps: the capture must be taken again.
        side: height and width of the part of the picture that is drawn.
    """

    fault: Callable[[Files], None]
    options: str = ""
    remedy: str = ""
    mended: Callable[[Files], None] | None = None
    side: int = 240


def room_light(files: Files) -> None:
    """A window beside the object: a slope and a spot of light that do not pass the mask."""
    y, x = torch.meshgrid(torch.linspace(-1, 1, SIZE[0]), torch.linspace(-1, 1, SIZE[1]), indexing="ij")
    spot = torch.exp(-((y + 0.5).square() + (x - 0.6).square()) / 0.15) + 0.3 * (1 + x)
    files.room = 0.12 * spot * torch.tensor([0.7, 0.9, 1.0]).view(1, 3, 1, 1)
    files.light = files.light + files.room


def motion(files: Files) -> None:
    """The object moved by 14 pixels in the middle of the exposure."""
    files.light = (files.light + files.light.roll(14, -1)) / 2


def gains(files: Files) -> None:
    """A sensor that is less sensitive to red and blue."""
    files.light = files.light * torch.tensor([0.45, 1.0, 0.6]).view(1, 3, 1, 1)


def little_light(files: Files) -> None:
    """600 electrons instead of 60,000 at the brightest pixel."""
    files.sensor = Sensor(full_well=600)


def lamp_outside(files: Files) -> None:
    """A bright window beyond the left edge of the picture."""
    scene = F.pad(dark_scene("astronaut", SIZE, SIDE), (60, 60, 60, 60))
    scene[..., 60:260, 20:50] = 1.5
    files.light = _exposed(convolve(scene, files.psf, size=SIZE))


def no_lamp(files: Files) -> None:
    """The window is covered."""


def upside_down(files: Files) -> None:
    """Frames that are stored with the last row first."""
    files.turn = lambda frame: frame[::-1]


def mirrored_psf(files: Files) -> None:
    """A PSF that another program has saved mirrored."""
    files.psf = files.psf.flip(-1).roll(1, -1)


def coded(files: Files) -> None:
    """A capture saved for viewing."""
    files.gamma = True


def mosaic(files: Files) -> None:
    """Raw frames: each pixel has seen one colour."""

    def raw(frame: np.ndarray) -> np.ndarray:
        pixels = frame[..., 1].copy()
        pixels[::2, ::2] = frame[::2, ::2, 0]
        pixels[1::2, 1::2] = frame[1::2, 1::2, 2]
        return pixels[..., None]

    files.turn = raw


def clipped(files: Files) -> None:
    """Too long an exposure: the brightest pixel at 1.3 times saturation."""
    files.light = files.light * 1.6


def nothing(files: Files) -> None:
    """The files are right; the way in which the picture is shown is not."""


SYMPTOMS = {
    "blotches": Symptom(room_light, remedy="--ambient room.png"),
    "ghosts": Symptom(motion, mended=nothing),
    "cast": Symptom(gains, remedy="--white-balance 2.2 1 1.7"),
    "grain": Symptom(little_light, "--method fista", "--method universal"),
    "edges": Symptom(lamp_outside, mended=no_lamp, side=320),
    "upside-down": Symptom(upside_down, remedy="--upside-down"),
    "shattered": Symptom(mirrored_psf, remedy="--psf-orientation flip-left-right"),
    "dark": Symptom(nothing, "--format tiff", "--format png"),
    "halos": Symptom(coded, remedy="--gamma srgb"),
    "grid": Symptom(mosaic, remedy="--mosaic rggb"),
    "clipped": Symptom(clipped, "--method admm", "--method universal"),
}


def _exposed(light: torch.Tensor) -> torch.Tensor:
    return 0.8 * light / light.max()


def _write(files: Files, folder: Path) -> None:
    """The frames as a camera writes them, 16 bits; the noise is the same in each run."""
    generator = torch.Generator().manual_seed(0)
    captured = files.sensor.expose(files.light, generator=generator).clamp(0, 1)
    captured = srgb_encode(captured) if files.gamma else captured
    frames = {"psf": files.psf / files.psf.max(), "capture": captured, "room": files.room}
    for name, light in frames.items():
        if light is not None:
            frame = (light[0].movedim(0, -1).numpy() * 65535).round().astype(np.uint16)
            write_frame(folder / f"{name}.png", np.ascontiguousarray(files.turn(frame)))


def _reconstruct(folder: Path, options: str) -> tuple[np.ndarray, list[str]]:
    """The middle of the picture, uint8, and what the command doubts, by running it."""
    words = options.replace("room.png", str(folder / "room.png")).split()
    words = words if "--method" in words else [*words, "--method", "universal-small"]
    paths = [str(folder / "capture.png"), "--psf", str(folder / "psf.png"), "--out", str(folder / "out")]
    with contextlib.redirect_stdout(io.StringIO()), contextlib.suppress(SystemExit):
        mwdn(["reconstruct", *paths, "--background", "0", *words, "--quiet"])
    report = json.loads((folder / "out" / "capture.json").read_text())
    doubts = [verdict["topic"] for verdict in report["verdicts"] if verdict["state"] == "doubt"]
    if "tiff" in words:  # as a viewer shows it that scales the numbers to the brightest and takes them for sRGB
        linear = read_frame(folder / "out" / "capture.tif")
        pixels = (linear.clip(0) / linear.max() * 255).round().astype(np.uint8)
    else:
        pixels = np.asarray(Image.open(folder / "out" / "capture.png").convert("RGB"))
    return pixels, doubts


def draw(name: str, psf: torch.Tensor, light: torch.Tensor, out: Path) -> None:
    """Run the command without and with the remedy; write both pictures side by side."""
    symptom, pictures, doubts = SYMPTOMS[name], [], []
    for options, change in ((symptom.options, symptom.fault), (symptom.remedy, symptom.mended or symptom.fault)):
        files = Files(psf, light)
        change(files)
        with tempfile.TemporaryDirectory() as folder:
            _write(files, Path(folder))
            picture, doubt = _reconstruct(Path(folder), options)
        pictures.append(np.asarray(Image.fromarray(picture).resize(SIZE[::-1], Image.Resampling.NEAREST)))
        doubts.append(doubt)
    side = symptom.side
    sheet = np.full((side, 2 * side + 8, 3), 128, np.uint8)
    for column, picture in enumerate(pictures):
        top, left = (SIZE[0] - side) // 2, (SIZE[1] - side) // 2
        start = column * (side + 8)
        sheet[:, start : start + side] = picture[top : top + side, left : left + side]
    written = io.BytesIO()
    Image.fromarray(sheet).save(written, "webp", quality=80, method=6)
    with atomic(out / f"{name}.webp") as temporary:
        temporary.write_bytes(written.getvalue())
    print(f"{name}: {len(written.getvalue()) // 1000} kB; doubts {doubts[0] or 'none'}, then {doubts[1] or 'none'}")


def main() -> None:
    """Draw the pictures of the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", metavar="NAME", help=", ".join(SYMPTOMS))
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "symptoms")
    arguments = parser.parse_args()
    psf = design_camera("contour", MASK, SETUP).psf
    light = _exposed(convolve(dark_scene("astronaut", SIZE, SIDE), psf))
    for name in arguments.names or SYMPTOMS:
        draw(name, psf, light, arguments.out)


if __name__ == "__main__":
    with torch.inference_mode():
        main()

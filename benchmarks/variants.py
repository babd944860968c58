"""Simulated captures whose true state is known, for `benchmarks/diagnosis.py`.

A variant is drawn in the order of the light: a PSF (four real cameras or `sample_camera`) moved slightly off its
calibration, a photograph in dark or bright surroundings, pixels 1 to 8 times as large as the PSF's, sometimes a crop,
ambient light, a grey or colour sensor with its noise, a gamma or none, 8, 12 or 16 bits, sometimes JPEG. The PSF's
file has its own noise, background and bits, one of eight orientations, and sometimes sRGB. `draw` and what it calls
have the probabilities.
"""

import math
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

from known_captures import MOSAICS, Variant, as_stored, mosaicked, through_jpeg
from mwdn import Calibration
from mwdn.calibration.frame_format import bin_pixels, crop_centre, demosaic
from mwdn.data.photographs import Photographs
from mwdn.io.images import srgb_encode
from mwdn.optics import Camera, Sensor, sample_camera
from mwdn.optics.orientation import turn
from mwdn.solvers.alignment import fine_detail
from mwdn.solvers.pose import Pose

HALF_TURNS = ("", "flip-left-right", "flip-top-bottom", "rotate-180")
TURNS = (*HALF_TURNS, "rotate-90", "rotate-270", "transpose", "transverse")
_INVERSE = {"rotate-90": "rotate-270", "rotate-270": "rotate-90"}
_CV2 = {  # OpenCV names a mosaic by the second row's second and third letter
    "rggb": cv2.COLOR_BayerBG2RGB,
    "bggr": cv2.COLOR_BayerRG2RGB,
    "grbg": cv2.COLOR_BayerGB2RGB,
    "gbrg": cv2.COLOR_BayerGR2RGB,
}


def demosaicked(raw: Tensor, mosaic: str) -> Tensor:
    """The colours (1, 3, H, W) that a camera interpolates from its raw frame (1, 1, H, W)."""
    colours = cv2.cvtColor(as_stored(raw, 16)[..., 0], _CV2[mosaic])
    return torch.from_numpy(colours.astype(np.float32) / 65535).movedim(-1, 0)[None]


class Draw:
    """Random numbers of one variant."""

    def __init__(self, seed: int, number: int) -> None:
        self.generator = torch.Generator().manual_seed(1_000_003 * seed + number)

    def uniform(self, low: float = 0.0, high: float = 1.0) -> float:
        return low + (high - low) * float(torch.rand((), generator=self.generator))

    def log_uniform(self, low: float, high: float) -> float:
        return math.exp(self.uniform(math.log(low), math.log(high)))

    def one_of(self, *choices: Any) -> Any:
        return choices[int(self.uniform(0, len(choices)))]

    def happens(self, probability: float) -> bool:
        return self.uniform() < probability


class Sources:
    """PSFs of real cameras (1, C, H, W) and photographs."""

    def __init__(self, data: Path) -> None:
        self.photographs = Photographs(data / "photos" / "test", side=224)
        files = {
            "paper": ("mwdn-camera/psf_320.png", 1),
            "paper-raw": ("mwdn-camera/psf_raw_1920.png", 3),  # its lines are 6 pixels wide: for larger pixels only
            "diffusercam": ("diffusercam/psf_recovered_270x480.npy", 1),
            "phlatcam": ("phlatcam/psf_384x640.npy", 1),
            "tutorial": ("diffusercam-tutorial/psf_sample.tif", 2),
        }
        self.smallest_bin = {name: smallest for name, (_, smallest) in files.items()} | {"random": 1}
        self.psfs = {name: Calibration.from_file(data / file).psf for name, (file, _) in files.items()}

    def draw_psf(self, draw: Draw, bin: int, size: tuple[int, int]) -> tuple[str, Tensor]:
        """A PSF of about ``bin`` times ``size``; it may be smaller."""
        wanted = [bin * length for length in size]
        fitting = [
            name
            for name, psf in self.psfs.items()
            if bin >= self.smallest_bin[name] and min(psf.shape[-2:]) >= 96 * bin
        ]
        name = draw.one_of("random", "random", *fitting)
        if name == "random":
            enlarged = max(1, bin // 3)  # its lines are 1 to 3 pixels wide
            psf = sample_camera(draw.generator, tuple(length // enlarged for length in wanted))
            return name, F.interpolate(psf, scale_factor=enlarged, mode="bicubic").clamp(min=0)
        psf = self.psfs[name]
        return name, crop_centre(
            psf, tuple(min(a, b) // bin * bin for a, b in zip(wanted, psf.shape[-2:], strict=True))
        )


def place(photograph: Tensor, size: tuple[int, int], draw: Draw) -> Tensor:
    """A photograph in dark or bright surroundings, or filling the scene: (1, 3, *size)."""
    if draw.happens(0.3):
        return F.interpolate(photograph, size=size, mode="bilinear", antialias=True)
    side = int(draw.uniform(0.3, 0.8) * min(size))
    scene = torch.full((1, 3, *size), draw.one_of(0.0, draw.uniform(0.0, 0.2), draw.uniform(0.2, 0.8)))
    top, left = (int(draw.uniform(0.2, 0.8) * (length - side)) for length in size)
    small = F.interpolate(photograph, size=(side, side), mode="bilinear", antialias=True)
    scene[..., top : top + side, left : left + side] = small
    return scene


class Pixels(NamedTuple):
    """What the capture's pixels are.

    Args:
        bin: width in pixels of the PSF.
        kind: "raw" cells of a mosaic; or "grey", "demosaiced" or "colour".
        mosaic: order of the colour filters.
        colours: sensitivity to red, green and blue.
    """

    bin: int
    kind: str
    mosaic: str
    colours: Tensor

    @property
    def is_raw(self) -> bool:
        return self.kind == "raw"

    def see(self, light: Tensor) -> Tensor:
        """Light (1, 3, H, W) behind the colour filters."""
        if self.kind == "grey":
            return light.mean(1, keepdim=True)
        return light if self.kind == "colour" else mosaicked(light * self.colours, self.mosaic)


class File(NamedTuple):
    """A capture's file, how it was made, and the part of its detail that is noise."""

    frame: np.ndarray
    bits: int
    gamma: str
    jpeg: int
    noise: float


def draw_camera(sources: Sources, d: Draw) -> tuple[int, str, str, Tensor]:
    """Bin, kind of the pixels, and the PSF with its name."""
    bin = 1 if d.happens(0.4) else int(d.uniform(2, 9))
    is_raw = bin == 1 and d.happens(0.5)
    kind = "raw" if is_raw else d.one_of("grey", "demosaiced", "colour")
    height = 2 * int(d.uniform(64, 128 if bin < 6 else 96))
    source, psf = sources.draw_psf(d, bin, (height, height * 4 // 3 // 2 * 2 if d.happens(0.3) else height))
    psf = psf / psf.sum((-2, -1), keepdim=True)
    if is_raw or psf.shape[-1] % (2 * bin) or psf.shape[-2] % (2 * bin):
        psf = crop_centre(psf, tuple(length // (2 * bin) * 2 * bin for length in psf.shape[-2:]))
    return bin, kind, source, psf


def draw_light(sources: Sources, d: Draw, bin: int, psf: Tensor) -> Tensor:
    """Light of a scene on the sensor; the PSF is turned by 0.2 degrees and scaled by 0.3 % at most."""
    photograph = sources.photographs.light(torch.tensor([int(d.uniform(0, len(sources.photographs)))]))
    scene = place(photograph, psf.shape[-2:], d)
    pose = Pose(torch.tensor([0.2 * d.uniform(-1, 1)]), torch.tensor([0.003 * d.uniform(-1, 1)]))
    return bin_pixels(Camera(pose.move(psf).expand(1, 3, -1, -1)).forward(scene), bin)


def draw_crop(d: Draw, size: tuple[int, ...]) -> tuple[int, int] | None:
    return tuple(int(length * d.uniform(0.6, 0.9)) // 2 * 2 for length in size) if d.happens(0.3) else None


def draw_exposure(d: Draw, light: Tensor) -> tuple[Tensor, str]:
    """The light on the sensor's scale, with ambient light, and the kind of it."""
    light = light / light.amax() * d.log_uniform(0.15, 0.95)
    ambient = d.one_of("none", "none", "even", "slope")
    if ambient == "none":
        return light, ambient
    ramp = torch.linspace(0, 2, light.shape[-1]) if ambient == "slope" else torch.ones(light.shape[-1])
    light = light + d.uniform(0.1, 0.6) * light.mean() * ramp
    return light * min(1.0, 0.95 / float(light.amax())), ambient


def encode(light: Tensor, gamma: str) -> Tensor:
    """Numbers of a file whose gamma is "linear", "srgb" or "2.2"."""
    return {"linear": light, "srgb": srgb_encode(light), "2.2": light.clamp(min=0) ** (1 / 2.2)}[gamma]


def draw_file(d: Draw, light: Tensor, pixels: Pixels) -> File:
    """Expose a sensor to the light that its pixels see, and write the file."""
    bits, gamma = d.one_of(8, 8, 12, 16), d.one_of("linear", "linear", "srgb", "2.2")
    sensor = Sensor(d.log_uniform(1000, 20000), d.uniform(2, 8), bits if gamma == "linear" else 12, 0.01)
    measured = sensor.expose(light, generator=d.generator).clamp(0, 1)
    measured = measured + d.one_of(0.0, 0.0, 0.02)  # the black level, kept in the file
    if pixels.kind == "demosaiced":
        measured, light = demosaicked(measured, pixels.mosaic), demosaicked(light, pixels.mosaic)
    cells = partial(demosaic, mosaic=pixels.mosaic) if pixels.is_raw else lambda image: image
    noise = fine_detail(cells(measured - light)).square().sum() / fine_detail(cells(measured)).square().sum()
    frame, quality = as_stored(encode(measured, gamma), bits), 0
    if bits == 8 and not pixels.is_raw and d.happens(0.5):
        quality = int(d.uniform(85, 96))
        frame = through_jpeg(frame, quality)
    return File(frame, bits, gamma, quality, float(noise))


def draw_psf_file(d: Draw, psf: Tensor, pixels: Pixels, bits: int) -> tuple[dict[str, np.ndarray], str]:
    """The PSF's file, linear and in sRGB, and the turn that rights it."""
    is_square = psf.shape[-2] == psf.shape[-1]
    orientation = ""
    if not (pixels.is_raw or d.happens(0.4)):
        orientation = d.one_of(*(TURNS if is_square else HALF_TURNS)[1:])
    picture = turn(psf, _INVERSE.get(orientation, orientation)) if orientation else psf
    if pixels.is_raw:
        picture = pixels.see(picture.expand(1, 3, -1, -1))
    elif pixels.kind == "grey":
        picture = picture.mean(1, keepdim=True)
    picture = 0.85 * picture / picture.amax() + d.one_of(0.0, 0.02, 0.1)
    bits = 12 if bits == 12 else d.one_of(8, 16)
    state = d.generator.get_state()
    linear, fine = (
        Sensor(4 * 10_000.0, 5.0, depth, 0.0).expose(picture, generator=d.generator.set_state(state))
        for depth in (bits, 12)
    )
    return {"linear": as_stored(linear, bits), "srgb": as_stored(srgb_encode(fine.clamp(0, 1)), bits)}, orientation


def draw(sources: Sources, seed: int, number: int) -> Variant:
    """Draw a variant; the same numbers always give the same one."""
    d = Draw(seed, number)
    bin, kind, source, psf = draw_camera(sources, d)
    light = draw_light(sources, d, bin, psf)
    crop = None if kind == "raw" else draw_crop(d, light.shape[-2:])
    light, ambient = draw_exposure(d, crop_centre(light, crop) if crop else light)
    mosaic, colours = d.one_of(*MOSAICS), torch.tensor([d.uniform(0.4, 0.9), 1.0, d.uniform(0.4, 0.9)])[:, None, None]
    pixels = Pixels(bin, kind, mosaic, colours)
    file = draw_file(d, pixels.see(light), pixels)
    psfs, orientation = draw_psf_file(d, psf, pixels, file.bits)
    gamma = "linear" if file.gamma == "linear" else "srgb"
    psf_gamma = gamma if d.happens(0.5) else d.one_of("linear", "srgb")  # mostly by the same program
    fits = {
        "bit_depth": 12 if file.bits == 12 else None,
        "mosaic": mosaic if pixels.is_raw else None,
        "psf_bin": bin if bin > 1 else None,
        "crop": crop,
    }
    truth = {
        "gamma": gamma,
        "psf-gamma": psf_gamma,
        "mosaic": mosaic if pixels.is_raw else "",
        "bin": str(bin),
        "orientation": orientation,
        "noise": "noise" if file.noise > 0.5 else "",
        "ambient": "" if ambient == "none" else "ambient",
    }
    drawn = {
        "source": source,
        "kind": kind,
        "gamma": file.gamma,
        "bits": file.bits,
        "jpeg": file.jpeg,
        "ambient": ambient,
        "noise": round(file.noise, 4),
        "frame": file.frame.shape,
        "psf": psf.shape[-2:],
    }
    fits = {name: value for name, value in fits.items() if value is not None}
    return Variant(f"variant {number}", psfs["linear"], file.frame, truth, fits, drawn, psfs["srgb"], file.jpeg > 0)

"""Captures whose true state is known: the real ones, and simulated variants for `benchmarks/diagnosis.py`.

A variant is drawn in the order of the light: a PSF (four real cameras or `sample_camera`) moved slightly off its
calibration, a photograph in dark or bright surroundings, pixels 1 to 8 times as large as the PSF's, sometimes a crop,
ambient light, a grey or colour sensor with its noise, a gamma or none, 8, 12 or 16 bits, sometimes JPEG. The PSF's
file has its own noise, background and bits, and one of eight orientations. `draw` has the probabilities.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

from mwdn import Calibration
from mwdn.calibration.frame_format import bin_pixels, crop_centre, demosaic
from mwdn.data.photographs import Photographs
from mwdn.io.images import read_frame, srgb_encode
from mwdn.optics import Camera, Sensor, sample_camera
from mwdn.solvers.alignment import Pose, fine_detail

MOSAICS = ("rggb", "bggr", "grbg", "gbrg")
HALF_TURNS = ("", "flip-left-right", "flip-top-bottom", "rotate-180")
TURNS = (*HALF_TURNS, "rotate-90", "rotate-270", "transpose", "transverse")
_INVERSE = {"rotate-90": "rotate-270", "rotate-270": "rotate-90"}
_CV2 = {  # OpenCV names a mosaic by the second row's second and third letter
    "rggb": cv2.COLOR_BayerBG2RGB,
    "bggr": cv2.COLOR_BayerRG2RGB,
    "grbg": cv2.COLOR_BayerGB2RGB,
    "gbrg": cv2.COLOR_BayerGR2RGB,
}


@dataclass(frozen=True)
class Variant:
    """A PSF and a capture as their files hold them, and what a detector should find.

    Args:
        name: of the capture.
        psf: frame of the PSF.
        frame: frame of the capture.
        truth: for each property the right `Verdict.value`: gamma "linear" or "srgb" (any gamma); mosaic its order or
            ""; bin the PSF's ``--psf-bin``; orientation the turn that rights the PSF, or ""; noise "noise" if more
            than half of the capture's detail is noise, else ""; ambient "ambient" or "".
        fits: fields of `Calibration.from_array` that make the PSF fit the capture.
        drawn: how the variant was made, for the record.
    """

    name: str
    psf: np.ndarray
    frame: np.ndarray
    truth: dict[str, str]
    fits: dict[str, Any] = field(default_factory=dict)
    drawn: dict[str, Any] = field(default_factory=dict)

    def calibration(self, unknown: str) -> Calibration:
        """What is known when this property is checked. The orientation of the PSF is as its file has it.

        The gamma is known when PSF, noise and light are judged.
        """
        hidden = {"bin": ("psf_bin", "crop"), "mosaic": ("mosaic",)}.get(unknown, ())
        fields = {key: v for key, v in self.fits.items() if key not in hidden}
        if unknown in ("orientation", "noise", "ambient") and self.truth["gamma"] != "linear":
            fields["gamma"] = 2.2 if self.drawn.get("gamma") == "2.2" else "srgb"
        return Calibration.from_array(self.psf, **fields)


def turn(image: Tensor, name: str) -> Tensor:
    """Turn pictures (..., H, W) about their pixel (H // 2, W // 2); the names are those of `PIL.Image.Transpose`."""
    swapped = name in ("rotate-90", "rotate-270", "transpose", "transverse")
    image = image.mT if swapped else image
    reversed_ = {"flip-top-bottom": (-2,), "rotate-90": (-2,), "flip-left-right": (-1,), "rotate-270": (-1,)}
    axes = (-2, -1) if name in ("rotate-180", "transverse") else reversed_.get(name, ())
    # Reversing an even axis moves pixel n // 2 to n // 2 - 1: roll by one.
    return image.flip(axes).roll([1 - image.shape[axis] % 2 for axis in axes], axes) if axes else image


def mosaicked(image: Tensor, mosaic: str) -> Tensor:
    """Colours (B, 3, H, W) behind a colour filter array: (B, 1, H, W)."""
    raw = torch.empty_like(image[:, :1])
    for place, letter in enumerate(mosaic):
        row, column = divmod(place, 2)
        raw[:, 0, row::2, column::2] = image[:, "rgb".index(letter), row::2, column::2]
    return raw


def as_raw(frame: np.ndarray, mosaic: str) -> np.ndarray:
    """A frame (H, W, 3) behind a colour filter array: (H, W, 1)."""
    raw = mosaicked(torch.from_numpy(frame.astype(np.float32)).movedim(-1, 0)[None], mosaic)
    return raw[0].movedim(0, -1).numpy().astype(frame.dtype)


def demosaicked(raw: Tensor, mosaic: str) -> Tensor:
    """The colours (1, 3, H, W) that a camera interpolates from its raw frame (1, 1, H, W)."""
    colours = cv2.cvtColor(as_stored(raw, 16)[..., 0], _CV2[mosaic])
    return torch.from_numpy(colours.astype(np.float32) / 65535).movedim(-1, 0)[None]


def as_stored(image: Tensor, bits: int) -> np.ndarray:
    """A picture (1, C, H, W) in [0, 1] as the integers (H, W, C) of a file."""
    numbers = (image.clamp(0, 1) * (2**bits - 1)).round()[0].movedim(0, -1).contiguous().numpy()
    return numbers.astype(np.uint8 if bits == 8 else np.uint16)


def through_jpeg(frame: np.ndarray, quality: int) -> np.ndarray:
    data = cv2.imencode(".jpg", frame[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, quality])[1]
    decoded = cv2.imdecode(data, cv2.IMREAD_UNCHANGED)
    return np.ascontiguousarray(decoded.reshape(*frame.shape)[..., ::-1])


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


def draw(sources: Sources, seed: int, number: int) -> Variant:
    """Draw a variant; the same numbers always give the same one."""
    d = Draw(seed, number)
    bin = 1 if d.happens(0.4) else int(d.uniform(2, 9))
    is_raw = bin == 1 and d.happens(0.5)
    kind = "raw" if is_raw else d.one_of("grey", "demosaiced", "colour")
    height = 2 * int(d.uniform(64, 128 if bin < 6 else 96))
    source, psf = sources.draw_psf(d, bin, (height, height * 4 // 3 // 2 * 2 if d.happens(0.3) else height))
    psf = psf / psf.sum((-2, -1), keepdim=True)
    if is_raw or psf.shape[-1] % (2 * bin) or psf.shape[-2] % (2 * bin):
        psf = crop_centre(psf, tuple(length // (2 * bin) * 2 * bin for length in psf.shape[-2:]))

    scene = place(
        sources.photographs.light(torch.tensor([int(d.uniform(0, len(sources.photographs)))])), psf.shape[-2:], d
    )
    pose = Pose(torch.tensor([0.2 * d.uniform(-1, 1)]), torch.tensor([0.003 * d.uniform(-1, 1)]))
    light = bin_pixels(Camera(pose.move(psf).expand(1, 3, -1, -1)).forward(scene), bin)
    crop = None
    if not is_raw and d.happens(0.3):
        crop = tuple(int(length * d.uniform(0.6, 0.9)) // 2 * 2 for length in light.shape[-2:])
        light = crop_centre(light, crop)
    light = light / light.amax() * d.log_uniform(0.15, 0.95)
    ambient = d.one_of("none", "none", "even", "slope")
    if ambient != "none":
        ramp = torch.linspace(0, 2, light.shape[-1]) if ambient == "slope" else torch.ones(light.shape[-1])
        light = light + d.uniform(0.1, 0.6) * light.mean() * ramp
        light = light * min(1.0, 0.95 / float(light.amax()))

    mosaic, colours = d.one_of(*MOSAICS), torch.tensor([d.uniform(0.4, 0.9), 1.0, d.uniform(0.4, 0.9)])[:, None, None]
    if kind == "grey":
        light = light.mean(1, keepdim=True)
    elif kind != "colour":
        light = mosaicked(light * colours, mosaic)
    bits, gamma = d.one_of(8, 8, 12, 16), d.one_of("linear", "linear", "srgb", "2.2")
    sensor = Sensor(d.log_uniform(1000, 20000), d.uniform(2, 8), bits if gamma == "linear" else 12, 0.01)
    measured = sensor.expose(light, generator=d.generator).clamp(0, 1)
    measured = measured + d.one_of(0.0, 0.0, 0.02)  # the black level, kept in the file
    if kind == "demosaiced":
        measured, light = demosaicked(measured, mosaic), demosaicked(light, mosaic)
    cells = partial(demosaic, mosaic=mosaic) if is_raw else lambda image: image
    noise = fine_detail(cells(measured - light)).square().sum() / fine_detail(cells(measured)).square().sum()
    coded = {"linear": measured, "srgb": srgb_encode(measured), "2.2": measured.clamp(min=0) ** (1 / 2.2)}[gamma]
    frame, quality = as_stored(coded, bits), 0
    if bits == 8 and not is_raw and d.happens(0.5):
        quality = int(d.uniform(85, 96))
        frame = through_jpeg(frame, quality)

    square = psf.shape[-2] == psf.shape[-1]
    orientation = "" if is_raw or d.happens(0.4) else d.one_of(*(TURNS if square else HALF_TURNS)[1:])
    picture = turn(psf, _INVERSE.get(orientation, orientation))
    picture = mosaicked(picture.expand(1, 3, -1, -1) * colours, mosaic) if is_raw else picture
    picture = picture.mean(1, keepdim=True) if kind == "grey" else picture
    picture = 0.85 * picture / picture.amax() + d.one_of(0.0, 0.02, 0.1)
    psf_bits = 12 if bits == 12 else d.one_of(8, 16)
    picture = Sensor(4 * 10_000.0, 5.0, psf_bits, 0.0).expose(picture, generator=d.generator)

    fits: dict[str, Any] = {"bit_depth": 12} if bits == 12 else {}
    fits |= {"mosaic": mosaic} if is_raw else {}
    fits |= {"psf_bin": bin} if bin > 1 else {}
    fits |= {"crop": crop} if crop else {}
    return Variant(
        f"variant {number}",
        as_stored(picture, psf_bits),
        frame,
        {
            "gamma": "linear" if gamma == "linear" else "srgb",
            "mosaic": mosaic if is_raw else "",
            "bin": str(bin),
            "orientation": orientation,
            "noise": "noise" if noise > 0.5 else "",
            "ambient": "" if ambient == "none" else "ambient",
        },
        fits,
        {
            "source": source,
            "kind": kind,
            "gamma": gamma,
            "bits": bits,
            "jpeg": quality,
            "ambient": ambient,
            "noise": round(float(noise), 4),
            "frame": frame.shape,
            "psf": picture.shape[-2:],
        },
    )


def real_captures(data: Path) -> Iterator[Variant]:
    """Every real capture as it is, and gamma-coded as an 8-bit JPEG; those with colours also as raw mosaics."""
    camera, diffusercam = data / "mwdn-camera", data / "diffusercam"
    tutorial, raw = data / "diffusercam-tutorial", camera / "psf_raw_1920.png"
    turned = {"bgr": True, "upside_down": True}
    objects, scenes = (sorted((camera / "real-objects").glob(name)) for name in ("object_*", "scene*"))
    npy = sorted((diffusercam / "diffuser_images").glob("*.npy"))
    sets = [
        (camera / "psf_320.png", objects, {}),
        (camera / "psf_480.tif", [*scenes, camera / "display_capture.tif"], {}),
        (raw, objects, {"psf_bin": 4, "crop": (320, 320)}),
        (raw, scenes, {"psf_bin": 4}),
        (diffusercam / "psf_recovered_270x480.npy", npy, {**turned, "background": 0.0}),
        (tutorial / "psf_sample.tif", [tutorial / "rawdata_hand_sample.tif"], {}),
    ]
    for file, captures, fits in sets:
        bgr = fits.pop("bgr", False)
        psf = read_frame(file, bgr=bgr)
        for capture in captures:
            name, frame = f"{capture.stem}, {file.stem}", read_frame(capture, bgr=bgr)
            truth = {"gamma": "linear", "mosaic": "", "bin": str(fits.get("psf_bin", 1)), "orientation": ""}
            yield Variant(name, psf, frame, truth, fits)
            light = frame / (np.iinfo(frame.dtype).max if frame.dtype.kind == "u" else 1.0)
            coded = srgb_encode(torch.from_numpy(light.astype(np.float32)).movedim(-1, 0)[None])
            jpeg = through_jpeg(as_stored(coded, 8), 90)
            yield Variant(name + ", sRGB", psf, jpeg, {**truth, "gamma": "srgb"}, fits)
            if frame.shape[-1] == 3:
                order = MOSAICS[len(name) % 4]
                raw, raw_psf = (as_raw(colours, order) for colours in (frame, psf))
                yield Variant(name + ", raw", raw_psf, raw, {"mosaic": order}, fits)

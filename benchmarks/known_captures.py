"""Captures whose true state is known: what `benchmarks/diagnosis.py` judges, and the real ones."""

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from torch import Tensor

from mwdn import Calibration
from mwdn.io.images import read_frame, srgb_encode

MOSAICS = ("rggb", "bggr", "grbg", "gbrg")


@dataclass(frozen=True)
class Variant:
    """A PSF and a capture as their files hold them, and what a detector should find.

    Args:
        name: of the capture.
        psf: frame of the PSF, linear in light.
        frame: frame of the capture.
        truth: for each property the right `Verdict.value`: gamma and psf-gamma "linear" or "srgb" (any
            gamma); mosaic its order or
            ""; bin the PSF's ``--psf-bin``; orientation the turn that rights the PSF, or ""; noise "noise" if more
            than half of the capture's detail is noise, else ""; ambient "ambient" or "".
        fits: fields of `Calibration.from_array` that make the PSF fit the capture.
        drawn: how the variant was made, for the record.
        coded_psf: frame of the PSF in sRGB, which the camera's file holds if the truth of "psf-gamma" is "srgb".
        is_jpeg: whether the capture's file is a JPEG.
    """

    name: str
    psf: np.ndarray
    frame: np.ndarray
    truth: dict[str, str]
    fits: dict[str, Any] = field(default_factory=dict)
    drawn: dict[str, Any] = field(default_factory=dict)
    coded_psf: np.ndarray | None = None
    is_jpeg: bool = False

    def calibration(self, unknown: str) -> Calibration:
        """What is known when this property is checked. The orientation of the PSF is as its file has it.

        The capture's gamma is known when PSF, noise and light are judged. The PSF's is not when a gamma is judged.
        """
        hidden = {"bin": ("psf_bin", "crop"), "mosaic": ("mosaic",)}.get(unknown, ())
        fields = {key: v for key, v in self.fits.items() if key not in hidden}
        if unknown in ("orientation", "noise", "ambient") and self.truth["gamma"] != "linear":
            fields["gamma"] = 2.2 if self.drawn.get("gamma") == "2.2" else "srgb"
        is_coded = unknown in ("gamma", "psf-gamma") and self.truth.get("psf-gamma") == "srgb"
        return Calibration.from_array(self.coded_psf if is_coded else self.psf, **fields)


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


def as_stored(image: Tensor, bits: int) -> np.ndarray:
    """A picture (1, C, H, W) in [0, 1] as the integers (H, W, C) of a file."""
    numbers = (image.clamp(0, 1) * (2**bits - 1)).round()[0].movedim(0, -1).contiguous().numpy()
    return numbers.astype(np.uint8 if bits == 8 else np.uint16)


def through_jpeg(frame: np.ndarray, quality: int) -> np.ndarray:
    data = cv2.imencode(".jpg", frame[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, quality])[1]
    decoded = cv2.imdecode(data, cv2.IMREAD_UNCHANGED)
    return np.ascontiguousarray(decoded.reshape(*frame.shape)[..., ::-1])


def coded(frame: np.ndarray, scale: float) -> np.ndarray:
    """A frame (H, W, C) whose maximum is ``scale`` as an sRGB JPEG."""
    light = torch.from_numpy((frame / scale).astype(np.float32)).movedim(-1, 0)[None]
    return through_jpeg(as_stored(srgb_encode(light), 8), 90)


def real_captures(data: Path) -> Iterator[Variant]:
    """Every real capture as it is; as an sRGB JPEG, like its PSF; as it is, with this PSF; and as a raw mosaic."""
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
        coded_psf = coded(psf, psf.max())
        for capture in captures:
            yield from _states(f"{capture.stem}, {file.stem}", psf, coded_psf, read_frame(capture, bgr=bgr), fits)


def _states(
    name: str, psf: np.ndarray, coded_psf: np.ndarray, frame: np.ndarray, fits: dict[str, Any]
) -> Iterator[Variant]:
    truth = {"gamma": "linear", "psf-gamma": "linear", "mosaic": "", "orientation": ""}
    truth["bin"] = str(fits.get("psf_bin", 1))
    yield Variant(name, psf, frame, truth, fits)
    jpeg = coded(frame, np.iinfo(frame.dtype).max if frame.dtype.kind == "u" else 1.0)
    both = truth | {"gamma": "srgb", "psf-gamma": "srgb"}
    yield Variant(f"{name}, sRGB", psf, jpeg, both, fits, coded_psf=coded_psf, is_jpeg=True)
    yield Variant(f"{name}, PSF sRGB", psf, frame, {"gamma": "linear", "psf-gamma": "srgb"}, fits, coded_psf=coded_psf)
    if frame.shape[-1] == 3:
        order = MOSAICS[len(name) % 4]
        yield Variant(f"{name}, raw", as_raw(psf, order), as_raw(frame, order), {"mosaic": order}, fits)

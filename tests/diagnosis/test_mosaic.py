import numpy as np
import pytest
import torch
from torch.nn import functional as F

from mwdn import Calibration
from mwdn.diagnosis.mosaic import mosaic

SIDE = 128


def colours(generator, *, balance=(0.6, 1.0, 0.7), detail=8):
    """A capture (3, H, W) with structure of ``detail`` pixels, whose colours differ from place to place."""
    coarse = torch.rand(1, 3, SIDE // detail, SIDE // detail, generator=generator)
    picture = F.interpolate(coarse, size=(SIDE, SIDE), mode="bicubic")[0].clamp(0, 1)
    return 0.1 + 0.6 * picture * torch.tensor(balance)[:, None, None]


def behind_filters(picture, order):
    raw = torch.empty(picture.shape[-2:])
    for place, letter in enumerate(order):
        row, column = divmod(place, 2)
        raw[row::2, column::2] = picture["rgb".index(letter), row::2, column::2]
    return raw


def frame(plane, generator, noise=0.02):
    numbers = (plane + noise * torch.randn(plane.shape, generator=generator)).clamp(0, 1) * 4095
    return numbers.numpy().astype(np.uint16)[..., None]


def camera(order=None):
    psf = np.random.default_rng(0).integers(0, 200, (SIDE, SIDE), dtype=np.uint8)
    return Calibration.from_array(psf, mosaic=order)


@pytest.mark.parametrize(("order", "candidates"), [
    ("rggb", "rggb|bggr"), ("bggr", "rggb|bggr"), ("grbg", "grbg|gbrg"), ("gbrg", "grbg|gbrg"),
])  # fmt: skip
@pytest.mark.parametrize("balance", [(0.6, 1.0, 0.7), (0.8, 1.0, 0.8)])
def test_raw_frames_show_the_diagonal_of_green(generator, order, candidates, balance):
    raw = frame(behind_filters(colours(generator, balance=balance), order), generator)
    verdict = mosaic(raw, camera())
    assert (verdict.state, verdict.value) == ("doubt", candidates)
    assert verdict.options == f"--mosaic {candidates[:4]}"
    assert mosaic(raw, camera(order)).state == "good"
    wrong = "grbg" if order in ("rggb", "bggr") else "rggb"
    assert mosaic(raw, camera(wrong)).value == candidates


def pictures(generator):
    grey = colours(generator, detail=1).mean(0)
    rows = grey.clone()
    rows[::2] *= 1.02
    return {
        "grey with detail of single pixels": grey,
        "noise": torch.full((SIDE, SIDE), 0.2),
        "rows of unequal gain": rows,
        "binned raw frame": F.avg_pool2d(
            behind_filters(colours(generator).repeat(1, 2, 2), "rggb")[None], 2)[0],
    }  # fmt: skip


@pytest.mark.parametrize("name", ["grey with detail of single pixels", "noise", "rows of unequal gain",
                                  "binned raw frame"])  # fmt: skip
def test_grey_frames_show_none(generator, name):
    plane = frame(pictures(generator)[name], generator)
    verdict = mosaic(plane, camera())
    assert (verdict.state, verdict.value) == ("good", "")
    needless = mosaic(plane, camera("rggb"))
    assert (needless.state, needless.value, needless.options) == ("doubt", "", "")
    assert "--mosaic rggb" in needless.text


def test_a_small_frame_cannot_tell(generator):
    raw = frame(behind_filters(colours(generator), "rggb"), generator)[:40]
    assert mosaic(raw, camera()).state == "unknown"


def test_colours_are_no_mosaic(generator):
    assert mosaic(np.zeros((SIDE, SIDE, 3), np.uint8), camera()).state == "good"

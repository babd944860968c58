"""`mwdn align` on files: captures through a known camera of a display at a known place."""

import json

import cv2
import numpy as np
import pytest
import torch

from cameras import contour_psf
from mwdn import Camera, read_frame
from mwdn.data import PairFile
from mwdn.io.images import write_frame
from mwdn.registration import read_projection

SIZE = 96
HOMOGRAPHY = np.array([[0.62, 0.03, 20.0], [-0.02, 0.6, 22.0], [1e-4, -2e-4, 1]])
WHITE = 0.4
GAMMA = 2.2
METHOD = ("--method", "admm", "--iterations", "50")


def displayed(number):
    """A coded picture (90, 90, 3): patches of all sizes, another for each number."""
    generator = np.random.default_rng(number)
    picture = np.full((90, 90, 3), 40, np.uint8)
    for _ in range(60):
        x, y, side = generator.integers(-10, 85), generator.integers(-10, 85), generator.integers(5, 30)
        colour = generator.integers(0, 256, 3).tolist()
        cv2.rectangle(picture, (int(x), int(y)), (int(x + side), int(y + side)), colour, -1)
    return picture


def capture(picture, psf):
    """A raw frame of 12 bits, (SIZE, SIZE, 3), and the light in the camera's frame."""
    light = ((picture / 255) ** GAMMA).astype(np.float32)
    to_fine = np.array([[4, 0, 1.5], [0, 4, 1.5], [0, 0, 1]])  # 4 x 4 points in a pixel
    fine = cv2.warpPerspective(light, to_fine @ HOMOGRAPHY, (4 * SIZE, 4 * SIZE))
    scene = torch.from_numpy(fine.reshape(SIZE, 4, SIZE, 4, 3).mean((1, 3))).movedim(-1, 0)[None]
    generator = torch.Generator().manual_seed(0)
    measurement = WHITE * Camera(psf).forward(scene) + 0.001 * torch.randn(1, 3, SIZE, SIZE, generator=generator)
    return (4095 * measurement.clamp(0, 1)).round()[0].movedim(0, -1).numpy().astype(np.uint16), scene


@pytest.fixture
def session(tmp_path):
    """A PSF, and a file of captured pairs: raw frames, coded pictures."""
    psf = contour_psf((SIZE, SIZE), cell=12, generator=torch.Generator().manual_seed(1)).expand(-1, 3, -1, -1)
    write_frame(tmp_path / "psf.npy", psf[0].movedim(0, -1).numpy())
    path, scenes = tmp_path / "session.h5", []
    with PairFile.create(
        path,
        measurement_shape=(SIZE, SIZE, 3),
        scene_shape=(90, 90, 3),
        dtype="uint16",
        attributes={"bit_depth": 12},
    ) as file:
        for number in range(2):
            picture = displayed(number)
            frame, scene = capture(picture, psf)
            scenes.append(scene)
            file.append(frame, ((picture / 255) ** GAMMA).astype(np.float32))
            write_frame(tmp_path / f"frame{number}.png", frame)
            write_frame(tmp_path / f"picture{number}.png", picture)
    return tmp_path, torch.cat(scenes)


def test_a_session_becomes_aligned_pairs_that_the_psf_explains(session, run):
    folder, scenes = session
    out = folder / "aligned.h5"
    status, said, _ = run("align", folder / "session.h5", "--psf", folder / "psf.npy", *METHOD, "-o", out)
    assert status == 0
    assert "2 pairs written" in said
    with PairFile(out) as file:
        assert (len(file), file.scene_shape) == (2, (SIZE, SIZE, 3))
        assert file.attributes["display_white"] == pytest.approx(WHITE, rel=0.03)
        for number, scene in enumerate(scenes):
            measurement, aligned = file[number]
            assert (aligned - scene).abs().mean() < 0.02
            explained = Camera(file.psf).forward(aligned[None])[0]
            assert np.corrcoef(explained.flatten(), measurement.flatten())[0, 1] > 0.99
    projection = read_projection(out)
    corners = np.array([[0, 0], [89, 0], [89, 89], [0, 89.0]])
    truth = cv2.perspectiveTransform(corners[None], HOMOGRAPHY)[0]
    assert projection.to_camera(corners) == pytest.approx(truth, abs=0.7)
    assert read_frame(out.with_suffix(".png")).shape[2] == 3

    status, _, said = run("align", out, "--psf", folder / "psf.npy", "-o", folder / "twice.h5")
    assert (status, "is aligned already" in said) == (2, True)

    again = folder / "again.h5"
    line = ("align", folder / "session.h5", "--psf", folder / "psf.npy", "--method", "wiener", "-o", again)
    for source in (out, out.with_suffix(".json")):
        status, said, noted = run(*line, "--homography", source)
        assert (status, noted) == (0, "")
        assert "Picture placed as given" in said
        with PairFile(out) as first, PairFile(again) as second:
            torch.testing.assert_close(first[1][1], second[1][1], atol=1e-4, rtol=0)
    status, _, said = run(*line, "--homography", out, "--crop", 64, 64)
    sizes = f"The measurements (64 x 64) must have the size that was aligned ({SIZE} x {SIZE})"
    assert (status, sizes in said) == (2, True)
    moved = json.loads(out.with_suffix(".json").read_text())
    moved["homography"] = (np.array([[1, 0, 40], [0, 1, -20], [0, 0, 1.0]]) @ np.array(moved["homography"])).tolist()
    (folder / "moved.json").write_text(json.dumps(moved))
    status, _, said = run(*line, "--homography", folder / "moved.json")
    assert (status, "The first picture fits badly where `--homography` puts it" in said) == (0, True)


def test_one_capture_prints_place_and_writes_an_overlay(session, run):
    folder, _ = session
    files = (folder / "frame0.png", folder / "picture0.png", "--psf", folder / "psf.npy", "--bit-depth", 12)
    status, said, noted = run("align", *files, *METHOD, "--display-gamma", 2.2, "-o", folder / "out", "--json")
    assert status == 0
    content = json.loads(said)
    assert content["residual_px"] < 1.5
    assert "turned by" in noted
    assert (folder / "out" / "frame0.align.png").is_file()
    status, _, noted = run("align", *files, *METHOD, "-o", folder / "new.h5")
    assert (status, "must be a folder for one capture" in noted) == (2, True)
    assert json.loads((folder / "out" / "frame0.align.json").read_text()) == content


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("frame0.png", "picture0.png", "--points", "1,2,3"), "four points"),
        (("frame0.png", "picture0.png", "--homography", "psf.npy"), "psf.npy"),
        (("frame0.png", "picture0.png", "--points", "1,2,3,4,5,6,7,8", "--homography", "a.json"), "Give either"),
        (("frame0.png", "--homography", "a.json"), "give PICTURE, too"),
        (("frame0.png", "picture0.png", "--display-gamma", "9"), "(9)"),
        (("session.h5", "picture0.png"), "has its own pictures"),
        (("session.h5", "--count", "0"), "(0)"),
        (("session.h5", "-o", "session.h5"), "overwrite"),
    ],
)
def test_a_wrong_call_is_one_line(session, run, monkeypatch, arguments, words):
    folder, _ = session
    monkeypatch.chdir(folder)
    status, _, complained = run("align", *arguments, "--psf", "psf.npy", *METHOD)
    assert status == 2
    assert words in complained
    assert complained.count("\n") == 1

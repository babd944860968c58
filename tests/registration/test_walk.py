"""The walk of examples/build_a_camera.py, as small as it gets; its acceptance test trains a network, too."""

import importlib.util
import json
import sys
from pathlib import Path

import cv2
import torch
from displayed import natural_pictures

from mwdn.io.images import srgb_encode

FASTER = {"align": ("--iterations", 40), "reconstruct": ("--no-trust",)}
SCRIPT = Path(__file__).resolve().parents[2] / "examples" / "build_a_camera.py"


def test_from_a_session_to_scored_pictures(tmp_path, run, monkeypatch):
    (tmp_path / "photos").mkdir()
    for number, picture in enumerate(natural_pictures(3, 192)):
        coded = (255 * srgb_encode(torch.from_numpy(picture))).round().byte().numpy()
        cv2.imwrite(str(tmp_path / "photos" / f"{number}.png"), coded[..., ::-1])
    spec = importlib.util.spec_from_file_location("build_a_camera", SCRIPT)
    walk = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(walk)
    done = []

    def mwdn(*words, result=None):
        done.append(words[0])
        words = [word for word in words if word != "universal"]  # ADMM alone, for speed
        status, _, complaint = run(*words, *FASTER.get(words[0], ()))
        assert status == 0, complaint

    monkeypatch.setattr(walk, "mwdn", mwdn)
    out = tmp_path / "walk"
    arguments = (tmp_path / "photos", out, "--counts", "--held-out", 3, "--size", 64, "--method", "admm")
    monkeypatch.setattr(sys, "argv", [str(SCRIPT), *map(str, arguments)])
    walk.main()
    assert done == ["capture", "calibrate", "align", "evaluate", "reconstruct"]
    scores = json.loads((out / "walk.json").read_text(encoding="utf-8"))
    assert scores["0 pairs"]["methods"]["admm"]["mean_low_high"]["psnr"][0] > 20
    assert json.loads((out / "aligned-3.json").read_text(encoding="utf-8"))["residual_px"] < 1
    assert (out / "pictures" / "capture.png").is_file()

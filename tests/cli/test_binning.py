"""`mwdn reconstruct` bins by itself what has wide lines, unless it is told not to."""

import json

import cv2
import numpy as np
import pytest
import torch

from cameras import gaussian_psf
from mwdn import Camera
from mwdn.cli.app import main

SIDE = 204, 212


@pytest.fixture
def reconstruct(tmp_path, monkeypatch, capsys):
    """``reconstruct(*options)`` gives standard error, the picture and its sidecar of one capture through wide spots."""
    monkeypatch.chdir(tmp_path)
    psf = sum(gaussian_psf(SIDE, 5.0, (row, column)) for row, column in ((60, 80), (110, 130), (150, 70)))
    scene = torch.zeros(1, 1, *SIDE)
    scene[..., 90:120, 60:100] = 1
    for name, image in (("psf", psf), ("capture", Camera(psf / 3).forward(scene))):
        cv2.imwrite(f"{name}.png", (0.9 * image / image.max() * 65535)[0, 0].numpy().astype(np.uint16))

    def call(*options):
        command = ["reconstruct", "capture.png", "--psf", "psf.png", "--out", "out", "--method", "wiener", *options]
        with pytest.raises(SystemExit) as caught:
            main([*command, "--no-trust"])
        assert caught.value.code == 0
        sidecar = json.loads((tmp_path / "out" / "capture.json").read_text())
        return capsys.readouterr().err, cv2.imread("out/capture.png").shape[:2], sidecar

    return call


def test_wide_lines_are_binned_by_default(reconstruct):
    said, size, sidecar = reconstruct()
    assert "Binned by 2" in said
    assert "--bin 1" in said
    assert (size, sidecar["bin"]) == ((102, 106), 2)


@pytest.mark.parametrize("bin", [1, 2, 3])
def test_given_bin_is_kept(reconstruct, bin):
    said, size, sidecar = reconstruct("--bin", str(bin))
    assert "Binned" not in said
    assert (size, sidecar["bin"]) == ((SIDE[0] // bin, SIDE[1] // bin), bin)


def test_full_size(reconstruct):
    binned = reconstruct()[2]
    _, size, sidecar = reconstruct("--full-size")
    assert (size, sidecar["bin"]) == (SIDE, 2)
    assert sidecar["origin"] != binned["origin"]
    assert reconstruct("--full-size", "--crop", "203", "201", "--bin", "3")[1] == (203, 201)


def test_psf_of_another_resolution_is_binned_as_much(reconstruct):
    cv2.imwrite("psf.png", cv2.resize(cv2.imread("psf.png", cv2.IMREAD_UNCHANGED), None, fx=2, fy=2))
    said, size, _ = reconstruct("--psf-bin", "2")
    assert "Binned by 2" in said
    assert size == (102, 106)

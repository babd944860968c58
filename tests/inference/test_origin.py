"""Hashes of everything that a picture depends on: batches that earlier versions began go on."""

import os

import pytest
import torch

from mwdn import Calibration, Reconstructor
from mwdn.calibration import FrameFormat
from mwdn.inference.origin import origin, settings_hash
from mwdn.networks import NETWORKS, build
from mwdn.solvers import Admm, Wiener

PSF = (torch.arange(3 * 16 * 16) % 7).float().reshape(1, 3, 16, 16) / 10


@pytest.fixture
def capture(tmp_path, monkeypatch):
    """A file of 8 bytes of second 1."""
    monkeypatch.setattr("mwdn.inference.origin.__version__", "0.1.0")
    (tmp_path / "capture").write_bytes(b"12345678")
    os.utime(tmp_path / "capture", ns=(10**9, 10**9))
    return tmp_path / "capture"


def hash_of(method, capture, format="png", calibration=None, **options):
    calibration = calibration or Calibration(PSF)
    reconstruct = Reconstructor(method, calibration, device="cpu", precision="exact", **options)
    return origin(settings_hash(reconstruct, format), capture)


def with_ones(name, **options):
    """A network whose numbers are all 1."""
    network = build(name, **options).eval()
    with torch.no_grad():
        for tensor in (*network.parameters(), *network.buffers()):
            tensor.fill_(1)
    return network


@pytest.mark.parametrize(
    ("method", "expected"),
    [
        ("admm", "1412e3fe75d42a6f"),
        ("pyramid", "8c479221e1b3b30c"),
        ("wiener", "efd1b193d6dd5afb"),
        ("fista", "6cb61867ba08a624"),
        ("universal", "79c3b13f472ac3d1"),
        ("universal-small", "9f7a0368b4f5b8c3"),
    ],
)
def test_hash_of_a_method_stays_the_same(method, expected, capture):
    """Hashes of version 0.1.0, written when settings had other names."""
    assert hash_of(method, capture) == expected


@pytest.mark.parametrize(
    ("name", "options", "expected"),
    [
        ("wiener", {}, "4d03357ce919eee8"),
        ("unet", {"width": 4}, "ae01f88fedd4342e"),
        ("wiener-unet", {"width": 4}, "6f6bff9b685ec993"),
        ("mwdn", {"width": 4}, "e6b271f1d3122373"),
        ("mwdn-cpsf", {"width": 4}, "33f313f81a082272"),
        ("wiener-bank", {"width": 4}, "5d1fd4dddb205d9a"),
        ("le-admm", {}, "1f0e326f4c42ef63"),
        ("le-admm-u", {"width": 4}, "ccb8b17480318c6f"),
        ("mmcn", {"width": 4}, "1248c17eccb9858d"),
        ("updn", {}, "1615c4513c5cc2cf"),
        ("flatnet", {"width": 4}, "a57afc5ae9ba9a58"),
        ("svdeconv", {"width": 4, "size": (16, 16)}, "0d3a5492e339db83"),
        ("ifin", {"width": 16}, "3390f25f225cfba7"),
    ],
)
def test_hash_of_a_network_stays_the_same(name, options, expected, capture):
    assert hash_of(with_ones(name, **options), capture) == expected


def test_hash_of_a_network_covers_its_type(capture):
    """Of every one that can be built without its size."""
    hashes = {name: hash_of(build(name).eval(), capture) for name in NETWORKS if name != "svdeconv"}
    assert len(set(hashes.values())) == len(hashes)


def test_hash_of_other_settings_differs(capture):
    hashes = [
        hash_of("admm", capture),
        hash_of("admm", capture, "tiff"),
        hash_of("admm", capture, align=True),
        hash_of(Admm(iterations=9), capture),
        hash_of(Wiener(regularisation=1e-3), capture),
        hash_of("admm", capture, calibration=Calibration(PSF.flip(-1))),
        hash_of("admm", capture, calibration=Calibration(PSF, FrameFormat(bit_depth=12))),
        hash_of("universal-small", capture),
        hash_of("universal-small", capture, align=True),
    ]
    assert len(set(hashes)) == len(hashes)


def test_capture_that_cannot_be_read_has_none(tmp_path):
    assert origin("settings", tmp_path / "none.png") == ""

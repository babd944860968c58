"""Hashes of everything that a picture depends on: batches that earlier versions began go on."""

import os

import pytest
import torch

from mwdn import Calibration, Reconstructor
from mwdn.calibration import FrameFormat
from mwdn.inference.origin import origin, settings_hash
from mwdn.networks import build
from mwdn.optics import unit_sum
from mwdn.solvers import Admm, Wiener

PSF = unit_sum((torch.arange(3 * 16 * 16) % 7).float().reshape(1, 3, 16, 16))


@pytest.fixture
def capture(tmp_path, monkeypatch):
    """A file of 8 bytes of second 1."""
    monkeypatch.setattr("mwdn.inference.origin.__version__", "0.1.0")
    (tmp_path / "capture").write_bytes(b"12345678")
    os.utime(tmp_path / "capture", ns=(10**9, 10**9))
    return tmp_path / "capture"


def hash_of(method, capture, format="png", calibration=None, full_size=False, **options):
    calibration = calibration or Calibration(PSF)
    reconstruct = Reconstructor(method, calibration, device="cpu", precision="exact", **options)
    return origin(settings_hash(reconstruct, format, full_size=full_size), capture)


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
        ("admm", "5c34e753426d88ca"),
        ("pyramid", "2ba267f9aaf23f39"),
        ("wiener", "cf039080f5e5de60"),
        ("fista", "e077e8b3def31bac"),
        ("universal", "44f5c439ffe3a629"),
        ("universal-small", "5e9af96573316f49"),
    ],
)
def test_hash_of_a_method_stays_the_same(method, expected, capture):
    """Hashes of version 0.1.0, written when settings had other names."""
    assert hash_of(method, capture) == expected


@pytest.mark.parametrize(
    ("name", "options", "expected"),
    [
        ("wiener", {}, "31195200736a8df1"),
        ("unet", {"width": 4}, "68aa006a8a5b3e9b"),
        ("wiener-unet", {"width": 4}, "5d2c794e7bbefbd6"),
        ("mwdn", {"width": 4}, "37974dd51bdbc6b7"),
        ("mwdn-cpsf", {"width": 4}, "699e1056b99aadf3"),
        ("wiener-bank", {"width": 4}, "2fa1c9ff328cf988"),
        ("le-admm", {}, "e69e24ea3bfccbdd"),
        ("le-admm-u", {"width": 4}, "8c31cda61d41aae5"),
        ("mmcn", {"width": 4}, "b554593886c2f13b"),
        ("updn", {}, "5dc74d7a003e6bd5"),
        ("flatnet", {"width": 4}, "0373f0a3ca7b3539"),
        ("svdeconv", {"width": 4, "size": (16, 16)}, "ebd882a9bf04c188"),
        ("ifin", {"width": 16}, "5ab1d2a253736b6a"),
    ],
)
def test_hash_of_a_network_stays_the_same(name, options, expected, capture):
    assert hash_of(with_ones(name, **options), capture) == expected


def test_hash_of_a_network_covers_its_type(capture):
    """Two networks of the same numbers are two networks."""
    network, other = with_ones("wiener"), with_ones("wiener")
    other.__class__ = type("Other", (type(other),), {})
    assert hash_of(network, capture) != hash_of(other, capture)


def test_hash_of_other_settings_differs(capture):
    hashes = [
        hash_of("admm", capture),
        hash_of("admm", capture, "tiff"),
        hash_of("admm", capture, align=True),
        hash_of(Admm(iterations=9), capture),
        hash_of(Wiener(regularisation=1e-3), capture),
        hash_of("admm", capture, calibration=Calibration(PSF.flip(-1))),
        hash_of("admm", capture, calibration=Calibration(PSF, FrameFormat(bit_depth=12))),
        hash_of("admm", capture, calibration=Calibration(PSF, FrameFormat(gamma="srgb"))),
        hash_of("admm", capture, calibration=Calibration(PSF, ambient=torch.zeros(1, 3, 16, 16))),
        hash_of("admm", capture, white_balance="grey-world"),
        hash_of("admm", capture, calibration=Calibration(PSF, white_balance=(2.0, 1.0, 1.0))),
        hash_of("admm", capture, calibration=Calibration(PSF, FrameFormat(bin=2))),
        hash_of("admm", capture, calibration=Calibration(PSF, FrameFormat(bin=2)), full_size=True),
        hash_of("universal-small", capture),
        hash_of("universal-small", capture, align=True),
    ]
    assert len(set(hashes)) == len(hashes)


def test_full_size_changes_nothing_without_binning(capture):
    assert hash_of("admm", capture, full_size=True) == hash_of("admm", capture)


def test_crop_of_a_mosaic_is_hashed_in_cells(capture):
    """As it was given before it was in raw pixels with a mosaic, too: 16 x 16 cells."""
    calibration = Calibration(PSF, FrameFormat(mosaic="rggb", crop=(32, 32)))
    assert hash_of("admm", capture, calibration=calibration) == "b968fde4e9837346"


def test_capture_that_cannot_be_read_has_none(tmp_path):
    assert origin("settings", tmp_path / "none.png") == ""

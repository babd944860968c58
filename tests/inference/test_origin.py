"""Hashes of everything that a picture depends on."""

import os
import subprocess
import sys

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
def capture(tmp_path):
    """A file of 8 bytes of second 1."""
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


def test_hashes_are_the_same_in_another_process():
    methods = "admm", "universal-small"
    script = f"""
import torch
from mwdn import Calibration, Reconstructor
from mwdn.inference.origin import settings_hash
from mwdn.optics import unit_sum
psf = unit_sum((torch.arange(3 * 16 * 16) % 7).float().reshape(1, 3, 16, 16))
for method in {methods}:
    print(settings_hash(Reconstructor(method, Calibration(psf), device="cpu", precision="exact"), "png"))
"""
    here = [
        settings_hash(Reconstructor(method, Calibration(PSF), device="cpu", precision="exact"), "png")
        for method in methods
    ]
    assert subprocess.check_output([sys.executable, "-c", script], text=True).split() == here


@pytest.mark.parametrize(
    ("name", "options", "other"),
    [
        ("wiener-bank", {"width": 4}, {"mean_light": "free"}),
        ("wiener-bank", {"width": 4}, {"rounds": 2}),
        ("mwdn", {"width": 4}, {"boundary": "circular"}),
        ("mwdn", {"width": 4}, {"psf_pooling": "average"}),
    ],
)
def test_hash_of_a_network_covers_its_options(name, options, other, capture):
    assert hash_of(with_ones(name, **options), capture) == hash_of(with_ones(name, **options), capture)
    assert hash_of(with_ones(name, **options), capture) != hash_of(with_ones(name, **options, **other), capture)


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


def test_capture_that_cannot_be_read_has_none(tmp_path):
    assert origin("settings", tmp_path / "none.png") == ""

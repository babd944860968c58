"""Pairs across cameras: each sample's PSF is the one its measurement went through, and the same at every draw."""

import cv2
import numpy as np
import pytest
import torch

from mwdn.data.cameras import CameraPairs, Cameras
from mwdn.data.mismatch import EXACT
from mwdn.data.photographs import Photographs
from mwdn.data.simulated import Placement, SimulatedPairs
from mwdn.errors import ParameterError
from mwdn.fourier.convolution import convolve
from mwdn.optics import Sensor

CLEAN = Sensor(full_well=1e9, read_noise=0.0, bit_depth=16, black_level=0.0)
DARK = Placement(ambient=(0.0, 0.0))


@pytest.fixture(scope="module")
def pairs(tmp_path_factory):
    folder = tmp_path_factory.mktemp("photographs")
    smooth = np.random.default_rng(1).integers(30, 256, (3, 3, 3), np.uint8)
    cv2.imwrite(str(folder / "0.png"), cv2.resize(smooth, (24, 24), interpolation=cv2.INTER_CUBIC))
    photographs = Photographs(folder, side=24)
    source = SimulatedPairs(photographs, torch.ones(1, 3, 32, 32), placement=DARK, mismatch=EXACT, sensor=CLEAN)
    return CameraPairs(source, Cameras(("32x40", "48x32")), batch_size=2)


def test_each_measurement_went_through_its_own_psf(pairs):
    measurement, scene, psf = pairs.batch(range(0, 2))
    assert not torch.equal(psf[0], psf[1])
    torch.testing.assert_close(convolve(scene, psf), measurement, rtol=0, atol=2e-4)


def test_sizes_take_turns_and_numbers_decide(pairs):
    assert pairs.batch(range(0, 2)).scene.shape[-2:] == (32, 40)
    assert pairs.batch(range(2, 4)).scene.shape[-2:] == (48, 32)
    alone, together = pairs.batch([3]), pairs.batch(range(2, 4))
    for one, all_of_them in zip(alone, together, strict=True):
        torch.testing.assert_close(one[0], all_of_them[1])


def test_impossible_cameras_are_refused():
    with pytest.raises(ParameterError, match=r"`sizes` of \[cameras\] \(\"32\"\) must be height x width"):
        Cameras(("32",))
    with pytest.raises(ParameterError, match=r"`families` of \[cameras\] \(\"spots\"\) must be of "):
        Cameras(("32x32",), ("spots",))

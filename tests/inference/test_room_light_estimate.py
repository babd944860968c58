"""Room light through a PSF that is only nearly right."""

import pytest
import torch
from torch.nn import functional as F

from cameras import contour_psf
from mwdn import Calibration, Reconstructor, fourier
from mwdn.inference.room_light import MIN_ROOM_LIGHT, PIXELS, estimate_room_light, find_room_light, halved
from mwdn.networks import build
from mwdn.optics.room_light import even_light, sloping_light
from mwdn.solvers import Pyramid
from mwdn.solvers.smooth_light import find_smooth_light

SIZE = 64, 64


@pytest.fixture(scope="module")
def camera():
    """The calibrated PSF, and the true one, which has half of its light eight pixels to the right."""
    psf = contour_psf(SIZE, cell=12, generator=torch.Generator().manual_seed(6)).expand(1, 3, -1, -1)
    return psf, 0.5 * psf + 0.5 * psf.roll(8, -1)


@pytest.fixture(scope="module")
def capture(camera):
    scene = torch.zeros(1, 3, *SIZE)
    scene[..., 20:34, 24:38] = torch.tensor([0.9, 0.5, 0.2])[:, None, None]
    scene[..., 36:40, 24:32] = 0.3
    capture = fourier.convolve(scene, camera[1])
    return capture / capture.mean()


LIGHTS = 0.2 * even_light(SIZE).expand(3, -1, -1), 0.25 * sloping_light(SIZE, 0.6).expand(3, -1, -1)


@pytest.fixture(scope="module")
def found(camera, capture):
    """Light of three captures in a batch: with even light, with a slope, and without."""
    return find_room_light(torch.cat([capture + LIGHTS[0], capture + LIGHTS[1], capture]), camera[0]).background


def test_it_is_found_where_the_search_finds_none(camera, capture, found):
    for number, light in enumerate(LIGHTS):
        coarse, h, _ = halved(capture + light, camera[0], PIXELS)
        _, clear = find_smooth_light(coarse, h)
        assert not clear
        assert float((found[number] - light).norm() / light.norm()) < 0.4


def test_there_is_none_without_it(found):
    assert not found[2].any()


def test_a_scene_that_fills_the_frame_keeps_it(camera):
    """Though the network finds it, so that less than half of the frame would be dark."""
    scene = torch.rand(1, 3, 8, 8, generator=torch.Generator().manual_seed(3))
    capture = fourier.convolve(F.interpolate(scene, SIZE, mode="bicubic").clamp(min=0), camera[1])
    lit = capture + 0.2 * capture.mean()
    coarse, h, _ = halved(lit, camera[0], PIXELS)
    assert estimate_room_light(coarse, h).mean() > MIN_ROOM_LIGHT * lit.mean()
    assert not find_room_light(lit, camera[0]).background.any()


def test_a_batch_has_the_light_of_its_captures(camera, capture, found):
    alone = find_room_light(capture + LIGHTS[1], camera[0]).background
    torch.testing.assert_close(found[1:2], alone, rtol=1e-4, atol=1e-5)


def test_only_networks_that_align_look_for_it_unasked(camera, capture):
    calibration = Calibration(camera[0] / camera[0].sum((-2, -1), keepdim=True))
    lit = capture + 0.25 * sloping_light(SIZE, 0.6)
    shares = {
        sought: Reconstructor(Pyramid(), calibration, device="cpu", room_light=sought).without_room_light(lit)[1]
        for sought in (None, False, True)
    }
    assert shares[None] is None
    assert shares[False] is None
    assert float(shares[True]) == pytest.approx(0.2, abs=0.1)
    assert Reconstructor(build("wiener-bank", width=2, finest=0), calibration, device="cpu").room_light

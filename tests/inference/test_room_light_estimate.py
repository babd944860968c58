"""Room light that is known to be there, through a PSF that is only nearly right."""

import pytest
import torch

from cameras import contour_psf
from mwdn import Calibration, Reconstructor, fourier
from mwdn.inference.room_light import estimate_room_light
from mwdn.optics.room_light import even_light, sloping_light
from mwdn.solvers import Pyramid, find_room_light

SIZE = 64, 64


@pytest.fixture
def camera():
    """The calibrated PSF, and the true one, which has two fifths of its light mirrored."""
    psf = contour_psf(SIZE, cell=12, generator=torch.Generator().manual_seed(6)).expand(1, 3, -1, -1)
    return psf, 0.6 * psf + 0.4 * psf.flip(-1)


@pytest.fixture
def capture(camera):
    scene = torch.zeros(1, 3, *SIZE)
    scene[..., 16:30, 24:42] = torch.tensor([0.9, 0.5, 0.2])[:, None, None]
    scene[..., 20:24, 10:20] = 0.3
    capture = fourier.convolve(scene, camera[1])
    return capture / capture.mean()


@pytest.mark.parametrize("light", [0.2 * even_light(SIZE), 0.25 * sloping_light(SIZE, 0.6)])
def test_it_is_found_where_the_search_finds_none(camera, capture, light):
    psf, light = camera[0], light.expand(1, 3, -1, -1)
    left = [
        float((find_room_light(capture + light, psf, estimate=each).background - light).norm() / light.norm())
        for each in (None, estimate_room_light)
    ]
    assert left[0] > 0.99
    assert left[1] < 0.4


def test_there_is_none_without_it(camera, capture):
    assert not find_room_light(capture, camera[0], estimate=estimate_room_light).background.any()


def test_a_batch_has_the_light_of_its_captures(camera, capture):
    both = torch.cat([capture + 0.3, capture])
    found = find_room_light(both, camera[0], estimate=estimate_room_light)
    alone = [find_room_light(each[None], camera[0], estimate=estimate_room_light) for each in both]
    torch.testing.assert_close(found.background, torch.cat([each.background for each in alone]), rtol=1e-4, atol=1e-5)


def test_a_reconstructor_uses_it_only_if_light_is_known_to_be_there(camera, capture):
    calibration = Calibration(camera[0] / camera[0].sum((-2, -1), keepdim=True))
    lit = capture + 0.25 * sloping_light(SIZE, 0.6)
    shares = {
        sure: Reconstructor(Pyramid(), calibration, device="cpu", room_light=sure).without_room_light(lit)[1]
        for sure in (None, False, True)
    }
    assert shares[None] is None
    assert shares[False] is None
    assert float(shares[True]) == pytest.approx(0.2, abs=0.1)

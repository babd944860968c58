"""Room light against closed forms: a delta PSF, a known slope over a scene on dark, and nothing where there is none."""

import math

import pytest
import torch
from torch.nn import functional as F

from cameras import contour_psf
from mwdn import Calibration, Reconstructor, fourier
from mwdn.inference.room_light import find_room_light
from mwdn.optics.room_light import even_light, sloping_light, spot_light
from mwdn.solvers import Pyramid
from mwdn.solvers.light_spot import cosines
from mwdn.solvers.smooth_light import SmoothLight
from mwdn.solvers.unexplained import energy, unexplained

SIZE = 48, 64
SMALL = 24, 32
"""Where the error of the light, which is twice as large as for `SIZE`, does not matter."""


def camera(size):
    """PSF, and a scene on dark."""
    generator, unit = torch.Generator().manual_seed(20230731), size[0] // 24
    scene = torch.zeros(1, 3, *size)
    scene[..., 8 * unit : 15 * unit, 12 * unit : 21 * unit] = torch.tensor([0.9, 0.5, 0.2])[:, None, None]
    return contour_psf(size, cell=6 * unit, generator=generator).expand(1, 3, -1, -1), scene


@pytest.fixture
def psf():
    return camera(SIZE)[0]


@pytest.fixture
def scene():
    return camera(SIZE)[1]


def lit(scene, psf, light):
    """The measurement, and light of this shape in units of its mean."""
    measurement = fourier.convolve(scene, psf)
    return measurement, light * measurement.mean((1, 2, 3), keepdim=True)


def test_known_light_over_a_scene_on_dark(psf, scene):
    shapes = [0.3 * even_light(SIZE), 0.25 * sloping_light(SIZE, 0.6)]
    measurement, light = lit(scene, psf, torch.stack(shapes)[:, None])
    found = find_room_light(measurement + light, psf)
    off = (found.background - light).square().mean((1, 2, 3)).sqrt() / measurement.mean()
    assert float(off.amax()) < 0.02
    share = light.mean((1, 2, 3)) / (measurement + light).mean((1, 2, 3))
    torch.testing.assert_close(found.share, share, rtol=0, atol=0.05)
    assert (found.background >= 0).all()


@pytest.mark.parametrize(("centre", "sigma", "error"), [((0.4, 0.6), 0.15, 0.05), ((0.7, 0.2), 0.11, 0.15)])
def test_a_known_spot_in_three_colours(psf, scene, centre, sigma, error):
    """Though its light is the brightest on the sensor."""
    colour = torch.tensor([1.3, 1.0, 0.7])[:, None, None]
    measurement, light = lit(scene, psf, 0.3 * colour * spot_light(SIZE, centre, sigma))
    found = find_room_light(measurement + light, psf)
    assert float((found.background - light).norm() / light.norm()) < error


def test_a_spot_as_wide_as_the_psf_is_found_by_its_glow(psf, scene):
    """A scene explains it completely, by a glow around the object; in the dark part there should be none."""
    measurement, light = lit(scene, psf, 0.3 * spot_light(SIZE, (0.4, 0.6), 0.4))
    assert float(energy(unexplained((measurement + light) / measurement.mean(), psf, measurement > 2)).sqrt()) < 0.01
    found = find_room_light(measurement + light, psf)
    assert float((found.background - light).norm() / light.norm()) < 0.1


def test_smooth_light_is_a_plane_or_a_spot():
    """Each is fitted exactly; a slope that falls below zero gives no negative light."""
    basis = cosines(SIZE, torch.device("cpu"))
    slope = (3 * sloping_light(SIZE, 0.6) - 1).expand(1, 3, -1, -1)
    spot = 2 * spot_light(SIZE, (0.4, 0.6), 0.3).expand(1, 3, -1, -1)
    torch.testing.assert_close(SmoothLight.fit(slope, basis).on(SIZE), slope.clamp(min=0), rtol=0, atol=1e-4)
    fit = SmoothLight.fit(spot, basis, advantage=2.0)
    assert (fit.plane == 0).all()
    assert float((fit.on(SIZE) - spot).norm() / spot.norm()) < 0.02


def test_a_scene_on_dark_keeps_its_light(psf, scene):
    """To the last bit."""
    found = find_room_light(fourier.convolve(scene, psf), psf)
    assert float(found.share) == 0.0
    assert (found.background == 0).all()


@pytest.mark.parametrize("kept", [0.98, 0.7])
def test_light_that_is_cut_off_is_not_unexplained(psf, scene, kept):
    """The brightest pixels are saturated. The scene that explains the others is brighter there."""
    measurement = fourier.convolve(scene, psf)
    limit = float(measurement.quantile(kept))
    cut, saturated = measurement.clamp(max=limit) / measurement.mean(), measurement >= limit
    as_light, as_bound = (energy(unexplained(cut, psf, mask)) for mask in (saturated & False, saturated))
    assert float(as_bound) < 0.05 * float(as_light)
    assert float(find_room_light(cut, psf).share) == 0.0


def test_a_scene_that_fills_the_frame_loses_little(psf, generator):
    """Its darkest light looks like the room's: an eighth of all light is the bound."""
    scene = F.interpolate(torch.rand(1, 3, 6, 8, generator=generator) ** 2, size=SIZE, mode="bilinear")
    assert float(find_room_light(fourier.convolve(scene, psf), psf).share) < 1 / 8


@pytest.mark.parametrize("light", [0 * even_light(SIZE), 0.2 * even_light(SIZE), 0.25 * sloping_light(SIZE, 0.6)])
def test_a_scene_that_fills_the_frame_keeps_its_light(psf, generator, light):
    """With the light of a room, too: what is subtracted there is mostly the scene's own."""
    scene = F.interpolate(torch.rand(1, 3, 6, 8, generator=generator), SIZE, mode="bicubic").clamp(min=0.2)
    measurement, light = lit(scene, psf, light)
    assert float(find_room_light(measurement + light, psf).share) == 0.0


def test_even_light_through_a_delta_psf_is_the_floor_of_the_scene(scene):
    """A delta PSF images, so that even light is a scene as well: at most all of it is taken, not what is above it."""
    delta = torch.zeros(1, 1, *SIZE)
    delta[..., SIZE[0] // 2, SIZE[1] // 2] = 1
    found = find_room_light(scene + 0.1, delta)
    assert float(found.background.amax()) <= 0.1 + 0.02 * 1.5


def test_scale_and_other_frames_do_not_matter():
    psf, scene = camera(SMALL)
    measurement, light = lit(scene, psf, 0.3 * even_light(SMALL))
    frames = torch.cat([measurement + light, 7 * measurement, measurement + math.inf])
    found = find_room_light(frames, psf)
    assert found.share[1:].tolist() == [0.0, 0.0]
    assert (found.background[1:] == 0).all()
    alone = find_room_light(100 * frames[:1], 5 * psf)
    torch.testing.assert_close(alone.background, 100 * found.background[:1], rtol=1e-3, atol=1e-3)
    assert math.isclose(float(alone.share), float(found.share[0]), rel_tol=1e-3)


def test_darkness_below_zero_has_none(psf, generator):
    """A lens cap, less the dark frame: the search failed with an error of torch, and ended a stream."""
    dark = 0.01 * torch.randn(1, 3, *SIZE, generator=generator) - 0.001
    found = find_room_light(dark, psf)
    assert found.share == 0
    assert not found.background.any()


def test_a_reconstructor_subtracts_it():
    psf, scene = camera(SMALL)
    measurement, light = lit(scene, psf, 0.3 * even_light(SMALL))
    calibration = Calibration(psf / psf.sum((-2, -1), keepdim=True))
    errors = [
        float((Reconstructor(Pyramid(), calibration, device="cpu", room_light=on)(measurement + light) - scene).norm())
        for on in (False, True)
    ]
    assert errors[1] < 0.8 * errors[0]
    dark = [Reconstructor(Pyramid(), calibration, device="cpu", room_light=on)(measurement) for on in (False, True)]
    assert torch.equal(*dark)


def test_a_spot_is_fitted_again_in_finer_pixels():
    """A frame of 72 x 96 is searched at half its size. That alone leaves an error of a third of the spot's light."""
    size, generator = (72, 96), torch.Generator().manual_seed(1)
    psf = contour_psf(size, cell=12, generator=generator).expand(1, 3, -1, -1)
    scene = F.interpolate(torch.rand(1, 3, 12, 16, generator=generator), size, mode="bicubic").clamp(min=0)
    measurement, light = lit(scene, psf, 0.3 * spot_light(size, (0.4, 0.6), 0.15))
    found = find_room_light(measurement + light, psf)
    assert float((found.background - light).norm() / light.norm()) < 0.2


@pytest.mark.parametrize("size", [(1, 1), (1, 40), (40, 1)])
def test_a_single_row_or_column_has_none(size):
    measurement = torch.rand(2, 3, *size, generator=torch.Generator().manual_seed(0))
    background, share = find_room_light(measurement, torch.ones(1, 3, *size))
    assert (background.shape, background.any(), share.tolist()) == (measurement.shape, False, [0.0, 0.0])

"""What [mismatch] adds to a capture when its options for real captures are on."""

import math
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch

from cameras import contour_psf
from mwdn.data.mismatch import EXACT, REAL_OPTIONS, Mismatch
from mwdn.data.photographs import Photographs
from mwdn.data.real_camera import RealCamera, field_camera
from mwdn.data.simulated import Placement, SimulatedPairs
from mwdn.errors import ParameterError
from mwdn.fourier.convolution import convolve
from mwdn.optics import FieldCamera, Sensor, field_psfs
from mwdn.optics.deviation import off_axis_change
from mwdn.optics.warp import warp

SIZE = 32, 40
CLEAN = Sensor(full_well=1e9, read_noise=0.0, bit_depth=16, black_level=0.0)
ALL = replace(EXACT, **dict.fromkeys(REAL_OPTIONS, 0.3), full=True)


@pytest.fixture
def psf(generator):
    return contour_psf(SIZE, cell=10, generator=generator).expand(1, 3, -1, -1).contiguous()


@pytest.fixture
def pairs(tmp_path, psf):
    pixels = np.random.default_rng(1).integers(30, 256, (4, 4, 3), np.uint8)
    cv2.imwrite(str(tmp_path / "one.png"), cv2.resize(pixels, (24, 24), interpolation=cv2.INTER_CUBIC))
    place = Placement(ambient=(0.0, 0.0))
    return SimulatedPairs(Photographs(tmp_path, side=24), psf, placement=place, mismatch=EXACT, sensor=CLEAN)


def drawn(count=200, **options):
    return RealCamera(replace(EXACT, **options), tuple(range(count)), (False,) * count)


def test_each_option_changes_captures_and_no_scene(pairs):
    """An option that is read nowhere would look as if it were on."""
    plain = pairs.batch(range(4))
    for name in REAL_OPTIONS:
        options = {"eight_bit": {name: 1.0}, "gamma_coded": {name: 1.0}, "gamma_error": {name: 0.3, "gamma_coded": 1.0}}
        options = options.get(name, {name: 0.3})
        other = replace(pairs, mismatch=replace(EXACT, **options, full=True)).batch(range(4))
        assert torch.equal(other.scene, plain.scene)
        assert (other.measurement - plain.measurement).norm() > 1e-3 * plain.measurement.norm(), name


def test_exact_samples_have_none_of_it(pairs):
    exact = replace(pairs, mismatch=replace(ALL, exact=1.0)).batch(range(3)).measurement
    plain = pairs.batch(range(3)).measurement
    assert (exact - plain).abs().max() < 2e-3 * plain.max()  # photon noise alone


def test_options_are_drawn_apart(psf):
    """Another option on or off, or another sample in the batch, changes nothing: training sets can be compared."""
    both = drawn(4, tails=0.3, aperture_gain=0.3, room_light=0.5).lit(psf.expand(4, -1, -1, -1))
    alone = replace(drawn(4, room_light=0.5), seeds=(2,), exact=(False,)).lit(psf)
    torch.testing.assert_close(both[2:3], alone)


def test_light_of_the_psf_is_kept(psf):
    changed = drawn(5, envelope_shift=0.1, aperture_gain=0.5, tails=0.5).psf(psf.expand(5, -1, -1, -1))
    torch.testing.assert_close(changed.sum((-2, -1)), torch.ones(5, 3))
    assert changed.min() >= 0
    assert len({round(float(one[0, 16, 20]), 7) for one in changed}) == 5


@pytest.mark.parametrize("number", range(6))
def test_room_light_has_its_share(number):
    """Of the mean of what was there: even, slope and spot, whatever their colour."""
    light = torch.rand(1, 3, *SIZE, generator=torch.Generator().manual_seed(3))
    lit = RealCamera(replace(EXACT, room_light=0.5, full=True), (number,), (False,)).lit(light)
    assert float((lit - light).mean() / light.mean()) == pytest.approx(0.5, rel=1e-4)


def test_room_light_has_three_shapes():
    """A third each, 5 standard deviations of 7 %: largest over mean light is 1 (even), 2 (slope) or more (spot)."""
    black = torch.full((200, 1, *SIZE), 1.0)
    room = drawn(room_light=0.5, full=True).lit(black)[:, 0] - 1
    ratio = room.amax((1, 2)) / room.mean((1, 2))
    flatness = room.amin((1, 2)) / room.mean((1, 2))
    even, slope = flatness > 0.999, (ratio - 2).abs() + flatness < 0.15
    for kind in (even, slope, ~even & ~slope):
        assert 0.16 < kind.float().mean() < 0.5


def test_hot_pixels_are_as_many_as_asked():
    """0.02 of 200 x 1280 pixels: 5120 with a standard deviation of 71; half of their light is half of the scale."""
    heat = drawn(hot_pixels=0.02, full=True).heated(torch.zeros(200, 1, *SIZE))
    assert abs(int((heat > 0).sum()) - 5120) < 5 * 71
    assert float(heat[heat > 0].mean()) == pytest.approx(0.5, abs=5 * 0.289 / math.sqrt(5000))
    assert heat.max() <= 1


def test_fractions_of_samples_are_read_with_8_bits_or_coded():
    camera = drawn(eight_bit=0.5, gamma_coded=0.25)
    bits = [sensor.bit_depth for sensor in camera.sensors(Sensor())]
    assert set(bits) == {8, 12}
    assert 0.2 < bits.count(8) / 200 < 0.55  # 0.375 of them, since coded files are another option
    assert {sensor.bit_depth for sensor in camera.sensors(Sensor(bit_depth=6))} == {6}
    captures = torch.full((200, 1, 1, 1), 0.3)
    changed = (camera.decoded(captures) - captures).abs().flatten() > 0
    assert 0.1 < changed.float().mean() < 0.4
    assert (camera.decoded(captures) - captures).abs().max() < 2.2 / 510  # the right gamma: rounding only


def test_field_and_depth_of_nothing_are_the_plain_camera(psf):
    scene, outline = torch.rand(1, 3, *SIZE), torch.ones(1, 1, *SIZE)
    plain = convolve(scene, psf)
    torch.testing.assert_close(field_camera(psf, outline, 0.0, 0.0).forward(scene), plain, rtol=1e-4, atol=1e-6)
    tiny = field_camera(psf, outline, 1e-6, 1e-6).forward(scene)
    torch.testing.assert_close(tiny, plain, rtol=1e-3, atol=1e-4)
    near = field_camera(psf, outline, 0.0, 0.1).forward(scene)  # all near: one magnified PSF
    torch.testing.assert_close(near, convolve(scene, warp(psf, 1.05 * torch.eye(2)) / 1.05**2), rtol=1e-4, atol=1e-6)


def test_light_of_the_field_falls_towards_the_corner(psf):
    """A fall-off of 0.3 at `off_axis` 1, in the corner of the scene."""
    camera = field_camera(psf, torch.ones(1, 1, *SIZE), 1.0, 0.0)
    every = field_psfs(psf, (3, 3), off_axis_change(1.0, SIZE))
    whole = FieldCamera.from_psfs(every, SIZE)  # all nine points
    for place in ((0, 0), (7, 31), (31, 0), (20, 39)):
        torch.testing.assert_close(camera.psf_at(*place), whole.psf_at(*place), rtol=1e-3, atol=1e-6)
    middle, corner = (camera.psf_at(*place).sum((-2, -1)) for place in ((16, 20), (0, 0)))
    assert middle.tolist()[0] == pytest.approx([1.0] * 3, abs=0.03)
    assert (corner < 0.75).all()  # and what the larger pattern loses beyond the frame


@pytest.mark.parametrize(
    ("name", "value"), [("tails", 1.0), ("eight_bit", 1.1), ("off_axis", 4.0), ("depth", -0.1), ("room_light", -1.0)]
)
def test_ranges(name, value):
    with pytest.raises(ParameterError, match=rf"`{name}` \({value}\)"):
        Mismatch(**{name: value})

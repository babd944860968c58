"""Frames of a point source become a PSF: averages, hot pixels, dynamic range, noise, exposure."""

import numpy as np
import pytest
import torch

from mwdn.calibration import FrameFormat
from mwdn.calibration.dynamic_range import merge_exposures
from mwdn.calibration.exposure import measure_exposure
from mwdn.calibration.frame_average import average_frames
from mwdn.calibration.hot_pixels import find_dead_pixels, find_hot_pixels
from mwdn.calibration.photon_transfer import photon_transfer
from mwdn.calibration.pixel_repair import PixelRepair
from mwdn.errors import ImageError, ParameterError, ShapeError
from mwdn.optics import Sensor
from mwdn.optics.displacement import displacement, shifted
from photographed_camera import SENSOR, STEPS, Bench

FORMAT = FrameFormat(bit_depth=12)
SPAN = 1 - SENSOR.black_level  # light of 1 reaches the full scale from the black level on


@pytest.fixture(scope="module")
def bench():
    return Bench()


@pytest.fixture(scope="module")
def dark(bench):
    return average_frames([bench.dark() for _ in range(8)], FORMAT, kind="dark")


def test_an_average_leaves_out_cosmic_hits_and_names_outlying_frames(bench, dark):
    frames = [bench.point() for _ in range(7)]
    frames[2][40:43, 60] = STEPS
    frames[3] = bench.point(move=(1, 0))
    frames[5] = bench.point(0.8)
    average = average_frames(frames, FORMAT, names=list("abcdefg"), dark=dark.image)
    assert average.rejected.keys() == {"d", "f"}
    assert "displaced by (1.0, -0.0) px" in average.rejected["d"] or "(1.0, 0.0)" in average.rejected["d"]
    assert "0.8" in average.rejected["f"]
    assert (average.count, int(average.saturated.sum())) == (5, 0)
    good = bench.hot == 0
    error = (average.image / SPAN - bench.light)[good]
    read = (SENSOR.read_noise / SENSOR.full_well) ** 2
    model = ((bench.light / SENSOR.full_well + read) / 5 + read / 8)[good].sqrt()  # of 5 frames less 8 dark ones
    assert float((error / model).square().mean().sqrt()) == pytest.approx(1, abs=0.1)
    assert average.noise.slope == pytest.approx(SPAN / SENSOR.full_well, rel=0.25)


def test_two_frames_lose_the_higher_of_two_numbers(bench, dark):
    frames = [bench.dark() for _ in range(2)]
    frames[1][50, 50] = 3000
    average = average_frames(frames, FORMAT, kind="dark")
    assert float(average.image[0, 0, 50, 50]) == pytest.approx(frames[0][50, 50, 0] / STEPS, abs=1e-6)


@pytest.mark.parametrize("size", [(60, 80), (300, 400)])
@pytest.mark.parametrize("count", [2, 5])
def test_noise_is_no_other_pattern(size, count):
    """A peak of 100 electrons on 1,000 of stray light: averaging is for such frames."""
    bench = Bench(size, hot=0, peak=100 / 15_000)
    frames = [bench.frame(bench.light + 1_000 / 15_000) for _ in range(count)]
    assert not any("another pattern" in each for each in average_frames(frames, FORMAT).rejected.values())


def test_narrow_frames_are_averaged(bench):
    assert average_frames([bench.point()[60:68] for _ in range(2)], FORMAT).count == 2


def test_frames_that_disagree_are_refused(bench, dark):
    with pytest.raises(ParameterError, match=r"disagree: `a` has .*; `b` has .* three or more"):
        average_frames([bench.point(), bench.point(0.5)], FORMAT, names=["a", "b"], dark=dark.image)
    with pytest.raises(ImageError, match=r"`frame 2` \(64 x 80 x 1, uint16\) must be like `frame 1`"):
        average_frames([bench.point(), bench.point()[::2, ::2]], FORMAT)
    with pytest.raises(ImageError, match="at least one"):
        average_frames([], FORMAT)


def test_dark_frames_of_another_size_are_named(bench):
    """They ended in torch's error."""
    with pytest.raises(ImageError, match=r"`frame 1` \(8 x 9\) must be like the dark frames \(8 x 8\)"):
        average_frames([np.ones((8, 9, 1), np.uint16)] * 2, dark=torch.zeros(1, 1, 8, 8))


def test_hot_pixels_are_found_and_replaced(bench, dark):
    found = find_hot_pixels(dark)
    assert int((found & (bench.hot > 0)).sum()) == int((bench.hot > 0).sum())
    assert int((found & (bench.hot == 0)).sum()) <= 1
    slope = torch.arange(160.0).expand(1, 1, 128, 160)
    broken = torch.where(found, 1e3, slope)
    inside = torch.zeros_like(found)
    inside[..., 2:-2, 2:-2] = True
    torch.testing.assert_close(PixelRepair(found[0, 0])(broken)[inside], slope[inside], atol=0.51, rtol=0)


def test_noise_that_is_cut_off_at_black_makes_no_hot_pixels(generator):
    """Raw files are read from their black level on: values above 0 were outliers, and a tenth of the pixels hot."""
    noise = 1.25 * torch.randn(6, 96, 128, 1, generator=generator)
    noise[:, 40, 70] += 60
    dark = average_frames([*(16 * noise.round().clamp(min=0)).numpy().astype("u2")], kind="dark")
    assert find_hot_pixels(dark)[0, 0].nonzero().tolist() == [[40, 70]]
    assert dark.noise.floor == pytest.approx((16 * 0.75 / 65535) ** 2, rel=0.6)  # of what is left of the noise


@pytest.mark.parametrize("cell", [1, 2])
def test_dark_borders_of_frames_through_the_mask_are_no_defects(generator, cell):
    """A quarter of the pixels of a good sensor were dead: noise at the dark border, and its slope."""
    y, x = torch.linspace(-1, 1, 96)[:, None], torch.linspace(-1, 1, 128)
    light = torch.exp(-12 * (y.square() + x.square()))
    if cell == 2:
        light = light * torch.tensor([[1.0, 0.4], [0.4, 0.7]]).repeat(48, 64)
    deviation = (0.002**2 + 1e-4 * light).sqrt()
    flat = light + deviation * torch.randn(96, 128, generator=generator)
    flat[48, 64], flat[40, 70], flat[3, 3] = 0.0, 1.5, 0.3
    found = find_dead_pixels(flat, deviation, cell=cell, through_mask=True)[0, 0]
    assert found.nonzero().tolist() == [[3, 3], [40, 70], [48, 64]]


def test_repair_of_a_mosaic_takes_pixels_of_the_same_colour(generator):
    colours = torch.tensor([[1.0, 2.0], [3.0, 4.0]]).repeat(4, 4)[None, None]
    defects = torch.zeros(8, 8, dtype=torch.bool)
    defects[3, 4] = defects[0, 0] = defects[3, 6] = True
    broken = torch.where(defects, 100.0, colours)
    torch.testing.assert_close(PixelRepair(defects, 2)(broken), colours)
    block = torch.zeros(8, 8, dtype=torch.bool)
    block[2:5, 2:5] = True
    ones = torch.ones(1, 1, 8, 8)
    torch.testing.assert_close(PixelRepair(block)(torch.where(block, 9.0, ones)), ones)
    wide = torch.ones(24, 24, dtype=torch.bool)
    wide[:4] = False
    repaired = PixelRepair(wide)(torch.where(wide, 9.0, torch.ones(1, 1, 24, 24)))  # up to 8 pixels away
    assert repaired[0, 0, :, 12].tolist() == pytest.approx([1.0] * 12 + [9.0] * 12)


def test_merged_exposures_are_right_over_four_decades(bench, dark):
    """Within 2 % of the truth in each decade, and at each pixel as far from it as its noise says."""
    exposures = [64.0, 1.0, 512.0, 8.0]
    averages = [average_frames([bench.point(t) for _ in range(6)], FORMAT, dark=dark.image) for t in exposures]
    merged = merge_exposures(averages, exposures)
    assert merged.exposures == pytest.approx((1, 8, 64, 512), rel=0.01)
    good = bench.hot == 0
    for decade in (1e-4, 1e-3, 1e-2, 1e-1):
        pixels = good & (bench.light >= decade * 0.75) & (bench.light < decade * 7.5)
        image, light = merged.image[pixels] / SPAN, bench.light[pixels]
        assert len(light) > 100
        assert float(image.sum() / light.sum()) == pytest.approx(1, abs=0.01)
        assert float((image / light - 1).square().mean().sqrt()) < 0.02
        assert float(((image - light) * SPAN / merged.noise[pixels]).square().mean().sqrt()) == pytest.approx(
            1, abs=0.2
        )


def test_exposures_are_measured_and_wrong_ones_refused(bench, dark):
    averages = [average_frames([bench.point(t) for _ in range(3)], FORMAT, dark=dark.image) for t in (1, 7.6)]
    assert merge_exposures(averages, [1.0, 8.0]).exposures[1] == pytest.approx(7.6, rel=0.01)
    with pytest.raises(ParameterError, match="times the light"):
        merge_exposures(averages[::-1], [1.0, 8.0])
    for exposures in ([1.0, 1.0], [0.0, 1.0], [1.0]):
        with pytest.raises(ParameterError, match="exposures"):
            merge_exposures(averages, exposures)


@pytest.mark.parametrize("sensor", [SENSOR, Sensor(6_000.0, 8.0, 12, 0.03), Sensor(60_000.0, 20.0, 12, 0.02)])
def test_photon_transfer_finds_gain_and_noise(sensor):
    bench = Bench(hot=0)
    shape = torch.zeros(1, 1, 128, 160)
    darks = [bench.frame(shape, sensor) for _ in range(2)]
    slope = torch.linspace(0.8, 1.0, 160)
    flats = [bench.frame(shape + level * slope, sensor) for level in (0.2, 0.5, 0.8) for _ in range(2)]
    found = photon_transfer(flats, darks, FORMAT)
    gain = sensor.full_well / (STEPS * (1 - sensor.black_level))
    assert found.electrons_per_count == pytest.approx(gain, rel=0.03)
    assert found.read_noise == pytest.approx(sensor.read_noise, rel=0.04)
    assert found.full_well == pytest.approx(sensor.full_well, rel=0.03)
    assert found.black_level == pytest.approx(sensor.black_level, abs=1e-4)
    assert found.sensor.bit_depth == 12
    assert (found.error < 0.02, found.clipped) == (True, False)


def test_frames_without_an_axis_of_channels_give_the_same(bench):
    darks, flats = [bench.dark() for _ in range(2)], [bench.flat(0.5) for _ in range(2)]
    plane_darks, plane_flats = ([frame[..., 0] for frame in frames] for frames in (darks, flats))
    assert photon_transfer(plane_flats, plane_darks, FORMAT) == photon_transfer(flats, darks, FORMAT)
    average, of_planes = (average_frames(frames, FORMAT, kind="dark") for frames in (darks, plane_darks))
    assert torch.equal(average.image, of_planes.image)


def test_an_outlier_takes_no_frame_of_its_name_along(bench, dark):
    frames = [bench.point(0.5), *(bench.point() for _ in range(4))]
    average = average_frames(frames, FORMAT, names=["a.png", "b.png", "a.png", "b.png", "c.png"], dark=dark.image)
    assert (average.count, [*average.rejected]) == (4, ["a.png (1)"])


def test_photon_transfer_finds_pixels_that_are_full_before_the_converter():
    bench, sensor = Bench(hot=0), Sensor(15_000.0, 3.0, 12, 0.01)
    shape = torch.zeros(1, 1, 128, 160)

    def flat(level):
        """A well that holds no more than 0.7 of what the converter can read: its noise ends there."""
        capture = bench.frame(shape + level, sensor)
        full = round((0.7 * (1 - 0.01) + 0.01) * STEPS)
        return np.minimum(capture, full)

    flats = [flat(level) for level in (0.2, 0.4, 0.6, 0.8) for _ in range(2)]
    found = photon_transfer(flats, [bench.frame(shape, sensor) for _ in range(2)], FORMAT)
    assert found.electrons_per_count == pytest.approx(15_000 / (STEPS * 0.99), rel=0.04)
    assert found.full_well == pytest.approx(0.6 * 15_000, rel=0.05)  # the highest level that is not full


def test_photon_transfer_refuses_what_tells_nothing(bench):
    darks, flats = [bench.dark() for _ in range(2)], [bench.flat(0.5) for _ in range(2)]
    for wrong, message in (
        ((flats[:1], darks), "two flat frames"),
        (([bench.flat(4.0)] * 2 + [flats[0], bench.flat(0.8)], darks), "frames 3 and 4 must have the same light"),
        (([bench.flat(4.0)] * 2, darks), "saturated"),
        (([flats[0]] * 2, darks), "no noisier"),
        ((flats, [dark[:-2] for dark in darks]), "one size"),
    ):
        with pytest.raises(ParameterError, match=message):
            photon_transfer(*wrong, FORMAT)
    with pytest.raises(ParameterError, match="linear in light"):
        photon_transfer(flats, darks, FrameFormat(gamma="srgb"))


def test_the_exposure_to_use_next():
    bench = Bench(hot=0)
    for exposure in (0.25, 0.5, 1.0):
        measured = measure_exposure(bench.point(exposure), FORMAT, black=SENSOR.black_level)
        peak = float(bench.light.flatten().sort().values[-3]) * exposure
        assert measured.peak == pytest.approx(peak * SPAN + SENSOR.black_level, rel=0.06)
        assert measured.factor == pytest.approx(0.8 / peak, rel=0.06)
        assert (measured.is_good, measured.saturated) == (exposure == 1.0, 0)
    longer = measure_exposure(bench.point(3.0), FORMAT)
    assert longer.saturated > 100
    assert 0.15 < longer.factor < 0.6  # 0.36, extrapolated from the levels below saturation
    assert longer.next(12.0).endswith("ms instead of 12 ms")
    # 12 bits in a file of 16 are recognised once the frame is saturated.
    assert measure_exposure(bench.point(2.0)).peak == pytest.approx(1)
    assert measure_exposure(bench.point(1.0)).peak < 1 / 16


def test_narrow_spots_are_as_alike_between_pixels():
    """At whole pixels, spots of this width that are displaced by (0.5, 0.5) have a correlation of exp(-1/8) = 0.88."""
    y, x = torch.arange(40.0)[:, None], torch.arange(50.0)
    spots = [torch.exp(-((y - 20 - d) ** 2 + (x - 25 - r) ** 2) / 2)[None, None] for d, r in ((0, 0), (3.5, -1.5))]
    assert displacement(spots[1], spots[0]) == pytest.approx((3.5, -1.5, 1.0), abs=2e-3)


@pytest.mark.usefixtures("unchecked")
def test_displacement_between_sizes_is_refused(bench):
    with pytest.raises(ShapeError, match="must have the same height and width"):
        displacement(bench.light, bench.light[..., 1:])


def test_displacement_between_pixels(bench):
    image = bench.light
    for down, right in ((3, -7), (0, 0), (-12, 5)):
        found = displacement(shifted(image, down, right), image)
        assert found[:2] == pytest.approx((down, right), abs=0.01)
    half = (image + shifted(image, 1, 0)) / 2
    assert displacement(half, image).down == pytest.approx(0.5, abs=0.01)
    assert torch.equal(shifted(image, 200, 0), torch.zeros_like(image))

"""Simulated pairs: reproducible, right side up, and as bright, sharp and noisy as they say."""

import math
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch

from cameras import contour_psf
from mwdn.data.cameras import CameraPairs, Cameras
from mwdn.data.mismatch import EXACT, Mismatch, perturb
from mwdn.data.noisy import Denoising, NoisyScenes
from mwdn.data.photographs import Photographs
from mwdn.data.random import uniform
from mwdn.data.simulated import Placement, SimulatedPairs, _resample
from mwdn.data.unpaired import UnpairedCaptures
from mwdn.errors import ParameterError
from mwdn.optics import Camera, Sensor
from mwdn.optics.warp import affine

SIZE = 32, 40
CLEAN = Sensor(full_well=1e9, read_noise=0.0, bit_depth=16, black_level=0.0)
PLAIN = Placement(extent=(0.5, 0.5), aspect=1.0, turn_degrees=0.0, offset=0.0, ambient=(0.0, 0.0))
"""A square in the middle, upright."""


@pytest.fixture(scope="module")
def photographs(tmp_path_factory):
    folder = tmp_path_factory.mktemp("photographs")
    random = np.random.default_rng(1)
    for number in range(5):
        smooth = cv2.resize(random.integers(30, 256, (3, 3, 3), np.uint8), (24, 24), interpolation=cv2.INTER_CUBIC)
        cv2.imwrite(str(folder / f"{number}.png"), smooth)
    return Photographs(folder, side=24)


@pytest.fixture
def psf(generator):
    return contour_psf(SIZE, cell=10, generator=generator).expand(1, 3, -1, -1).contiguous()


def one(tmp_path, pixels):
    """A folder with this one photograph."""
    cv2.imwrite(str(tmp_path / "one.png"), pixels[..., ::-1])
    return Photographs(tmp_path, side=len(pixels))


def generators(count, seed=7):
    return [torch.Generator().manual_seed(seed + number) for number in range(count)]


def delta(*size, channels=3):
    psf = torch.zeros(1, channels, *size)
    psf[..., size[0] // 2, size[1] // 2] = 1
    return psf


def moments(image):
    """Centroid (row, column) and variance along each axis of an (H, W) picture."""
    image = image.double() / image.double().sum()
    y, x = torch.arange(image.shape[0]).double(), torch.arange(image.shape[1]).double()
    rows, columns = image.sum(1), image.sum(0)
    centre = float(rows @ y), float(columns @ x)
    return centre, (float(rows @ (y - centre[0]) ** 2), float(columns @ (x - centre[1]) ** 2))


# --- Numbers and seeds --------------------------------------------------------------------------------


def test_same_number_same_pair_in_any_batch(photographs, psf):
    pairs = SimulatedPairs(photographs, psf, seed=3)
    together = pairs.batch(range(10, 14))
    assert together.measurement.shape == together.scene.shape == (4, 3, *SIZE)
    for part in (pairs.batch(range(10, 14)), SimulatedPairs(photographs, psf, seed=3).batch([10, 11, 12, 13])):
        assert torch.equal(part.measurement, together.measurement)
        assert torch.equal(part.scene, together.scene)
    # Several at once are transformed and convolved in another order: equal but for rounding.
    for place, number in ((2, 12), (0, 10)):
        alone = pairs.batch([number])
        torch.testing.assert_close(alone.scene[0], together.scene[place], rtol=0, atol=1e-5)
        assert (alone.measurement[0] - together.measurement[place]).abs().mean() < 1e-4
    backwards = pairs.batch([13, 10])
    torch.testing.assert_close(backwards.scene[1], together.scene[0], rtol=0, atol=1e-5)


def test_a_grey_camera_sees_the_mean_of_the_colours(photographs, psf):
    """Scenes are those of a colour camera, averaged; the measurement is the forward model of that."""
    grey, colour = (
        SimulatedPairs(photographs, psf[:, :1], mismatch=EXACT, sensor=CLEAN, grey=g) for g in (True, False)
    )
    batch, scene = grey.batch(range(3)), colour.batch(range(3)).scene
    torch.testing.assert_close(batch.scene, scene.mean(1, keepdim=True))
    light = Camera(psf[:, :1]).forward(batch.scene)
    ratio = (batch.measurement - light).abs().amax() / light.amax()
    assert (batch.measurement.shape, batch.scene.shape) == ((3, 1, *SIZE),) * 2
    assert ratio < 0.06  # up to 5 % of even light, and the rounding of the sensor


def test_samples_are_float32_under_autocast(photographs, psf):
    simulated = SimulatedPairs(photographs, psf, mismatch=Mismatch(full=True))
    captures = UnpairedCaptures(simulated.batch(range(2)).measurement, psf[:, :1])
    scene, light = simulated.scenes(generators(2)), torch.zeros(2, 3, 1, 1)
    for make in (
        lambda: simulated.batch(range(2)),
        lambda: NoisyScenes(simulated, Denoising((0.01, 0.02))).batch(range(2)),
        lambda: CameraPairs(simulated, Cameras(("32x40",)), 2).batch(range(2)),
        lambda: replace(captures, poses={}).batch(range(2)),
        lambda: captures.recapture(scene, psf.expand(2, -1, -1, -1), light, range(2)),
    ):
        alone = make()
        with torch.autocast("cpu", torch.bfloat16):
            within = make()
        for one, other in zip(alone, within, strict=True):
            assert torch.equal(one, other)


def test_numbers_and_seeds_differ(photographs, psf):
    scenes = [SimulatedPairs(photographs, psf, seed=seed).batch(range(4)).scene for seed in (0, 1)]
    every = torch.cat(scenes)
    distances = torch.cdist(every.flatten(1), every.flatten(1)) + torch.eye(8) * 1e9
    assert distances.min() > 0.1


def test_all_photographs_are_used(photographs, psf):
    pairs = SimulatedPairs(photographs, psf, placement=PLAIN)
    scenes = pairs.scenes(generators(60))
    means = {tuple((scene.mean((1, 2)) * 1000).round().tolist()) for scene in scenes}
    assert len(means) == len(photographs)


def test_backdrop_is_even_and_beside_the_photograph(tmp_path, psf):
    """What shows how bright it is stands around a white square; a recipe without one draws what it always drew."""
    white = one(tmp_path, np.full((24, 24, 3), 255, np.uint8))
    placement = replace(PLAIN, backdrop=(0.2, 0.3))
    scene = SimulatedPairs(white, psf, placement=placement).scenes(generators(4))
    height, width = SIZE
    inside = scene[..., height // 2 - 7 : height // 2 + 7, width // 2 - 7 : width // 2 + 7]
    torch.testing.assert_close(inside, torch.ones_like(inside))
    beside = scene[..., :4]
    assert beside.amin() >= 0.2
    assert beside.amax() <= 0.3
    assert beside.flatten(2).std(-1).max() < 1e-6
    assert beside.mean((-2, -1)).unique().numel() == 12  # each colour of each sample its own
    for backdrop in ((0.3, 0.2), (0.0, 1.1)):
        with pytest.raises(ParameterError, match="backdrop"):
            replace(PLAIN, backdrop=backdrop)


# --- Light --------------------------------------------------------------------------------------------


def test_exact_camera_without_noise_is_the_forward_model(photographs, psf):
    """Photon noise of 1e9 electrons is 3e-5 of full scale, a step of 16 bits 1.5e-5: five sigma and half a step.

    The measurement is in units of the scene: full scale is brightest / exposure of it.
    """
    pairs = SimulatedPairs(
        photographs, psf, placement=replace(PLAIN, exposure=(0.8, 0.8)), mismatch=EXACT, sensor=CLEAN
    )
    measurement, scene, _ = pairs.batch(range(3))
    expected = Camera(psf).forward(scene)
    full_scale = expected.amax((1, 2, 3), keepdim=True) / 0.8
    error = ((measurement - expected) / full_scale).abs()
    assert error.max() < 5.5 * math.sqrt(0.8e-9) + 0.5 / 65535 + 1e-6


def test_a_fraction_of_the_cameras_is_exact(photographs, psf):
    """The scenes stay the same."""
    spoiled = Mismatch(shift_px=3.0, full=True, vignetting=0.3)
    pairs = SimulatedPairs(photographs, psf, placement=PLAIN, mismatch=spoiled, sensor=CLEAN)

    def error(part):
        """Largest deviation of each capture from the exact camera's, relative to its brightest pixel."""
        measurement, scene, _ = replace(pairs, mismatch=replace(spoiled, exact=part)).batch(range(60))
        assert torch.equal(scene, pairs.batch(range(60)).scene)
        return (measurement - Camera(psf).forward(scene)).abs().amax((1, 2, 3)) / measurement.amax((1, 2, 3))

    mixed = error(0.25)
    assert 5 <= int((mixed < 2e-3).sum()) <= 25  # 15 of 60, within three standard deviations
    assert (mixed[mixed >= 2e-3] > 0.02).all()
    assert (error(0.0) >= 2e-3).all()
    assert (error(1.0) < 2e-3).all()
    with pytest.raises(ParameterError, match="exact"):
        Mismatch(exact=1.5)


def test_ambient_is_relative_to_the_mean(photographs, psf):
    dark = SimulatedPairs(photographs, psf, placement=PLAIN, mismatch=EXACT, sensor=CLEAN)
    lit = replace(dark, placement=replace(PLAIN, ambient=(0.25, 0.25)))
    without, with_ambient = dark.batch(range(3)), lit.batch(range(3))
    assert torch.equal(without.scene, with_ambient.scene)
    added = with_ambient.measurement - without.measurement
    expected = 0.25 * without.measurement.mean((1, 2, 3), keepdim=True)
    torch.testing.assert_close(added, expected.expand_as(added), rtol=0, atol=5e-4 * float(without.measurement.max()))
    torch.testing.assert_close(added.mean((1, 2, 3)), expected.flatten(), rtol=1e-3, atol=0)


def test_exposure_sets_brightness_over_saturation(photographs, psf):
    """The brightest pixel in steps of 4 bits; beyond saturation many pixels are equally bright."""
    coarse = replace(CLEAN, bit_depth=4)
    for exposure, levels in ((0.4, 6), (0.8, 12), (1.0, 15)):
        light = Placement(exposure=(exposure, exposure))
        pairs = SimulatedPairs(photographs, psf, placement=light, mismatch=EXACT, sensor=coarse)
        for measurement in pairs.batch(range(3)).measurement:
            step = measurement[measurement > 1e-6].min()  # of the converter, in units of the scene
            assert round(float(measurement.max() / step)) == levels
    bright = Placement(exposure=(2.0, 2.0))
    over = SimulatedPairs(photographs, psf, placement=bright, mismatch=EXACT, sensor=CLEAN).batch(range(2))
    for measurement in over.measurement:
        assert (measurement > 0.999 * measurement.max()).sum() > 10


def test_noise_of_a_flat_scene_is_the_sensors(tmp_path):
    """A white photograph larger than the sensor through a delta: light 1 everywhere, at half of the full well."""
    sensor = Sensor(full_well=1000.0, read_noise=8.0, bit_depth=12, black_level=0.05)
    pairs = SimulatedPairs(
        one(tmp_path, np.full((16, 16, 3), 255, np.uint8)),
        delta(96, 96),
        placement=replace(PLAIN, extent=(1.5, 1.5), exposure=(0.5, 0.5)),
        mismatch=EXACT,
        sensor=sensor,
    )
    measurement, scene, _ = pairs.batch(range(4))
    assert torch.equal(scene, torch.ones_like(scene))
    n = measurement.numel()
    # Relative to the full scale, then in units of the scene: divided by the gain 0.5.
    step = 1 / (4095 * 0.95)
    variance = (0.5 / 1000 + (8 / 1000) ** 2 + step**2 / 12) / 0.5**2
    assert abs(measurement.double().mean().item() - 1) < 5 * math.sqrt(variance / n) + 1e-5
    assert abs(measurement.double().var().item() - variance) < 5 * variance * math.sqrt(2.01 / n)


def test_vignetting_darkens_the_corners_alone(tmp_path):
    white = one(tmp_path, np.full((16, 16, 3), 255, np.uint8))
    pairs = SimulatedPairs(
        white,
        delta(*SIZE),
        placement=replace(PLAIN, extent=(2.0, 2.0)),
        mismatch=replace(EXACT, vignetting=0.3),
        sensor=CLEAN,
    )
    measurement = pairs.batch(range(20)).measurement
    middle, corner = measurement[..., 15:17, 19:21].mean((1, 2, 3)), measurement[..., 0, 0].mean(1)
    torch.testing.assert_close(middle, torch.ones(20), rtol=0, atol=2e-3)
    assert (corner > 0.699).all()
    assert corner.min() < 0.8 < 0.9 < corner.max()


# --- Placement ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("size", [(64, 64), (64, 96), (81, 60)])
@pytest.mark.parametrize(("extent", "aspect", "turn"), [(0.5, 1.0, 0.0), (0.5, 1.0, 30.0), (0.4, 1.5, 0.0)])
def test_white_photograph_covers_its_share(tmp_path, size, extent, aspect, turn):
    white = one(tmp_path, np.full((32, 32, 3), 255, np.uint8))
    place = Placement((extent, extent), aspect, turn, 0.3, (0.0, 0.0))
    scenes = SimulatedPairs(white, torch.ones(1, 3, *size) / math.prod(size), placement=place).scenes(generators(6))
    share = scenes.mean((1, 2, 3))
    expected = extent**2 * min(size) ** 2 / math.prod(size)
    torch.testing.assert_close(share, torch.full((6,), expected), rtol=0.03, atol=0)


def test_upright_apart_from_mirroring(tmp_path):
    pixels = np.full((32, 32, 3), 255, np.uint8)
    pixels[:16, :16] = (255, 0, 0)  # top left
    pixels[16:, :16] = (0, 255, 0)  # below it
    scenes = SimulatedPairs(one(tmp_path, pixels), delta(*SIZE), placement=PLAIN).scenes(generators(24))
    mirrored = 0
    for scene in scenes:
        top, bottom = scene[:, 8:16, 12:28], scene[:, 16:24, 12:28]  # 16 x 16 in the middle of 32 x 40
        flip = bool(top[1, :, :8].mean() > 0.5)
        mirrored += flip
        coloured = slice(8, 16) if flip else slice(0, 8)
        torch.testing.assert_close(top[..., coloured].mean((1, 2)), torch.tensor([1.0, 0, 0]), rtol=0, atol=0.15)
        torch.testing.assert_close(bottom[..., coloured].mean((1, 2)), torch.tensor([0, 1.0, 0]), rtol=0, atol=0.15)
    assert 4 < mirrored < 20


def test_touches_the_border_at_most(tmp_path):
    """At offset 1 the whole photograph is still within the frame, and some reach close to its borders."""
    white = one(tmp_path, np.full((32, 32, 3), 255, np.uint8))
    place = replace(PLAIN, offset=1.0)
    scenes = SimulatedPairs(white, delta(*SIZE), placement=place).scenes(generators(200))[:, 0]
    torch.testing.assert_close(scenes.mean((1, 2)), torch.full((200,), 16 * 16 / (32 * 40)), rtol=0.02, atol=0)
    rows = torch.tensor([moments(scene)[0][0] for scene in scenes])
    columns = torch.tensor([moments(scene)[0][1] for scene in scenes])
    assert 7.4 < rows.min() < 8.5
    assert 22.5 < rows.max() < 23.6
    assert 7.4 < columns.min() < 8.8
    assert 30.2 < columns.max() < 31.6


# --- affine -------------------------------------------------------------------------------------------


def number(value):
    return torch.tensor([float(value)])


def mapped(theta, x, y):
    """Where in the picture the frame's point (x, y) comes from."""
    return (theta[0] @ torch.tensor([x, y, 1.0])).tolist()


def test_affine_identity_scale_and_shift():
    none = torch.zeros(1, 2)
    identity = affine(number(0), number(1), number(1), none, 1.25)
    torch.testing.assert_close(identity, torch.tensor([[[1.0, 0, 0], [0, 1, 0]]]))
    half = affine(number(0), number(0.5), number(0.25), none, 1.25)
    assert mapped(half, 0.25, 0.5) == pytest.approx([1, 1])  # the picture's corner, at a quarter and a half
    moved = affine(number(0), number(0.5), number(0.5), torch.tensor([[0.2, -0.4]]), 1.25)
    assert mapped(moved, -0.4, 0.2) == pytest.approx([0, 0], abs=1e-7)  # its middle: down 0.2, left 0.4
    assert mapped(moved, 0.1, 0.7) == pytest.approx([1, 1])


def test_affine_turns_clockwise():
    """A quarter turn brings the picture's right to the frame's bottom; in a wide frame over another part of it."""
    theta = affine(number(math.pi / 2), number(1), number(1), torch.zeros(1, 2), 1.0)
    assert mapped(theta, 0.0, 1.0) == pytest.approx([1, 0], abs=1e-6)
    wide = affine(number(math.pi / 2), number(0.5), number(0.25), torch.zeros(1, 2), 2.0)
    # 0.25 of a half frame twice as wide as high is 0.5 of its height.
    assert mapped(wide, 0.0, 0.5) == pytest.approx([1, 0], abs=1e-6)
    assert mapped(wide, -0.25, 0.0) == pytest.approx([0, 1], abs=1e-6)


@pytest.mark.parametrize("turn", [0, 20, 45, 70])
def test_turned_square_stays_a_square(turn):
    """Variances of a uniform square of side a are a^2 / 12 along any axis, and its covariance is 0."""
    height, width, side = 96, 160, 40.0
    theta = affine(
        torch.deg2rad(number(turn)), number(side / height), number(side / width), torch.zeros(1, 2), width / height
    )
    square = _resample(torch.ones(1, 1, 16, 16), theta, (height, width))[0, 0]
    centre, variances = moments(square)
    assert centre == pytest.approx([(height - 1) / 2, (width - 1) / 2], abs=1e-2)
    assert variances[0] == pytest.approx(variances[1], rel=5e-3)
    assert variances[0] == pytest.approx(side**2 / 12, rel=0.04)  # its blurred edge makes it a little larger
    y, x = torch.arange(height) - centre[0], torch.arange(width) - centre[1]
    assert abs(float((square * y[:, None] * x).sum() / square.sum())) < 0.005 * side**2 / 12


@pytest.mark.parametrize("blur", [0.7, 2.0, 6.0])
def test_blur_has_its_standard_deviation(blur):
    """Seven taps held 2 pixels at most."""
    point = torch.zeros(20, 1, 65, 65)
    point[..., 32, 32] = 1
    rows = perturb(point, replace(EXACT, blur_px=blur), generators(20)).sum(-1)[:, 0]
    widths = (rows * (torch.arange(65) - 32.0).square()).sum(-1).sqrt()
    assert 0.85 * blur < widths.max() < 1.03 * blur


def test_a_psf_is_not_moved_out_of_its_frame():
    with pytest.raises(ParameterError, match=r"`shift_px` \(20\) must be at most 16"):
        perturb(torch.ones(1, 1, 64, 80), replace(EXACT, shift_px=20.0), generators(1))


# --- perturb ------------------------------------------------------------------------------------------


def test_sums_stay_one(psf):
    found = perturb(psf.expand(6, -1, -1, -1), Mismatch(2.0, 5.0, 0.1, 0.7, 0.3, 1.0, 0.1), generators(6))
    assert found.shape == (6, 3, *SIZE)
    torch.testing.assert_close(found.sum((-2, -1)), torch.ones(6, 3))
    assert found.min() >= 0


def test_exact_changes_nothing_and_small_sizes_little(psf):
    assert torch.equal(perturb(psf, EXACT, generators(1)), psf)
    tiny = perturb(psf, replace(EXACT, vignetting=0.5), generators(1))  # not of the PSF: goes the whole way
    torch.testing.assert_close(tiny, psf, rtol=1e-4, atol=1e-7)


@pytest.mark.parametrize("size", [(32, 40), (33, 41), (32, 41)])
@pytest.mark.parametrize("channels", [1, 3])
def test_centre_stays_under_turn_and_scale(size, channels):
    mismatch = replace(EXACT, turn_degrees=20.0, scale=0.2)
    found = perturb(delta(*size, channels=channels).expand(8, -1, -1, -1), mismatch, generators(8))
    for plane in found.flatten(0, 1):
        assert plane.argmax() == (size[0] // 2) * size[1] + size[1] // 2
        assert moments(plane)[0] == pytest.approx([size[0] // 2, size[1] // 2], abs=0.01)


def test_scale_and_turn_move_the_rest():
    """A point right of the centre moves along its row by the scale, and around the centre as the PSF turns."""
    point = torch.zeros(1, 1, 41, 61)
    point[..., 20, 50] = 1  # 20 pixels right of the centre (20, 30)
    scaled = perturb(point.expand(10, -1, -1, -1), replace(EXACT, scale=0.1), generators(10))
    offsets = torch.tensor([moments(plane[0])[0] for plane in scaled]) - torch.tensor([20.0, 30.0])
    assert offsets[:, 0].abs().max() < 0.02
    assert 18 - 0.1 < offsets[:, 1].min() < offsets[:, 1].max() < 22 + 0.1
    turned = perturb(point.expand(10, -1, -1, -1), replace(EXACT, turn_degrees=10.0), generators(10))
    offsets = torch.tensor([moments(plane[0])[0] for plane in turned]) - torch.tensor([20.0, 30.0])
    torch.testing.assert_close(offsets.norm(dim=1), torch.full((10,), 20.0), rtol=0, atol=0.15)
    assert offsets[:, 0].abs().max() < 20 * math.sin(math.radians(10)) + 0.1
    assert offsets[:, 0].min() < 0 < offsets[:, 0].max()


def test_shift_moves_by_the_drawn_pixels():
    """The first two numbers of each generator: down and right."""
    mismatch = replace(EXACT, shift_px=3.0)
    drawn = uniform(generators(6), -3.0, 3.0, 2)
    found = perturb(delta(31, 42).expand(6, -1, -1, -1), mismatch, generators(6))
    for sample, shift in zip(found, drawn, strict=True):
        for plane in sample:
            assert moments(plane)[0] == pytest.approx([15 + float(shift[0]), 21 + float(shift[1])], abs=0.01)


def test_colours_part_around_green():
    mismatch = replace(EXACT, colour_shift_px=2.0)
    drawn = [
        uniform([g], 0.0, 0.0, 2) + uniform([g], -2.0, 2.0, 2) for g in generators(4)
    ]  # after the two of the shift
    found = perturb(delta(31, 42).expand(4, -1, -1, -1), mismatch, generators(4))
    for sample, spread in zip(found, drawn, strict=True):
        for plane, sign in zip(sample, (-1, 0, 1), strict=True):
            expected = torch.tensor([15.0, 21.0]) + sign * spread[0]
            assert moments(plane)[0] == pytest.approx(expected.tolist(), abs=0.01)


def test_blur_has_the_drawn_variance():
    """From 0.6 pixels on, where sampling the Gaussian is exact, and up to 0.8, where 7 pixels hold it."""
    found = perturb(delta(31, 42).expand(40, -1, -1, -1), replace(EXACT, blur_px=0.8), generators(40))
    seen = 0
    for plane, generator in zip(found[:, 0], generators(40), strict=True):
        torch.rand(6, generator=generator)  # shift, colours, turn, scale
        sigma = 0.8 * float(torch.rand(1, generator=generator))
        if sigma < 0.6:
            assert max(moments(plane)[1]) < 0.36
            continue
        seen += 1
        assert moments(plane)[1] == pytest.approx([sigma**2, sigma**2], rel=0.02)
    assert seen > 3


def test_haze_is_even_and_part_of_the_sum():
    found = perturb(delta(16, 20).expand(30, -1, -1, -1), replace(EXACT, haze=0.2), generators(30))
    level = found[..., 0, 0] * 16 * 20
    assert (level[:, 0] == level[:, 2]).all()
    assert 0 <= level.min() < 0.03 < 0.17 < level.max() < 0.2
    torch.testing.assert_close(found[..., 8, 10], 1 - level + level / 320, rtol=0, atol=1e-4)

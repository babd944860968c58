"""Poses estimated from captures alone, of PSFs that scipy has turned and magnified."""

import numpy as np
import pytest
import torch
from scipy.ndimage import affine_transform
from torch.nn import functional as F

from cameras import contour_psf
from mwdn.errors import ParameterError, ShapeError
from mwdn.optics.aperture import displaced_envelope
from mwdn.optics.camera import Camera
from mwdn.optics.drawing import contour_lines
from mwdn.optics.warp import hazed
from mwdn.solvers import alignment
from mwdn.solvers.alignment import align, has_detail
from mwdn.solvers.pose import POSE_BLUR, Pose
from mwdn.solvers.pyramid import Pyramid

SIZE = (144, 160)


@pytest.fixture(scope="module")
def psf():
    return contour_psf(SIZE, generator=torch.Generator().manual_seed(4))


@pytest.fixture(scope="module")
def scenes():
    """Two scenes of coloured rectangles."""
    generator = torch.Generator().manual_seed(5)
    scenes = torch.zeros(2, 3, *SIZE)
    for scene in scenes:
        for _ in range(25):
            top, left = torch.randint(30, 100, (2,), generator=generator).tolist()
            scene[:, top : top + 12, left : left + 16] = torch.rand(3, 1, 1, generator=generator)
    return scenes


def test_a_capture_with_nan_keeps_the_calibrated_psf(psf, scenes):
    """Its haze was NaN, and so was each PSF moved by its pose. The other captures of the batch have their own."""
    measurement = Camera(psf).forward(scenes)
    alone = align(measurement[:1], psf, steps=1)
    measurement[1, 0, 70, 80] = torch.nan
    pose = align(measurement, psf, steps=1)
    for name, value in alone.numbers().items():
        assert Pose(*(None if part is None else part[:1] for part in pose)).numbers()[name] == pytest.approx(
            value, rel=1e-3
        )
        assert Pose(*(None if part is None else part[1:] for part in pose)).numbers()[name] == 0


def test_frames_that_show_nothing_have_no_pose(psf, scenes, generator):
    """A lens cap, or even light: the noise had a turn, a scale and haze. Poor light is no reason to give up."""
    noise = torch.randn(1, 3, *SIZE, generator=generator)
    paper = torch.full((1, 3, *SIZE), 0.5)
    for frame in (0.003 * noise, (0.003 * noise).clamp(min=0), paper, paper + 0.005 * noise):
        pose = align(frame, psf)
        assert not any(pose.numbers().values())
        assert not has_detail(frame).any()
    light = Camera(turned(psf, 1.0, 1.0)).forward(scenes[:1])
    poor = light / light.max() + 0.05 * noise  # of about 400 electrons
    assert align(torch.cat([0.003 * noise, poor]), psf).turn_degrees.tolist() == [0, pytest.approx(1.0, abs=0.5)]


@pytest.mark.usefixtures("unchecked")
def test_steps_that_cannot_be(psf):
    for steps in (-1, 1.5):
        with pytest.raises(ParameterError, match=rf"`steps` \({steps}\)"):
            align(psf, psf, steps=steps)


def turned(psf, degrees, scale):
    """An independent `warp`: scipy's cubic splines and the inverse matrix."""
    angle, (rows, columns) = np.deg2rad(degrees), psf.shape[-2:]
    # Clockwise on the screen, rows downward: what was to the right goes down.
    forward = scale * np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    inverse, centre = np.linalg.inv(forward), np.array([rows // 2, columns // 2])
    planes = [affine_transform(p, inverse, centre - inverse @ centre) for p in psf[0].double().numpy()]
    moved = torch.from_numpy(np.stack(planes)).float()[None].clamp(min=0)
    return moved / moved.sum((-2, -1), keepdim=True)


def captured(psf, scenes):
    light = Camera(psf).forward(scenes)
    noise = torch.randn(light.shape, generator=torch.Generator().manual_seed(1))
    return light + 0.003 * light.amax() * noise


@pytest.mark.parametrize(("degrees", "scale"), [(-0.8, 1.015), (0.6, 0.985)])
def test_pose_is_estimated_from_the_capture_alone(psf, scenes, degrees, scale):
    pose = align(captured(turned(psf, degrees, scale), scenes[:1]), psf, steps=3)
    torch.testing.assert_close(pose.turn_degrees, torch.tensor([degrees]), rtol=0, atol=0.15)
    torch.testing.assert_close(pose.scale, torch.tensor([scale - 1]), rtol=0, atol=0.003)


def test_a_fall_off_of_the_sensor_is_not_taken_for_a_smaller_psf(psf, scenes):
    """20 % less light in the corners; without eq. (2)'s fall-off the scale would be 0.4 % too small."""
    y, x = torch.meshgrid(*(torch.linspace(-1, 1, length) for length in SIZE), indexing="ij")
    fall_off = 1 - 0.2 * (x.square() + y.square()) / 2
    pose = align(fall_off * captured(turned(psf, 0.5, 1.0), scenes[:1]), psf)
    torch.testing.assert_close(pose.turn_degrees, torch.tensor([0.5]), rtol=0, atol=0.15)
    assert pose.scale.abs().max() < 0.002


def test_turned_psf_is_scipys(psf):
    moved = Pose(torch.tensor([2.0, -3.0]), torch.tensor([0.03, -0.02])).move(psf)
    for one, expected in zip(moved, (turned(psf, 2.0, 1.03), turned(psf, -3.0, 0.98)), strict=True):
        inside = (slice(None), slice(8, -8), slice(8, -8))
        error = (one[inside] - expected[0][inside]).norm() / expected[0][inside].norm()
        assert error < 0.06  # bicubic convolution against cubic splines, on lines of two pixels
    torch.testing.assert_close(moved.sum((-2, -1)), torch.ones(2, moved.shape[1]))


def test_haze_is_estimated_beside_a_turn_and_removes_the_veil():
    psf = contour_psf((192, 208), generator=torch.Generator().manual_seed(4))
    blocks = torch.rand(1, 3, 7, 7, generator=torch.Generator().manual_seed(5))
    scene = F.pad(blocks.repeat_interleave(8, 2).repeat_interleave(10, 3), (69, 69, 68, 68))
    clear = turned(psf, 0.5, 1.0)
    measurements = torch.cat([captured(true, scene) for true in (clear, hazed(clear, 0.1))])
    pose = align(measurements, psf)
    assert pose.haze[0] == 0
    assert 0.03 < pose.haze[1] < 0.11
    with_haze, without = (Pyramid()(measurements, p.move(psf))[1:] for p in (pose, pose._replace(haze=0.0)))
    assert (with_haze - scene).square().mean() < 0.75 * (without - scene).square().mean()


def test_haze_is_found_where_the_scene_fills_the_frame():
    """Without dark parts only the crop at the edges tells haze from faint light; missed, it costs 1 dB here."""
    psf = contour_psf((144, 156), generator=torch.Generator().manual_seed(4))
    blocks = torch.rand(1, 3, 12, 13, generator=torch.Generator().manual_seed(6))
    scene = blocks.repeat_interleave(12, 2).repeat_interleave(12, 3)
    measurement = captured(hazed(psf, 0.1), scene)
    pose = align(measurement, psf)
    assert 0.05 <= pose.haze[0] <= 0.15
    with_haze, without = (Pyramid()(measurement, p.move(psf)) for p in (pose, pose._replace(haze=0.0)))
    assert (with_haze - scene).square().mean() < 0.8 * (without - scene).square().mean()


def through_aperture(down=0.0, right=0.0):
    """Lines all over the frame, dimmer to its borders; the dimming is displaced by fractions of the height."""
    size, random = (224, 256), torch.Generator().manual_seed(4)
    field = F.interpolate(torch.randn(1, 1, 14, 16, generator=random), size=size, mode="bicubic", align_corners=True)
    y = (torch.arange(size[0]) - size[0] / 2)[:, None] / size[0] - down
    x = (torch.arange(size[1]) - size[1] / 2) / size[0] - right
    psf = contour_lines(field, 1.2) * torch.exp(-(y.square() + x.square()) / (2 * 0.18**2))
    return psf / psf.sum()


def behind_aperture():
    """A scene in the middle of the frame, of coloured blocks."""
    blocks = torch.rand(1, 3, 7, 8, generator=torch.Generator().manual_seed(5))
    return F.pad(blocks.repeat_interleave(12, 2).repeat_interleave(12, 3), (80, 80, 70, 70))


def test_displaced_aperture_is_found_and_removed():
    """Mask and aperture are not equally far from the sensor: light that comes at an angle parts their shadows."""
    psf, true = through_aperture(), turned(through_aperture(0.03, -0.02), 0.4, 1.0)
    scene = behind_aperture()
    measurement = captured(true, scene)
    pose = align(measurement, psf)
    torch.testing.assert_close(pose.envelope, torch.tensor([[0.03, -0.02]]), rtol=0, atol=0.012)  # a third too short
    torch.testing.assert_close(pose.turn_degrees, torch.tensor([0.4]), rtol=0, atol=0.1)
    errors = [
        (Pyramid()(measurement, p.move(psf)) - scene).square().mean() for p in (pose, pose._replace(envelope=None))
    ]
    assert errors[0] < 0.6 * errors[1]


def test_an_aperture_in_its_place_is_not_displaced():
    psf = through_aperture()
    assert not align(captured(psf, behind_aperture()), psf).envelope.any()


@pytest.mark.parametrize(("down", "saturated", "found"), [(0.0, 0.5, False), (0.03, 0.1, True)])
def test_overexposure_is_not_taken_for_a_displaced_aperture(down, saturated, found):
    """Clipped lines do not contradict a displacement. Without a margin the first has one of 2 %."""
    measurement = captured(through_aperture(down, 0.0), behind_aperture())
    clipped = measurement.clamp(max=float(measurement.quantile(1 - saturated)))
    assert align(clipped, through_aperture()).envelope.any() == found


def test_envelope_moves_before_haze_and_keeps_the_sum(psf):
    shift = torch.tensor([[0.05, -0.02]])
    moved = Pose(torch.zeros(1), torch.zeros(1), 0.1, shift).move(psf)
    expected = displaced_envelope(psf, shift * SIZE[0], blur=POSE_BLUR)
    torch.testing.assert_close(moved, hazed(expected / expected.sum(), 0.1))


def test_each_capture_has_its_own_pose_at_any_brightness(psf, scenes):
    measurement = torch.cat([captured(turned(psf, 1.0, 1.0), scenes[:1]), captured(psf, scenes[1:])])
    together = align(measurement * torch.tensor([7.0, 0.1])[:, None, None, None], psf)
    for number in range(2):
        alone = align(measurement[number : number + 1], 5 * psf)
        assert together.turn_degrees[number] == pytest.approx(float(alone.turn_degrees), abs=0.01)
        assert together.scale[number] == pytest.approx(float(alone.scale), abs=2e-4)
    assert together.turn_degrees[0] > 0.8 > 0.2 > abs(together.turn_degrees[1])


def test_pose_must_explain_more_by_the_minimal_gain(psf, scenes):
    measurement = torch.cat([captured(psf, scenes[1:]), captured(turned(psf, 0.3, 1.0), scenes[1:])])
    pose = align(measurement, psf)
    assert pose.turn_degrees[0] == pose.scale[0] == 0.0
    assert pose.turn_degrees[1] > 0.1
    assert align(measurement[:1], psf, min_gain=0.0).scale != 0.0  # noise moves it
    assert align(measurement[1:], psf, steps=1, min_gain=0.9).turn_degrees == 0


def test_alignment_improves_the_reconstruction(psf, scenes):
    scene = scenes[:1]
    measurement = captured(turned(psf, 1.2, 1.015), scene)
    aligned = align(measurement, psf, steps=3).move(psf)
    solve = Pyramid()
    before, after = ((solve(measurement, h) - scene).square().mean() for h in (psf, aligned))
    assert after < 0.6 * before


def test_dark_capture_of_odd_size_has_no_pose(psf):
    pose = align(torch.zeros(1, 3, 51, 43), psf[..., :37, :39])
    assert pose.turn_degrees.item() == pose.scale.item() == pose.haze.item() == 0.0
    with pytest.raises(ShapeError, match="channels"):
        align(torch.zeros(1, 3, 51, 43), psf.expand(1, 2, -1, -1))


def test_what_is_no_fall_off_stays_in_the_residual(generator):
    """A fall-off of half the bound is taken out, on the sensor; where one pose has four times the bound, none is."""
    size, grid = (30, 40), (36, 44)
    prediction = torch.zeros(1, 3, *grid)
    prediction[..., : size[0], : size[1]] = torch.randn(1, 3, *size, generator=generator)
    x = torch.linspace(-1, 1, size[1]).expand(size)
    slope = F.pad(x, (0, grid[1] - size[1], 0, grid[0] - size[0])) * prediction
    beyond = torch.zeros_like(prediction)
    beyond[..., 33, 42] = 1.0
    poses = torch.cat([c * slope + beyond for c in (0.25, 0.2, 0.25, 2.0)])  # two of each of two captures
    residuals = alignment._without_fall_off(poses, prediction.expand(4, -1, -1, -1), size, 2)
    assert residuals[:2].abs().max() < 1e-4
    assert torch.equal(residuals[2:], poses[2:])

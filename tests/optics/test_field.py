"""A PSF that changes over the field: against sums over points, its adjoint, and the plain camera."""

import math

import numpy as np
import pytest
import torch

from cameras import contour_psf
from mwdn.errors import ParameterError, ShapeError
from mwdn.optics import Aberration, Camera, FieldCamera, Sensor, field_psfs
from mwdn.optics.field import gaussian_blur, two_depths


def gaussian(size, sigma_y, sigma_x):
    y, x = torch.arange(size[0])[:, None] - size[0] // 2, torch.arange(size[1]) - size[1] // 2
    psf = torch.exp(-0.5 * (y.square() / sigma_y**2 + x.square() / sigma_x**2))
    return (psf / psf.sum())[None, None]


def spread(psf):
    """Variances down and along, and covariance, of each plane about its centroid."""
    y, x = torch.arange(float(psf.shape[-2])), torch.arange(float(psf.shape[-1]))
    plane = psf[0, 0] / psf[0, 0].sum()
    my, mx = (plane.sum(1) * y).sum(), (plane.sum(0) * x).sum()
    covariance = (plane * (y[:, None] - my) * (x - mx)).sum()
    return (plane.sum(1) * (y - my) ** 2).sum(), (plane.sum(0) * (x - mx) ** 2).sum(), covariance


def brute_force(psfs, scene, sensor):
    """Each scene pixel casts its own PSF, interpolated by hand between the grid's, onto the sensor around it."""
    rows, columns, channels, height, width = psfs.shape
    (H, W), (h, w) = scene.shape[-2:], sensor
    out = torch.zeros(len(scene), channels, h, w, dtype=torch.float64)
    for i in range(H):
        for j in range(W):
            a, b = i / max(H - 1, 1) * (rows - 1), j / max(W - 1, 1) * (columns - 1)
            r, c = min(int(a), max(rows - 2, 0)), min(int(b), max(columns - 2, 0))
            psf = 0
            for dr, wr in ((0, 1 - (a - r)), (1, a - r)):
                for dc, wc in ((0, 1 - (b - c)), (1, b - c)):
                    psf = psf + wr * wc * psfs[min(r + dr, rows - 1), min(c + dc, columns - 1)].double()
            # The centres of scene and sensor coincide: pixel (i, j) lies opposite this sensor pixel.
            top, left = i - H // 2 + h // 2 - height // 2, j - W // 2 + w // 2 - width // 2
            for y in range(max(top, 0), min(top + height, h)):
                for x in range(max(left, 0), min(left + width, w)):
                    out[:, :, y, x] += scene[:, :, i, j].double() * psf[:, y - top, x - left]
    return out


@pytest.mark.parametrize(
    ("grid", "scene", "kernel", "sensor"),
    [
        ((3, 2), (7, 9), (5, 4), (7, 9)),
        ((2, 3), (8, 5), (4, 5), (6, 9)),
        ((1, 3), (5, 6), (3, 3), None),
        ((1, 1), (4, 4), (3, 2), None),
    ],
)
def test_full_rank_is_the_sum_over_all_points(grid, scene, kernel, sensor, generator):
    psfs, v = torch.rand(*grid, 3, *kernel, generator=generator), torch.rand(2, 3, *scene, generator=generator)
    camera = FieldCamera.from_psfs(psfs, scene, size=sensor)
    assert camera.sensor_size == (sensor or scene)
    assert camera.scene_size == scene
    expected = brute_force(psfs, v, camera.sensor_size)
    torch.testing.assert_close(camera.forward(v).double(), expected, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("rank", [1, 3, None])
@pytest.mark.parametrize(("scene", "sensor"), [((20, 31), (20, 31)), ((15, 18), (24, 11))])
def test_adjoint(scene, sensor, rank, generator):
    psfs = torch.randn(3, 3, 1, 9, 12, generator=generator)
    camera = FieldCamera.from_psfs(psfs, scene, rank=rank, size=sensor)
    v, y = torch.randn(2, 3, *scene, generator=generator), torch.randn(2, 3, *sensor, generator=generator)
    Av, Ay = camera.forward(v), camera.adjoint(y)
    difference = (Av.double() * y).sum() - (v.double() * Ay).sum()
    assert difference.abs() <= 1e-5 * Av.norm() * y.norm()


def test_same_psf_everywhere_is_the_plain_camera(generator):
    psf = contour_psf((24, 30), cell=8, generator=generator).repeat(1, 3, 1, 1)
    scene = torch.rand(2, 3, 24, 30, generator=generator)
    camera = FieldCamera.from_psfs(field_psfs(psf, (4, 5), Aberration()), (24, 30))
    assert camera.rank == 1
    torch.testing.assert_close(camera.forward(scene), Camera(psf).forward(scene), rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(camera.adjoint(scene), Camera(psf).adjoint(scene), rtol=1e-4, atol=1e-5)
    with pytest.raises(ShapeError, match="sensor size"):
        camera.adjoint(scene[..., 1:])
    for place in ((0, 0), (12, 29)):
        torch.testing.assert_close(camera.psf_at(*place), psf, rtol=1e-4, atol=1e-7)


@pytest.mark.parametrize("rank", [1, 2, 5, 11, 12])
def test_truncation_costs_the_singular_values_left_out(rank, generator):
    """Eckart and Young: summed over all points, the squared error is the sum of the other squared singular values.

    The grid has a point for each scene pixel, and the sensor holds every PSF whole, so it is also the error of the
    forward model over a complete set of scenes.
    """
    psfs = torch.rand(3, 4, 2, 5, 6, generator=generator)
    values = torch.linalg.svdvals(psfs.reshape(12, -1).double())
    points = torch.eye(12).reshape(12, 1, 3, 4).expand(-1, 2, -1, -1)
    cameras = [FieldCamera.from_psfs(psfs, (3, 4), rank=r, size=(11, 13)) for r in (None, rank)]
    exact, short = (camera.forward(points).double() for camera in cameras)
    lost = values[rank:].square().sum()
    torch.testing.assert_close((exact - short).square().sum(), lost, rtol=1e-4, atol=1e-8)
    assert cameras[1].rank == rank
    assert cameras[1].truncation == pytest.approx(math.sqrt(lost / values.square().sum()), abs=1e-6)
    assert cameras[0].truncation == pytest.approx(0, abs=1e-6)


def test_few_kernels_are_enough_for_a_smooth_field(generator):
    psf = contour_psf((40, 40), cell=10, generator=generator)
    psfs = field_psfs(psf, (7, 7), Aberration(scale=0.05, stretch=0.05, blur_px=1.0, vignetting=0.3))
    lost = [FieldCamera.from_psfs(psfs, (40, 40), rank=rank).truncation for rank in (1, 4, 8, 16)]
    assert lost == sorted(lost, reverse=True)
    assert lost[0] > 0.1
    assert lost[3] < 0.05


def test_points_cast_the_psf_of_their_place(generator):
    psf = contour_psf((20, 24), cell=8, generator=generator)
    psfs = field_psfs(psf, (3, 3), Aberration(scale=0.1, blur_px=0.5))
    camera = FieldCamera.from_psfs(psfs, (21, 25), size=(60, 60))
    scene = torch.zeros(1, 1, 21, 25)
    scene[..., 20, 12] = 1
    captured = camera.forward(scene)
    # Pixel (20, 12) of the scene is 10 rows below its centre, opposite sensor pixel (40, 30).
    cut = captured[..., 40 - 10 : 40 - 10 + 20, 30 - 12 : 30 - 12 + 24]
    torch.testing.assert_close(cut, psfs[2, 1][None], rtol=1e-3, atol=1e-6)
    torch.testing.assert_close(captured.sum(), cut.sum(), rtol=1e-4, atol=0)
    torch.testing.assert_close(camera.psf_at(20, 12), psfs[2, 1][None], rtol=1e-3, atol=1e-7)


def test_aberration_of_a_gaussian():
    """Below the axis, at y = 1, half of the corner's change: along it s (1 + a / 2 + b / 2), across s (1 + a / 2)."""
    psf, square = gaussian((81, 81), 5.0, 5.0), 0.5
    changed = Aberration(scale=0.2, stretch=0.3).at(psf, 1.0, 0.0)
    down, along, _ = spread(changed)
    assert math.sqrt(down) == pytest.approx(5 * (1 + 0.5 * square), rel=0.01)
    assert math.sqrt(along) == pytest.approx(5 * (1 + 0.2 * square), rel=0.01)
    assert changed.sum().item() == pytest.approx(1, abs=5e-3)
    down, along, covariance = spread(Aberration(stretch=0.4).at(psf, 1.0, 1.0))
    # Along the diagonal the variance is 25 * 1.4^2, across it 25: half their difference is the covariance.
    assert covariance.item() == pytest.approx(25 * (1.4**2 - 1) / 2, rel=0.02)
    _, _, other = spread(Aberration(stretch=0.4).at(psf, -1.0, 1.0))
    assert other.item() == pytest.approx(-covariance.item(), rel=1e-3)
    down, along, _ = spread(Aberration(blur_px=3.0).at(psf, 0.0, 1.0))
    assert down.item() == pytest.approx(25 + 9 * square, rel=0.01)
    assert along.item() == pytest.approx(25 + 9 * square, rel=0.01)
    assert Aberration(vignetting=0.4).at(psf, 1.0, 1.0).sum().item() == pytest.approx(0.6, abs=1e-4)


def test_nothing_changes_on_the_axis(generator):
    psf = contour_psf((20, 21), cell=8, generator=generator)
    psfs = field_psfs(psf, (3, 5), Aberration(0.2, 0.1, 2.0, 0.5))
    assert torch.equal(psfs[1, 2][None], psf)
    assert torch.equal(field_psfs(psf, (1, 1), Aberration(0.2, 0.1, 2.0, 0.5))[0, 0][None], psf)
    for row, column in ((0, 0), (2, 4)):
        assert (psfs[row, column] - psf[0]).abs().sum() > 0.1


@pytest.mark.parametrize("size", [(20, 20), (21, 24)])
def test_changes_keep_the_centre(size):
    y, x = (torch.arange(float(n)) for n in size)
    psf = Aberration(scale=0.3, stretch=0.1, blur_px=1.0).at(gaussian(size, 1.5, 1.5), 0.5, -1.0)[0, 0]
    psf = psf / psf.sum()
    assert (psf.sum(1) * y).sum().item() == pytest.approx(size[0] // 2, abs=0.02)
    assert (psf.sum(0) * x).sum().item() == pytest.approx(size[1] // 2, abs=0.02)


def test_blur_keeps_light_within_and_loses_it_at_the_border():
    point = torch.zeros(1, 1, 31, 31)
    point[..., 15, 15] = 1
    torch.testing.assert_close(gaussian_blur(point, 2.0), gaussian((31, 31), 2.0, 2.0), rtol=1e-3, atol=1e-6)
    border = torch.zeros(1, 1, 31, 31)
    border[..., 0, 15] = 1
    # Half of the light remains, and half of the middle row, whose share is 1 / (2 sqrt(2 pi)).
    expected = 0.5 + 0.5 / (2 * math.sqrt(2 * math.pi))
    assert gaussian_blur(border, 2.0).sum().item() == pytest.approx(expected, abs=1e-3)


def test_twice_the_aberration():
    assert Aberration(0.1, 0.2, 1.0, 0.3) * 2.0 == Aberration(0.2, 0.4, 2.0, 0.6)


def test_simulate_is_the_light_through_the_sensor(generator):
    psf = contour_psf((16, 16), cell=8, generator=generator)
    camera = FieldCamera.from_psfs(field_psfs(psf, (3, 3), Aberration(blur_px=1.0)), (16, 16))
    quiet = FieldCamera(camera.kernels, camera.weights, sensor=Sensor(1e12, 0.0, 16))
    scene = torch.rand(1, 1, 16, 16, generator=generator)
    torch.testing.assert_close(quiet.simulate(scene, generator=generator), camera.forward(scene), rtol=0, atol=3e-5)


@pytest.mark.parametrize(
    ("wrong", "name"),
    [
        ({"blur_px": -1.0}, "blur_px"),
        ({"vignetting": 1.5}, "vignetting"),
        ({"scale": -1.0}, "scale"),
        ({"stretch": -2.0}, "stretch"),
    ],
)
def test_impossible_aberrations_are_refused(wrong, name):
    with pytest.raises(ParameterError, match=name):
        Aberration(**wrong)


@pytest.mark.usefixtures("unchecked")
@pytest.mark.usefixtures("unchecked")
def test_psfs_without_an_axis_of_colours_are_refused(generator):
    psfs = torch.rand(3, 3, 5, 5, generator=generator)
    with pytest.raises(ShapeError, match=r"`psfs` \(3, 3, 5, 5\) must be \(rows, columns, C, h, w\)"):
        FieldCamera.from_psfs(psfs, (9, 9))


def test_a_call_is_forward(generator):
    camera = FieldCamera.from_psfs(torch.rand(2, 2, 1, 5, 5, generator=generator), (9, 9))
    scene = torch.rand(1, 1, 9, 9, generator=generator)
    assert torch.equal(camera(scene), camera.forward(scene))


def test_wrong_calls():
    psfs = torch.ones(2, 2, 1, 3, 3)
    with pytest.raises(ParameterError, match="rank"):
        FieldCamera.from_psfs(psfs, (5, 5), rank=0)
    with pytest.raises(ParameterError, match="grid"):
        field_psfs(psfs[0], (0, 2), Aberration())
    with pytest.raises(ShapeError, match="from_psfs"):
        FieldCamera.from_psfs(psfs, (5, 5)).forward(torch.ones(1, 1, 6, 5))


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize("scene", [torch.ones(1, 1, 5, 5, dtype=torch.uint8), np.ones((1, 1, 5, 5))])
def test_scenes_of_another_type_are_refused_as_by_a_camera(scene):
    """8 bits became light of up to 255."""
    psf = torch.ones(1, 1, 3, 3)
    for camera in (Camera(psf, size=(5, 5)), FieldCamera.from_psfs(psf[None], (5, 5))):
        with pytest.raises(ParameterError, match="`scene`"):
            camera.forward(scene)


def test_psfs_without_light_give_darkness():
    assert not FieldCamera.from_psfs(torch.zeros(2, 2, 1, 3, 3), (5, 5)).forward(torch.ones(1, 1, 5, 5)).any()


def test_two_depths_divide_the_scene_between_two_cameras(generator):
    """Equal cameras are one; a point is seen through the camera of its own depth."""
    size = 20, 24
    one, other = (FieldCamera.from_psfs(contour_psf(size, cell=c, generator=generator)[None], size) for c in (6, 9))
    is_near = (torch.rand(1, 1, *size, generator=generator) < 0.5).float()
    scene = torch.rand(2, 3, *size, generator=generator)
    torch.testing.assert_close(two_depths(one, one, is_near).forward(scene), one.forward(scene), rtol=1e-4, atol=1e-6)
    both = two_depths(one, other, is_near).forward(scene)
    expected = one.forward(scene * is_near) + other.forward(scene * (1 - is_near))
    torch.testing.assert_close(both, expected, rtol=1e-4, atol=1e-6)

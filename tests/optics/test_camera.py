"""The forward model against explicit sums, and its adjoint."""

import pytest
import torch

import oracles
from mwdn.errors import ShapeError
from mwdn.optics import Camera, Sensor, unit_sum

SIZES = [
    ((9, 12), (9, 12), None),
    ((20, 31), (7, 8), None),
    ((5, 6), (12, 15), None),
    ((20, 31), (12, 15), (12, 15)),
    ((16, 16), (5, 4), (9, 20)),
    ((1, 1), (4, 4), (3, 3)),
]


@pytest.mark.parametrize(("scene", "psf", "sensor"), SIZES)
def test_forward_is_the_crop_of_the_convolution(scene, psf, sensor, generator):
    v, h = torch.randn(2, 3, *scene, generator=generator), unit_sum(torch.rand(1, 3, *psf, generator=generator))
    camera = Camera(h, size=sensor)
    b = camera.forward(v)
    assert camera.sensor_size == (sensor or psf)
    assert b.shape == (2, 3, *camera.sensor_size)
    for i in range(2):
        for c in range(3):
            expected = torch.from_numpy(oracles.convolve(v[i, c].double(), h[0, c].double(), camera.sensor_size))
            torch.testing.assert_close(b[i, c].double(), expected, rtol=0, atol=3e-6 * expected.abs().max().item())


@pytest.mark.parametrize(("scene", "psf", "sensor"), SIZES)
def test_adjoint(scene, psf, sensor, generator):
    v, h = torch.randn(2, 3, *scene, generator=generator), torch.rand(1, 1, *psf, generator=generator)
    camera = Camera(h, size=sensor)
    y = torch.randn(2, 3, *camera.sensor_size, generator=generator)
    Av, Ay = camera.forward(v), camera.adjoint(y, scene_size=scene)
    difference = (Av.double() * y).sum() - (v.double() * Ay).sum()
    assert difference.abs() <= 1e-5 * Av.norm() * y.norm()


def test_adjoint_of_another_sensors_measurement_is_refused():
    """It would be the adjoint of another camera's `forward`."""
    camera = Camera(torch.ones(1, 1, 5, 5), size=(8, 9))
    with pytest.raises(ShapeError, match=r"`measurement` \(1, 2, 5, 5\) must have the camera's sensor size \(8, 9\)"):
        camera.adjoint(torch.ones(1, 2, 5, 5))


def test_a_psf_that_is_learned_has_a_hash():
    """The camera could not be printed, as a notebook does."""
    psf = torch.ones(1, 1, 4, 4)
    assert repr(Camera(psf.clone().requires_grad_())) == repr(Camera(psf))


def test_adjoint_returns_a_scene_of_the_sensors_size_unless_asked():
    camera = Camera(torch.ones(1, 1, 5, 5), size=(8, 9))
    assert camera.adjoint(torch.ones(1, 2, 8, 9)).shape == (1, 2, 8, 9)


def test_psf_of_any_scale_keeps_the_energy_of_a_small_scene(generator):
    camera = Camera(7 * torch.rand(1, 3, 11, 12, generator=generator), size=(20, 24))
    v = torch.rand(2, 3, 6, 7, generator=generator)
    torch.testing.assert_close(camera.forward(v).sum((-2, -1)), v.sum((-2, -1)), rtol=1e-5, atol=0)


def test_point_seen_through_the_camera_is_its_psf(generator):
    h = unit_sum(torch.rand(1, 3, 13, 10, generator=generator))
    point = torch.zeros(1, 3, 7, 7)
    point[..., 3, 3] = 1
    torch.testing.assert_close(Camera(h).forward(point), h, rtol=0, atol=2e-6)


def test_simulate_repeats_from_the_same_generator_only(generator):
    camera, v = Camera(torch.rand(1, 1, 8, 8, generator=generator)), torch.rand(1, 3, 8, 8, generator=generator)
    first, again, other = (camera.simulate(v, generator=torch.Generator().manual_seed(seed)) for seed in (1, 1, 2))
    assert torch.equal(first, again)
    assert not torch.equal(first, other)


def test_simulate_leaves_the_global_generator_alone(generator):
    camera, v = Camera(torch.ones(1, 1, 1, 1), size=(8, 8)), torch.rand(1, 1, 8, 8)
    before = torch.get_rng_state()
    camera.simulate(v, generator=generator)
    assert torch.equal(torch.get_rng_state(), before)


def test_simulate_is_the_light_through_the_sensor(generator):
    """Nearly noise-free: a full well of 1e12 electrons has a shot noise of 1e-6, 16 bits a step of 1.5e-5."""
    h = torch.rand(1, 3, 9, 7, generator=generator)
    sensor = Sensor(full_well=1e12, read_noise=0.0, bit_depth=16)
    camera = Camera(h / h.sum((-2, -1), keepdim=True), sensor=sensor)
    v = torch.rand(2, 3, 12, 12, generator=generator)
    captured = camera.simulate(v, generator=generator)
    assert captured.shape == (2, 3, 9, 7)
    torch.testing.assert_close(captured, camera.forward(v), rtol=0, atol=2e-5)


@pytest.mark.usefixtures("unchecked")
def test_scene_that_does_not_fit_the_psf_is_refused():
    with pytest.raises(ShapeError, match="channels"):
        Camera(torch.ones(1, 2, 4, 4)).forward(torch.ones(1, 3, 8, 8))
    for size in ((0, 9), (9, -1)):
        with pytest.raises(ShapeError, match=rf"`size` \({size[0]}, {size[1]}\)"):
            Camera(torch.ones(1, 1, 4, 4), size=size)

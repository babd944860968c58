"""A camera as the physics of DeepInverse, by its own tests and reconstructors.

deepinv needs a torchvision for the installed torch: docs/bridges.md says how to make an environment for this file.
"""

import numpy as np
import pytest
import torch

pytest.importorskip("deepinv", reason="the extra `deepinverse` is not installed")
pytestmark = pytest.mark.filterwarnings("ignore:::(?!mwdn)")  # of deepinv and of what it imports

from deepinv.models import RAM  # noqa: E402
from deepinv.optim import DPIR, PGD  # noqa: E402
from deepinv.optim.data_fidelity import L2  # noqa: E402
from deepinv.optim.prior import TVPrior  # noqa: E402
from deepinv.physics import GaussianNoise  # noqa: E402

from mwdn import Calibration, Camera, Reconstructor, Sensor  # noqa: E402
from mwdn.bridges import DeepInverseSolver, LenslessPhysics, linear_operator  # noqa: E402
from mwdn.errors import ParameterError, ShapeError  # noqa: E402
from mwdn.optics import unit_sum  # noqa: E402

SENSOR, SCENE, PSF = (16, 20), (20, 22), (7, 8)


@pytest.fixture
def camera(generator):
    """Three different channels of a few strong points."""
    return Camera(unit_sum(torch.rand(1, 3, *PSF, generator=generator) ** 6), size=SENSOR)


def test_deepinverse_finds_the_adjoint_exact(camera):
    physics = LenslessPhysics(camera, scene_size=SCENE)
    assert physics.adjointness_test(num_samples=4) < 1e-5


def test_the_norm_is_at_most_one(camera):
    physics = LenslessPhysics(camera)
    assert 0.5 < physics.compute_sqnorm(torch.randn(1, 3, *SENSOR), verbose=False) <= 1.0 + 1e-5


def test_another_psf_is_scaled_to_unit_sum(camera):
    """Of any brightness; the norm of the operator was a million."""
    physics, scene = LenslessPhysics(camera), torch.rand(1, *LenslessPhysics(camera).psf.shape[1:])
    for change in (lambda psf: physics.update(psf=psf), lambda psf: physics(scene, psf=psf)):
        change(1000 * camera.psf.flip(-1))
        torch.testing.assert_close(physics.psf, camera.psf.flip(-1))
        change(camera.psf)


def test_the_pseudo_inverse_is_that_of_the_matrix(camera, generator):
    small = Camera(camera.psf[:, :1], size=(8, 9))
    physics = LenslessPhysics(small, scene_size=(10, 11), max_iter=200, tol=1e-6)
    matrix = linear_operator(small, scene_size=(10, 11))
    y = torch.rand(1, 1, 8, 9, generator=generator)
    expected = np.linalg.lstsq(matrix @ np.eye(110), y.numpy().ravel(), rcond=None)[0]
    np.testing.assert_allclose(physics.A_dagger(y).numpy().ravel(), expected, atol=0.02 * abs(expected).max())


def test_its_noise_is_that_of_the_sensor(camera):
    physics = LenslessPhysics(camera, generator=torch.Generator())
    scene = torch.full((1, 3, *SENSOR), 0.5)
    expected = camera.simulate(scene, generator=torch.Generator().manual_seed(3))
    torch.testing.assert_close(physics(scene, seed=3), expected, rtol=0, atol=0)
    dark = Camera(camera.psf, size=(200, 200), sensor=Sensor(full_well=1000, read_noise=5))
    noise = LenslessPhysics(dark)(torch.zeros(1, 3, 200, 200))
    assert noise.std() == pytest.approx(float(LenslessPhysics(dark).noise_model.sigma), rel=0.02)


def test_the_psf_can_be_replaced(camera, generator):
    physics = LenslessPhysics(camera)
    scene = torch.rand(1, 3, *SENSOR, generator=generator)
    other = Camera(camera.psf.flip(-1), size=SENSOR)
    torch.testing.assert_close(physics.A(scene, psf=other.psf), other(scene))
    physics.update(psf=camera.psf)
    torch.testing.assert_close(physics.A(scene), camera(scene))
    assert "psf" in dict(physics.named_buffers())


def test_its_reconstructors_are_methods_of_this_package(camera, generator):
    """It sees a peak of 1; the result is on the measurement's scale."""
    solver = DeepInverseSolver(lambda y, physics: physics.A_adjoint(y) * y.amax((1, 2, 3), keepdim=True))
    calibration = Calibration(unit_sum(torch.rand(1, 1, *SENSOR, generator=generator) ** 9))
    measurement = 0.01 * torch.rand(2, 3, *SENSOR, generator=generator)
    expected = LenslessPhysics(Camera(calibration.psf), channels=3).A_adjoint(measurement)
    scene = Reconstructor(solver, calibration, device="cpu")(measurement)
    torch.testing.assert_close(scene, expected, rtol=1e-4, atol=1e-6)
    assert Reconstructor(solver, calibration, device="cpu")(torch.zeros(1, 3, *SENSOR)).count_nonzero() == 0


RECONSTRUCTORS = {
    "TV": lambda: PGD(L2(), TVPrior(n_it_max=10), stepsize=1.0, lambda_reg=1e-3, max_iter=20),
    "DPIR": lambda: DPIR(sigma=0.02, denoiser=lambda x, sigma: torch.nn.functional.avg_pool2d(x, 3, 1, 1)),
    "RAM": lambda: RAM(pretrained=False).eval(),
}
"""Of three kinds: total variation, plug and play with a box filter, a network (without its weights)."""


@pytest.mark.parametrize("name", RECONSTRUCTORS)
def test_its_reconstructors_take_the_camera(name, camera):
    scene = torch.zeros(1, 3, *SENSOR)
    scene[..., 4:12, 6:14] = 0.8
    physics = LenslessPhysics(camera, noise_model=GaussianNoise(0.005))
    measurement = physics(scene)
    with torch.no_grad():
        result = RECONSTRUCTORS[name]()(measurement, physics)
    assert result.shape == scene.shape
    assert result.isfinite().all()
    if name == "TV":
        assert (result - scene).square().mean() < 0.5 * (measurement - scene).square().mean()


def test_a_reconstructor_is_told_the_noise_at_its_scale(camera, generator):
    """A network that takes the noise of a full capture for that of a dim one leaves the noise in the picture."""
    told = []
    solver = DeepInverseSolver(lambda y, physics: (told.append(physics.noise_model), y)[1])
    measurement = torch.rand(2, 3, *SENSOR, generator=generator) * torch.tensor([0.01, 0.5])[:, None, None, None]
    solver(measurement, camera.psf)
    of_sensor, scale = LenslessPhysics(camera).noise_model, 1 / measurement.amax((1, 2, 3))
    torch.testing.assert_close(told[0].gain, of_sensor.gain * scale)
    torch.testing.assert_close(told[0].sigma, of_sensor.sigma * scale)


@pytest.mark.usefixtures("unchecked")
def test_measurements_of_another_size_are_refused(camera):
    """Their scene was displaced and cropped."""
    physics = LenslessPhysics(camera, scene_size=SCENE)
    for solve in (physics.A_adjoint, physics.A_dagger):
        with pytest.raises(ShapeError, match="measurement"):
            solve(torch.rand(1, 3, *SCENE))


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize("noise", [{"gain": 0.0}, {"sigma": -0.1}, {"gain": torch.tensor([1e-3, 1e-4])}])
def test_noise_out_of_range_is_refused(noise, camera):
    with pytest.raises(ParameterError, match="`gain`"):
        LenslessPhysics(camera)(torch.rand(1, 3, *SENSOR), **noise)


@pytest.mark.usefixtures("unchecked")
def test_other_cameras_are_refused(camera):
    with pytest.raises(ShapeError, match="2 PSFs"):
        LenslessPhysics(Camera(camera.psf.expand(2, -1, -1, -1)))
    with pytest.raises(ParameterError, match="`camera`"):
        LenslessPhysics(camera.psf)
    with pytest.raises(ParameterError, match="`channels`"):
        LenslessPhysics(camera, channels="3")
    with pytest.raises(ParameterError, match="`generator`"):
        LenslessPhysics(camera, generator=3)


def test_noise_follows_gain_and_sigma(generator):
    physics = LenslessPhysics(Camera(torch.ones(1, 1, 1, 1), size=(64, 64)), generator=generator)
    x = torch.full((1, 1, 64, 64), 0.5)
    for gain, sigma in ((None, None), (1e-3, 0.02), (1e-5, 0.01)):
        y = physics(x, gain=gain, sigma=sigma) if gain else physics(x)
        stated = physics.noise_model
        expected = (float(stated.gain) * 0.5 + float(stated.sigma) ** 2) ** 0.5
        assert float((y - x).std()) == pytest.approx(expected, rel=0.05)

"""The mean of four mirrored passes."""

import pytest
import torch

from cameras import contour_psf
from made import trained
from mwdn import Calibration, Camera, Reconstructor
from mwdn.errors import ParameterError
from mwdn.inference.ensemble import MIRRORS
from mwdn.inference.origin import settings_hash
from mwdn.networks import build
from mwdn.optics.orientation import turn

ODD, EVEN = (33, 41), (32, 40)


@pytest.fixture
def camera(generator):
    """A network with random weights, a PSF, a scene and its measurement, of the given size."""

    def make(size):
        psf = contour_psf(size, cell=10, generator=generator).expand(1, 3, -1, -1).contiguous()
        scene = torch.rand(1, 3, *size, generator=generator)
        return trained(build("wiener-bank", width=4, finest=8), generator), psf, scene, Camera(psf)(scene)

    return make


@pytest.mark.parametrize("name", MIRRORS)
def test_a_mirrored_camera_sees_the_mirrored_picture(camera, name):
    """A random network tells left from right; the mean of its passes does not. With odd sides no line is lost."""
    network, psf, _, measurement = camera(ODD)
    axes = MIRRORS[name]

    def changed(**options):
        options = {"precision": "exact", "align": False, "room_light": False, "device": "cpu", **options}
        picture = Reconstructor(network, Calibration(psf), **options)(measurement)
        mirrored = Reconstructor(network, Calibration(turn(psf, name)), **options)(measurement.flip(axes))
        return float((mirrored.flip(axes) - picture).norm() / picture.norm())

    assert changed(ensemble=True) < 1e-4 < 1e-2 < changed()


def test_the_mean_is_at_least_as_near_as_the_four_on_average(camera):
    """Of even sides the PSF's centre is not the array's: a mirrored pass that ignores it is one pixel off."""
    network, psf, scene, measurement = camera(EVEN)
    options = {"align": False, "room_light": False, "device": "cpu", "precision": "exact"}
    reconstruct = Reconstructor(network, Calibration(psf), ensemble=True, **options)
    ensemble = reconstruct.engine
    passes = [ensemble.engine(measurement)]
    passes += [engine(measurement.flip(axes)).flip(axes) for axes, engine in ensemble.mirrored.items()]
    errors = [float((each - scene).square().mean()) for each in passes]
    spread = [float((each - sum(passes) / 4).square().mean()) for each in passes]
    error = float((reconstruct(measurement) - scene).square().mean())
    assert error == pytest.approx(sum(errors) / 4 - sum(spread) / 4, rel=1e-4)


@pytest.mark.parametrize("size", [ODD, EVEN])
def test_a_mirrored_pass_is_not_shifted(camera, size):
    """The Wiener picture of the mirrored camera, mirrored back, is the picture: a check without a network's bias."""
    _, psf, _, measurement = camera(size)
    picture = Reconstructor("wiener", Calibration(psf), regularisation=1e-2)(measurement)
    for name, axes in MIRRORS.items():
        again = Reconstructor("wiener", Calibration(turn(psf, name)), regularisation=1e-2)(measurement.flip(axes))
        assert (again.flip(axes) - picture).norm() < 0.02 * picture.norm()


def test_ensemble_is_for_networks(camera):
    network, psf, _, _ = camera(EVEN)
    with pytest.raises(ParameterError, match="`ensemble` is for networks: admm"):
        Reconstructor("admm", Calibration(psf), ensemble=True)
    plain, averaged = (Reconstructor(network, Calibration(psf), ensemble=each, device="cpu") for each in (False, True))
    assert settings_hash(plain, "png") != settings_hash(averaged, "png")

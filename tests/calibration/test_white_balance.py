"""White balance: a grey scene becomes grey."""

from dataclasses import replace

import pytest
import torch

from mwdn import Calibration, Camera, Reconstructor
from mwdn.calibration.white_balance import apply_white_balance
from mwdn.errors import ParameterError

LAMP = torch.tensor([0.9, 0.6, 0.3])[:, None, None]
"""Colour of the lamp that lights the point source and the scene."""


@pytest.fixture
def camera(generator):
    """The raw frame of a grey scene in orange light, and the calibration of its camera with the same light."""
    psf = torch.zeros(1, 3, 24, 24)
    psf[..., 8:16, 8:16] = (torch.rand(1, 1, 8, 8, generator=generator) > 0.8).float() + 0.01
    scene = torch.zeros(1, 3, 24, 24)
    scene[..., 6:18, 6:18] = torch.rand(1, 1, 12, 12, generator=generator)
    capture = Camera(psf / psf.sum((-2, -1), keepdim=True)).forward(scene) * LAMP
    source = (0.9 * LAMP * psf / psf.max())[0].movedim(0, -1).numpy()
    return Calibration.from_array(source, background=0.0), capture[0].movedim(0, -1).numpy()


@pytest.mark.parametrize("balance", ["grey-world", "psf", (1 / 0.9, 1 / 0.6, 1 / 0.3)])
def test_grey_scene_in_coloured_light_becomes_grey(camera, balance):
    calibration, capture = camera
    plain = Reconstructor("wiener", calibration, device="cpu", regularisation=1e-4)(capture)
    picture = Reconstructor("wiener", calibration, device="cpu", white_balance=balance, regularisation=1e-4)(capture)
    colours, before = picture[6:18, 6:18].mean((0, 1)), plain[6:18, 6:18].mean((0, 1))
    assert colours == pytest.approx([colours[1]] * 3, rel=0.02)
    assert colours[1] == pytest.approx(before[1], rel=1e-5)  # green stays as bright as it was
    assert before[0] / before[2] == pytest.approx(3, rel=0.02)


def test_white_balance_of_a_calibration_is_the_default(camera):
    calibration, capture = camera
    balanced = replace(calibration, white_balance="psf")
    by_camera = Reconstructor("wiener", balanced, device="cpu")
    assert (
        by_camera(capture) == Reconstructor("wiener", calibration, device="cpu", white_balance="psf")(capture)
    ).all()
    measurement = calibration.correct(capture)
    plain = Reconstructor("wiener", calibration, device="cpu")(measurement)
    assert torch.equal(by_camera.on_device(measurement), plain)  # what is compared with the measurement
    assert torch.equal(Reconstructor("wiener", balanced, white_balance=(2.0, 2.0, 2.0))(measurement), plain)


def test_grey_pictures_and_black_colours_stay():
    grey, red = torch.rand(2, 1, 4, 4), torch.zeros(1, 3, 4, 4)
    red[:, 0] = 1
    assert apply_white_balance(grey, "grey-world", ()) is grey
    assert torch.equal(apply_white_balance(red, "grey-world", ()), red)


def test_each_picture_of_a_batch_has_its_own_grey_world(generator):
    scenes = torch.rand(2, 3, 4, 4, generator=generator)
    scenes[1, 0] *= 3
    means = apply_white_balance(scenes, "grey-world", ()).mean((-2, -1))
    torch.testing.assert_close(means, scenes[:, 1:2].mean((-2, -1)).expand(2, 3))


@pytest.mark.parametrize(
    "balance", ["gray-world", "red", 5, ("a", "b", "c"), (1.0, 0.0, 1.0), (1.0, float("nan"), 1.0)]
)
@pytest.mark.usefixtures("unchecked")
def test_wrong_gains(balance):
    with pytest.raises(ParameterError, match="`white_balance`"):
        Calibration(torch.ones(1, 3, 4, 4) / 16, white_balance=balance)


def test_colour_of_an_unknown_source():
    for psf in (torch.ones(1, 3, 4, 4) / 16, torch.ones(1, 1, 4, 4) / 16):
        with pytest.raises(ParameterError, match=r"needs a PSF in colour.*`white_balance=\(1\.8, 1, 1\.5\)`"):
            Reconstructor("wiener", Calibration(psf), white_balance="psf", device="cpu")

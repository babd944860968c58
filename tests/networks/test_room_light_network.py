"""The network that finds smooth light: what it sees adds up to the capture, and what it returns is smooth."""

import torch

from cameras import contour_psf
from mwdn import fourier
from mwdn.networks.room_light import GAINS, MAX_FREQUENCY, RoomLightUNet, clues
from mwdn.solvers.light_spot import cosines

SIZE = 38, 50


def test_the_parts_of_the_scene_and_the_residual_are_the_capture(generator):
    psf = contour_psf(SIZE, cell=10, generator=generator).expand(2, 3, -1, -1)
    b = fourier.convolve(torch.rand(2, 3, *SIZE, generator=generator), psf)
    b = b / b.mean((-2, -1), keepdim=True)
    capture, scene, grey, bright, dark, outside, residual, _ = (
        clues(b, psf) / torch.tensor(GAINS)[:, None, None]
    ).unbind(2)
    torch.testing.assert_close(capture, b)
    torch.testing.assert_close(bright + dark + outside + residual, b)
    torch.testing.assert_close(grey, scene.mean(1, keepdim=True).expand_as(scene))
    assert (scene >= 0).all()


def test_light_is_smooth_in_a_frame_of_any_size(generator):
    network = RoomLightUNet(width=8).eval()
    for size in (SIZE, (34, 60), (2, 3)):
        with torch.no_grad():
            light = network(torch.rand(2, 3, len(GAINS), *size, generator=generator))
        basis = cosines(size, light.device, MAX_FREQUENCY)
        smooth = (basis.coefficients(light) @ basis.light.flatten(1)).view(light.shape)
        torch.testing.assert_close(light, smooth, rtol=0, atol=1e-5)


def test_a_capture_of_one_colour(generator):
    """Equal colours have equal light, and one of them has the same."""
    network, maps = RoomLightUNet(width=8).eval(), torch.rand(1, 1, len(GAINS), *SIZE, generator=generator)
    with torch.no_grad():
        torch.testing.assert_close(network(maps.expand(-1, 3, -1, -1, -1)), network(maps).expand(-1, 3, -1, -1))

import numpy as np
import pytest
import torch
from displayed import board, dots, mean_error, natural_pictures, placed, seen_from

from cameras import contour_psf
from mwdn import Camera, Sensor
from mwdn.errors import AlignmentError
from mwdn.registration import Projection, Views, estimate
from mwdn.solvers import Admm

CAMERA = (128, 128)


def scenes(pictures, truth, **options):
    return [seen_from(picture, truth.homography, truth.camera_size, **options) for picture in pictures]


def tensors(pictures):
    return [torch.from_numpy(picture).movedim(-1, 0) for picture in pictures]


def reconstructed(pictures, truth, generator, *, full_well, iterations):
    """ADMM's pictures of noisy captures: blurred, with artefacts."""
    psf = contour_psf(CAMERA, cell=14, generator=torch.Generator().manual_seed(3)).expand(-1, 3, -1, -1)
    camera = Camera(psf, sensor=Sensor(full_well=full_well))
    seen = torch.cat(scenes(pictures, truth))
    light = camera.forward(seen).amax((1, 2, 3), keepdim=True)
    captures = camera.simulate(0.8 * seen / light, generator=generator)
    return list(Admm(iterations=iterations)(captures, psf))


@pytest.mark.parametrize(
    ("picture", "turn"), [pytest.param(board(), 172, marks=pytest.mark.acceptance), pytest.param(dots(), 7)]
)
def test_boards_and_dots_within_three_tenths_of_a_pixel(picture, turn, generator):
    truth = placed(picture.shape[:2], CAMERA, turn=turn, fill=0.6, mirrored=True)
    views = Views.of(tensors([picture]), reconstructed([picture], truth, generator, full_well=1500, iterations=60))
    found = estimate(views)
    assert mean_error(found.projection, truth) < 0.3
    assert found.residuals.rms_px < 0.6


def test_natural_pictures_within_seven_tenths_of_a_pixel(generator):
    pictures = natural_pictures(2, 192)
    truth = placed((192, 192), CAMERA, turn=95, mirrored=True)
    views = Views.of(tensors(pictures), reconstructed(pictures, truth, generator, full_well=1500, iterations=30))
    found = estimate(views)
    assert mean_error(found.projection, truth) < 0.7
    assert found.content()["correlation"] > 0.9


def noisy(pictures, truth, *, noise=0.05, **options):
    generator = np.random.default_rng(0)
    seen = torch.cat(scenes(pictures, truth, **options))
    return list(seen + noise * torch.from_numpy(generator.standard_normal(seen.shape)).float())


@pytest.mark.acceptance
def test_a_radial_term_is_found_where_there_is_one_and_shading_is_none():
    """The sensor loses up to 60 % of the light towards one corner. ECC alone is off by 0.17 px in both cases."""
    pictures = natural_pictures(2, 160)
    y, x = np.mgrid[-1 : 1 : 1j * CAMERA[0], -1 : 1 : 1j * CAMERA[1]]
    shading = torch.from_numpy(1 - 0.15 * ((y - 0.6) ** 2 + (x + 0.6) ** 2)).float()
    errors = {}
    for radial in (0.0, 0.06):
        truth = placed((160, 160), CAMERA, fill=0.7, radial=radial)
        seen = [scene * shading for scene in noisy(pictures, truth, noise=0.03, radial=radial)]
        found = estimate(Views.of(tensors(pictures), seen))
        errors[radial] = mean_error(found.projection, truth)
        assert (found.projection.radial != 0) == (radial != 0)
    assert max(errors.values()) < 0.1


def test_corners_picked_by_hand_are_refined():
    pictures = natural_pictures(2, 160)
    truth = placed((160, 160), CAMERA, turn=30)
    rough = truth.corners() + np.array([[2, -2], [-2, 1], [1, 2], [-2, -1.5]])
    found = estimate(Views.of(tensors(pictures), noisy(pictures, truth)), corners=rough)
    assert found.start == "points"
    assert mean_error(found.projection, truth) < 0.2


def test_another_picture_is_refused():
    astronaut, coffee = natural_pictures(2, 80)
    truth = placed((80, 80), (64, 64))
    with pytest.raises(AlignmentError):
        estimate(Views.of(tensors([coffee]), noisy([astronaut], truth)))


def test_a_symmetric_picture_is_refused():
    disc = np.hypot(*np.mgrid[-40:40, -40:40]) < 30
    picture = np.repeat(disc.astype(np.float32)[..., None], 3, -1)
    truth = placed((80, 80), (64, 64))
    with pytest.raises(AlignmentError, match="in several ways"):
        estimate(Views.of(tensors([picture]), noisy([picture], truth)))


def test_a_picture_mostly_outside_of_the_frame_is_refused():
    astronaut = natural_pictures(1, 160)[0]
    inside = placed((160, 160), CAMERA, fill=1.0, turn=0)
    away = np.array([[1, 0, -70.0], [0, 1, -20.0], [0, 0, 1]]) @ inside.homography
    truth = Projection.from_homography(away, (160, 160), CAMERA)
    with pytest.raises(AlignmentError, match="lies outside"):
        estimate(Views.of(tensors([astronaut]), noisy([astronaut], truth)), corners=truth.corners())

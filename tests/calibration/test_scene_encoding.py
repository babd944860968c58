"""Scenes that a lens camera has encoded are told from scenes that are linear in light."""

import pytest
import torch

from cameras import contour_psf
from mwdn import convolve
from mwdn.calibration.scene_encoding import GAMMAS, MAX_PAIRS, scene_gamma, unexplained_by_gamma
from mwdn.optics.polynomials import polynomials

SIZE = 64, 80


@pytest.fixture
def psf(generator):
    return contour_psf(SIZE, cell=14, generator=generator).expand(1, 3, -1, -1).contiguous()


def recorded(psf, encode, generator, *, field=1.0, count=4):
    """Measurements of random scenes, and the scenes as a lens camera stores them."""
    for _ in range(count):
        scene = torch.nn.functional.interpolate(torch.rand(1, 3, 5, 6, generator=generator), SIZE, mode="bilinear")
        light = convolve(scene, psf) * field
        yield light + 0.002 * torch.randn(light.shape, generator=generator), encode(scene)


@pytest.mark.parametrize("gamma", [1.4, 1.8, 2.2])
def test_the_gamma_of_encoded_scenes_is_found(gamma, psf, generator):
    made = list(recorded(psf, lambda scene: scene ** (1 / gamma), generator))
    unexplained = unexplained_by_gamma(psf, lambda: made)
    assert list(unexplained) == list(GAMMAS)
    assert scene_gamma(unexplained) == gamma


def test_linear_scenes_in_units_of_their_own_stay_linear(psf, generator):
    made = list(recorded(psf, lambda scene: 0.5 * scene, generator))
    assert scene_gamma(unexplained_by_gamma(psf, lambda: made)) is None


def test_an_uneven_sensor_is_no_gamma(psf, generator):
    field = 1 - 0.3 * polynomials(2, SIZE)[3] - 0.2 * polynomials(2, SIZE)[2]
    made = list(recorded(psf, lambda scene: scene, generator, field=field.float()))
    assert scene_gamma(unexplained_by_gamma(psf, lambda: made)) is None


def test_clipping_is_no_gamma(psf, generator):
    """It bends the scenes as a gamma does: pairs with much of it are left out."""
    made = list(recorded(psf, lambda scene: scene.clamp(max=0.5), generator))
    unexplained = unexplained_by_gamma(psf, lambda: made)
    assert unexplained[1.0] == ()
    assert scene_gamma(unexplained) is None
    mixed = made[:1] + list(recorded(psf, lambda scene: scene ** (1 / 1.8), generator))
    unexplained = unexplained_by_gamma(psf, lambda: mixed)
    assert len(unexplained[1.0]) == len(mixed) - 1
    assert scene_gamma(unexplained) == 1.8


def test_a_single_pair_does_not_decide():
    unexplained = dict.fromkeys(GAMMAS, (0.2, 0.2, 0.2)) | {1.4: (0.01, 0.201, 0.201)}
    assert scene_gamma(unexplained) is None


def test_at_most_ten_pairs_are_examined(psf, generator):
    made = list(recorded(psf, lambda scene: scene, generator, count=MAX_PAIRS + 2))
    assert {len(part) for part in unexplained_by_gamma(psf, lambda: made).values()} == {MAX_PAIRS}

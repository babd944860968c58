"""Room light: its mean is 1, so that a share of light is the share that was asked for."""

import math

import pytest
import torch

from mwdn.optics.room_light import even_light, sloping_light, spot_light


@pytest.mark.parametrize(
    "light", [even_light((31, 42)), sloping_light((31, 42), 2.0), spot_light((31, 42), (0.1, 0.9), 0.15)]
)
def test_means_are_1(light):
    assert light.shape == (31, 42)
    assert light.min() >= 0
    assert light.mean() == pytest.approx(1, abs=1e-5)


def test_slope_rises_to_2_in_its_direction():
    right, diagonal = sloping_light((40, 40), 0.0), sloping_light((40, 40), math.pi / 4)
    assert right[:, 0] == pytest.approx(torch.full((40,), 1 / 40))
    assert right[:, -1] == pytest.approx(torch.full((40,), 2 - 1 / 40))
    assert float(diagonal[0, 0]) == pytest.approx(1 / 40)
    assert float(diagonal[-1, -1]) == pytest.approx(2 - 1 / 40)  # bottom right


def test_spot_has_its_place_and_width():
    """One standard deviation is 0.2 of the width, 16 pixels: exp(-1/2) of the maximum, down and to the right alike."""
    spot = spot_light((60, 80), (20.5 / 60, 30.5 / 80), 0.2)
    assert divmod(int(spot.argmax()), 80) == (20, 30)
    for row, column in ((36, 30), (20, 46)):
        assert float(spot[row, column] / spot.max()) == pytest.approx(math.exp(-0.5), rel=1e-4)

"""Turns of a PSF, one after the other."""

from itertools import product
from typing import get_args

import torch

from mwdn.optics.orientation import Orientation, compose, turn, turn_displacement

TURNS = (None, *get_args(Orientation))


def turned(psf, name):
    return psf if name is None else turn(psf, name)


def test_composed_turn_is_one_turn_after_the_other():
    psf = torch.rand(1, 1, 6, 6, generator=torch.Generator().manual_seed(0))
    for first, second in product(TURNS, TURNS):
        assert torch.equal(turned(psf, compose(first, second)), turned(turned(psf, first), second))


def test_a_displacement_turns_with_the_picture():
    point = torch.zeros(1, 1, 9, 9)
    point[..., 4 + 1, 4 + 3] = 1
    for name in get_args(Orientation):
        row, column = turn(point, name)[0, 0].nonzero()[0].tolist()
        assert turn_displacement(1.0, 3.0, name) == (row - 4, column - 4)

"""Turns of a PSF, one after the other."""

from itertools import product
from typing import get_args

import torch

from mwdn.optics.orientation import Orientation, compose, turn

TURNS = (None, *get_args(Orientation))


def turned(psf, name):
    return psf if name is None else turn(psf, name)


def test_composed_turn_is_one_turn_after_the_other():
    psf = torch.rand(1, 1, 6, 6, generator=torch.Generator().manual_seed(0))
    for first, second in product(TURNS, TURNS):
        assert torch.equal(turned(psf, compose(first, second)), turned(turned(psf, first), second))

"""A small camera and its captures, for the tests of reconstructions."""

import cv2
import numpy as np
import pytest
import torch

from cameras import contour_psf
from mwdn import Camera

SIZE = 32, 40


@pytest.fixture
def psf(generator):
    return contour_psf(SIZE, cell=10, generator=generator).expand(1, 3, -1, -1).contiguous()


@pytest.fixture
def captures(tmp_path, psf, generator):
    """Three of them, 16-bit PNG."""
    (tmp_path / "in").mkdir()
    for number in range(3):
        scene = torch.zeros(1, 3, *SIZE)
        scene[..., 10:20, 12 + 4 * number : 22 + 4 * number] = torch.tensor([0.9, 0.5, 0.2])[:, None, None]
        seen = Camera(psf).simulate(scene, generator=generator)[0].movedim(0, -1)
        frame = (seen.clamp(0, 1) * 65535).round().numpy().astype(np.uint16)
        cv2.imwrite(str(tmp_path / f"in/{number}.png"), frame[..., ::-1])
    return [tmp_path / f"in/{number}.png" for number in range(3)]

"""A faint checkerboard goes, the scene stays."""

import pytest
import torch

from mwdn.networks.checkerboard import FAINT, remove_checkerboard

PATTERNS = {"columns": (1, -1), "rows": (-1, 1), "both": (-1, -1)}


def smooth(height, width):
    """A slope in one colour, a wide wave in the second, darkness in the third; brightest pixel 1."""
    y, x = torch.linspace(0, 1, height)[:, None], torch.linspace(0, 1, width)
    return torch.stack([(y + x) / 2, 0.2 * (1 + torch.sin(6 * x)).expand(height, width), torch.zeros(height, width)])[
        None
    ]


def checkerboard(size, pattern):
    rows, columns = (torch.arange(n) % 2 for n in size)
    down, right = (sign**each for sign, each in zip(PATTERNS[pattern], (rows, columns), strict=True))
    return (down[:, None] * right).float()


@pytest.mark.parametrize("pattern", PATTERNS)
@pytest.mark.parametrize("size", [(96, 128), (97, 131)])
def test_a_faint_checkerboard_is_removed(pattern, size):
    scene = smooth(*size)
    grid = 0.3 * FAINT * checkerboard(size, pattern)
    left = remove_checkerboard(scene + grid) - scene
    assert left[..., 2:-2, 2:-2].abs().max() < 0.1 * grid.abs().max()
    assert (remove_checkerboard(scene) - scene).abs().max() < 0.02 * FAINT


def test_details_of_a_scene_stay(generator):
    """Stronger stripes of two pixels, edges, and noise, whose checkerboard of a block is a tenth of it."""
    stripes = 0.5 + 0.5 * checkerboard((64, 64), "columns").expand(1, 3, -1, -1)
    assert torch.equal(remove_checkerboard(stripes), stripes)
    scene = smooth(96, 96)
    scene[..., 30:60, 40:70] += 1
    noise = 0.3 * FAINT * torch.randn(scene.shape, generator=generator)
    changed = remove_checkerboard(scene + noise) - (scene + noise)
    assert changed.square().mean() < 0.15**2 * noise.square().mean()


def test_each_sample_and_scale_alike(generator):
    scene = smooth(40, 50) + 1e-3 * torch.rand(2, 3, 40, 50, generator=generator)
    together = remove_checkerboard(scene)
    for sample, result in zip(scene, together, strict=True):
        torch.testing.assert_close(remove_checkerboard(100 * sample[None])[0] / 100, result)

"""A U-Net that finds the smooth light of a room in a coarse capture; not from the paper.

A scene can imitate smooth light by a glow in its dark part and by light from outside the frame, so the residual does
not tell how much of it is the room's. The network has learned what scenes, PSFs and their errors look like. It sees the
capture, the best scene for it without any light of a room, and what each part of this scene contributes to the capture.
"""

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from mwdn.fourier.transforms import inverse_spectrum, spectrum
from mwdn.solvers.light_spot import cosines
from mwdn.solvers.pyramid import PsfPyramid
from mwdn.solvers.smooth_light import COARSEST, bright_mask, on_grid
from mwdn.types import Measurement, Psf, size_of

MAX_FREQUENCY = 3.0
"""Highest frequency of the light in half periods over the frame's width: planes, and spots with a standard deviation of
a quarter of the width or more."""

GAINS = 1.0, 1.0, 1.0, 1.0, 4.0, 4.0, 10.0, 0.25
"""Factors on the maps of `clues`, which make them similarly large."""


def clues(b: Measurement, psf: Psf) -> Tensor:
    """What the network sees of captures (B, C, h, w) of mean 1 through PSFs (B, C, h, w): (B, C, 8, h, w).

    1. the capture
    2. the best scene for it, in the frame
    3. the mean colour of this scene
    4. light of its bright part on the sensor (`mwdn.solvers.smooth_light.bright_mask`)
    5. light of its dark part
    6. light from outside the frame
    7. the residual: the capture less 4 to 6
    8. the logarithm of the noise
    """
    size = size_of(b)
    estimate = PsfPyramid.from_psf(psf, size, (COARSEST,)).solve(b)
    (band,) = estimate.psf.bands
    whole, frame = estimate.grid_scene, estimate.scene
    bright = bright_mask(frame)
    H = band.transfer * band.norm
    parts = on_grid(frame * bright, whole), on_grid(frame * ~bright, whole), whole - on_grid(frame, whole)
    seen = [inverse_spectrum(H * spectrum(part, band.grid), band.grid, size) for part in parts]
    grey = frame.mean(1, keepdim=True).expand_as(b)
    noise = estimate.noise.clamp(min=1e-4).log().expand_as(b)
    maps = torch.stack([b, frame, grey, *seen, b - sum(seen), noise], dim=2)
    return maps * maps.new_tensor(GAINS)[:, None, None]


class RoomLightUNet(nn.Module):
    """A U-Net of four scales, whose result is projected onto smooth light. 386,177 learnable parameters.

    It sees each colour by itself; only the features of the whole frame are averaged with their mean over all colours.

    Args:
        width: feature channels at the finest scale; twice as many at the others.
    """

    def __init__(self, width: int = 32) -> None:
        super().__init__()
        wide = 2 * width
        self.encoder = nn.ModuleList(_block(*each) for each in ((11, width), (width, wide), (wide, wide), (wide, wide)))
        self.whole = nn.Sequential(nn.Linear(2 * wide, wide), nn.SiLU(), nn.Linear(wide, wide))
        self.decoder = nn.ModuleList(_block(2 * wide, outputs) for outputs in (wide, width))
        self.head = nn.Conv2d(width, 1, 1)

    def forward(self, maps: Tensor) -> Tensor:
        """Light (B, C, h, w) in units of the capture's mean, of any sign, from `clues` (B, C, 8, h, w)."""
        B, C, _, height, width = maps.shape
        y, x = (torch.linspace(-1, 1, side, device=maps.device, dtype=maps.dtype) for side in (height, width))
        y, x = torch.meshgrid(y, x, indexing="ij")
        places = torch.stack([y, x, y.square() + x.square()]).expand(B * C, -1, -1, -1)
        scales = [torch.cat([maps.flatten(0, 1), places], dim=1)]
        for number, block in enumerate(self.encoder):
            scales.append(block(F.avg_pool2d(scales[-1], 2, ceil_mode=True) if number else scales[-1]))
        _, _, half, quarter, eighth = scales
        whole = torch.cat([eighth.mean((2, 3)), eighth.amax((2, 3))], dim=1).view(B, C, -1)
        whole = self.whole((whole + whole.mean(1, keepdim=True)) / 2).flatten(0, 1)
        features = eighth + whole[:, :, None, None]
        for block, skipped in zip(self.decoder, (quarter, half), strict=True):
            features = block(torch.cat([skipped, _enlarged(features, skipped)], dim=1))
        return _smooth(_enlarged(self.head(features), maps).view(B, C, height, width))


def _block(inputs: int, outputs: int) -> nn.Sequential:
    """Two convolutions of 3 x 3."""
    layers: list[nn.Module] = []
    for channels in (inputs, outputs):
        convolution = nn.Conv2d(channels, outputs, 3, padding=1, padding_mode="replicate")
        layers += [convolution, nn.GroupNorm(8, outputs), nn.SiLU()]
    return nn.Sequential(*layers)


def _enlarged(features: Tensor, like: Tensor) -> Tensor:
    return F.interpolate(features, like.shape[-2:], mode="bilinear")


def _smooth(light: Tensor) -> Tensor:
    """The part of light (B, C, h, w) that consists of the cosines up to `MAX_FREQUENCY`."""
    basis = cosines(size_of(light), light.device, MAX_FREQUENCY)
    return (basis.coefficients(light.float()) @ basis.light.flatten(1)).view(light.shape)

"""Real cameras beyond a changed PSF: the options of [mismatch] that are off by default, drawn for a batch.

Each option of each sample has a random generator of its own: switching one on changes no other draw.
"""

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor
from torch.nn import functional as F

from mwdn.data.mismatch import REAL_OPTIONS, TAIL_RADIUS, Mismatch
from mwdn.data.random import seeded, uniform
from mwdn.fourier.convolution import convolve
from mwdn.optics.aperture import displaced_envelope, low_order_field, scattered
from mwdn.optics.deviation import off_axis_change
from mwdn.optics.field import FieldCamera, two_depths
from mwdn.optics.psf import unit_sum
from mwdn.optics.room_light import even_light, sloping_light, spot_light
from mwdn.optics.sensor import Sensor, gamma_coded
from mwdn.optics.warp import warp
from mwdn.types import Image, Measurement, Psf, Scene, Size, size_of

STREAM = 16
"""Number of the first option's random stream; `mwdn.data.cameras` has 7."""

POINTS = ((0, 0), (1, 0), (0, 1), (1, 1), (1, -1))
"""Points (down, right) of a 3 x 3 grid at which PSFs off the axis are computed; opposite points have equal PSFs."""

FIELD_ORDER = 4
"""Gain over the aperture, and the outline between two depths: cosines of up to one and a half periods a side."""

SPOT = (0.15, 0.5)
"""Standard deviation of a spot of room light over the frame's width."""

TINT = 0.3
"""Largest relative excess of a colour of room light."""

GAMMA = 2.2
"""Gamma of coded captures: the preset of most cameras, and nearly that of sRGB."""


@dataclass(frozen=True)
class RealCamera:
    """Draws the real camera of each sample of a batch. With an option at 0 its step returns its input.

    Args:
        mismatch: largest magnitudes.
        seeds: one of each sample.
        exact: whether the sample's camera equals its calibration.
    """

    mismatch: Mismatch
    seeds: tuple[int, ...]
    exact: tuple[bool, ...]

    def psf(self, psf: Psf) -> Psf:
        """The PSF (B, C, h, w) of an uneven, displaced aperture that scatters light; sums of lit channels stay 1."""
        size, changed = size_of(psf), psf
        if self.mismatch.envelope_shift:
            length, generators = self._amount("envelope_shift")
            angle = uniform(generators, 0.0, 2 * math.pi)
            shift = length[:, :, 0, 0] * min(size) * torch.cat([angle.sin(), angle.cos()], 1)
            changed = displaced_envelope(changed, shift)
        if self.mismatch.aperture_gain:
            amount, generators = self._amount("aperture_gain")
            changed = changed * (1 + amount * self._gains(generators, psf.shape[1], size)).to(psf)
        if self.mismatch.tails:
            part, generators = self._amount("tails")
            smallest, largest = (min(size) * end for end in TAIL_RADIUS)
            radius = uniform(generators, math.log(smallest), math.log(largest)).exp()[..., None, None]
            changed = scattered(changed, part.to(psf), radius.to(psf))
        return psf if changed is psf else unit_sum(changed)

    def forward(self, scene: Scene, psf: Psf) -> Measurement:
        """Light on the sensor, through PSFs that depend on the place in the scene and on its depth."""
        if not (self.mismatch.off_axis or self.mismatch.depth):
            return convolve(scene, psf)
        off_axis, depth = (self._amount(name)[0].flatten().tolist() for name in ("off_axis", "depth"))
        near = self._outlines(size_of(scene)).to(scene)
        parts = zip(scene, psf, near, off_axis, depth, strict=True)
        return torch.cat([field_camera(h[None], one[None], *sizes).forward(v[None]) for v, h, one, *sizes in parts])

    def lit(self, light: Measurement) -> Measurement:
        """Add the light of a room, relative to the mean of the light that is there."""
        if not self.mismatch.room_light:
            return light
        share, generators = self._amount("room_light")
        rooms = torch.stack([_room(generator, size_of(light)) for generator in generators])
        tint = 1 + TINT * uniform(generators, -1.0, 1.0, light.shape[1])[..., None, None]
        room = share * (tint / tint.mean(1, keepdim=True)) * rooms[:, None]
        return light + room.to(light) * light.mean((1, 2, 3), keepdim=True)

    def heated(self, light: Measurement) -> Measurement:
        """Add the dark current of hot pixels; 1 is saturation."""
        if not self.mismatch.hot_pixels:
            return light
        part, generators = self._amount("hot_pixels")
        which, current = (torch.stack([torch.rand(light.shape[1:], generator=g) for g in generators]) for _ in range(2))
        return light + ((which < part) * current).to(light)

    def sensors(self, sensor: Sensor) -> list[Sensor]:
        """The sensor of each sample: some are read out with 8 bits (8-bit files are another option)."""
        coarse = replace(sensor, bit_depth=min(8, sensor.bit_depth))
        chosen = zip(self._chosen("eight_bit"), self._chosen("gamma_coded"), strict=True)
        return [coarse if eight and not coded else sensor for eight, coded in chosen]

    def decoded(self, captures: Image) -> Image:
        """Store some captures with a gamma of 2.2 and decode them with a slightly wrong gamma."""
        if not self.mismatch.gamma_coded:
            return captures
        error = self.mismatch.signed(self._generators("gamma_error"), self.mismatch.gamma_error).flatten().tolist()
        coded = zip(captures, self._chosen("gamma_coded"), error, strict=True)
        return torch.stack([gamma_coded(one[None], GAMMA, GAMMA * (1 + e))[0] if yes else one for one, yes, e in coded])

    def _generators(self, option: str) -> list[torch.Generator]:
        return [seeded(seed ^ (STREAM + REAL_OPTIONS.index(option) << 24)) for seed in self.seeds]

    def _amount(self, option: str) -> tuple[Tensor, list[torch.Generator]]:
        """(B, 1, 1, 1) random values of an option, 0 in exact samples; and the generators for what else it needs."""
        generators = self._generators(option)
        values = self.mismatch.size(generators, getattr(self.mismatch, option))
        return torch.where(torch.tensor(self.exact)[:, None], 0.0, values)[..., None, None], generators

    def _chosen(self, option: str) -> list[bool]:
        """Whether each sample has an option whose value is a fraction of the samples."""
        drawn = uniform(self._generators(option), 0.0, 1.0).flatten() < getattr(self.mismatch, option)
        return [bool(yes) and not exact for yes, exact in zip(drawn, self.exact, strict=True)]

    def _gains(self, generators: list[torch.Generator], channels: int, size: Size) -> Tensor:
        """(B, C, H, W) in [-1, 1], of which 0.7 is common to all colours."""
        parts = torch.stack([torch.randn(1 + channels, FIELD_ORDER, FIELD_ORDER, generator=g) for g in generators])
        fields = low_order_field(parts, size)
        return 0.7 * fields[:, :1] + 0.3 * fields[:, 1:]

    def _outlines(self, size: Size) -> Tensor:
        """(B, 1, H, W), 1 at near points and 0 at far ones: about half of the scene each."""
        generators = self._generators("depth")
        for generator in generators:
            torch.rand(1, generator=generator)  # the amount
        parts = torch.stack([torch.randn(1, FIELD_ORDER, FIELD_ORDER, generator=g) for g in generators])
        fields = low_order_field(parts, size)
        return (fields > fields.flatten(1).median(1).values[:, None, None, None]).float()


def field_camera(psf: Psf, is_near: Tensor, off_axis: float, depth: float) -> FieldCamera:
    """A camera whose PSF changes over its field, and with depth.

    Args:
        psf: (1, C, h, w), on the axis and at the middle of both depths; scenes and measurements have its size.
        is_near: (1, 1, h, w), see `mwdn.optics.field.two_depths`.
        off_axis: change to the corner, see `mwdn.optics.deviation.OFF_AXIS`; bilinear between 3 x 3 points.
        depth: relative magnification of the near PSF over the far one.
    """
    size = size_of(psf)
    points = POINTS if off_axis else POINTS[:1]
    change, grid = off_axis_change(off_axis, size), torch.zeros(len(points), 1, 3, 3, device=psf.device)
    for number, (y, x) in enumerate(points):
        grid[number, 0, 1 + y, 1 + x] = grid[number, 0, 1 - y, 1 - x] = 1
    weights = F.interpolate(grid, size, mode="bilinear", align_corners=True) if off_axis else torch.ones_like(is_near)

    def at(magnification: float) -> FieldCamera:
        # `warp` keeps the brightness: the same light on a larger area is darker.
        scaled = psf if magnification == 1 else warp(psf, magnification * torch.eye(2)) / magnification**2
        return FieldCamera(torch.cat([change.at(scaled, float(y), float(x)) for y, x in points]), weights)

    return two_depths(at(1 + depth / 2), at(1 - depth / 2), is_near) if depth else at(1.0)


def _room(generator: torch.Generator, size: Size) -> Tensor:
    """Room light (H, W) of mean 1: even, a slope or a spot."""
    kind, down, right, width = torch.rand(4, generator=generator).tolist()
    if kind < 1 / 3:
        return even_light(size)
    if kind < 2 / 3:
        return sloping_light(size, 2 * math.pi * down)
    return spot_light(size, (down, right), SPOT[0] + (SPOT[1] - SPOT[0]) * width)

"""Find a plane of light, or a wide spot, where the scene of a capture should be dark.

The capture b is a scene v through the PSF, and a background l:

1. ``b = C H v + l + noise`` with ``v >= 0`` and ``l >= 0``. C crops to the sensor; l is a plane of light or a Gaussian
   spot. Where b is saturated, the right side may be larger.

A scene can imitate smooth light completely, by a glow and by light from outside the frame, so the residual does not
tell how much of it is the room's. The dark part of the scene does. With v the best scene for ``b - l``, and v' the part
of v that is not such a glow,

2. ``l <- P(l + a (b - C H v' - l))``: what v' does not explain. P is the best plane or spot (`SmoothLight.fit`).

It is repeated with three kinds of v', `CAUTIOUS`, `THOROUGH` and `GIVE_BACK`, in coarse pixels.
"""

import math
from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional as F

from mwdn.fourier.transforms import inverse_spectrum, spectrum
from mwdn.optics.saturation import subtract_light
from mwdn.solvers.levels import LEVELS, root_mean_square
from mwdn.solvers.light_spot import Cosines, Spot, best_spot, cosines
from mwdn.solvers.pyramid import PsfPyramid
from mwdn.types import Measurement, Psf, Scene, Size, size_of

COARSEST = replace(LEVELS[0], downsampling=1)
"""The iterations for a scene in these coarse pixels."""

MIN_SMOOTH_LIGHT = 0.06
"""Least share of the light that the first phase must find. It finds 0.00 to 0.06 in 20 real captures without room
light, and 0.08 to 0.2 where the room's light is 0.17 to 0.23 of the capture."""

MISFIT = 0.1
"""Largest misfit (`_run`) of the light and the bright part of the frame. Light of the room over objects on dark has at
most 0.04 through an exact PSF. Added to real captures of such objects it has 0.03 to 0.09, a wide spot up to 0.13.
Without it these captures have 0.12 to 0.14, and photographs that fill the frame 0.05 to 0.5."""

MOSTLY_DARK = 0.55
"""Least part of the frame that a scene must leave dark, below a quarter of its mean. Objects on dark, half as high as
the frame, leave 0.6 to 0.8, photographs that fill the frame 0.1 to 0.6."""

BRIGHT = 0.1
"""A pixel of the scene is bright above this part of the 95 % quantile. The pixels around it count as bright, too."""

SURFACE_ORDER = 3.0
"""Highest frequency of the surface below the dark part, in half periods over the frame's width."""

ABOVE = 0.05
"""Weight of pixels above the surface; pixels below it have a weight of 1."""

RIDGE = 1e-3
"""Added to the mean square of each basis function, so that there is a surface if few pixels are dark."""


class SmoothLight(NamedTuple):
    """A plane of light, or a spot, on each sensor.

    Args:
        plane: (B, C, 3), coefficients of even light, and of light that rises down and to the right.
        spot: its amplitude is 0 where there is a plane.
    """

    plane: Tensor
    spot: Spot

    @classmethod
    def fit(cls, light: Tensor, basis: Cosines, advantage: float = 1.0) -> "SmoothLight":
        """The best plane or spot for light (B, C, h, w) of any sign, by least squares.

        Args:
            light: to fit.
            basis: of the frame.
            advantage: a spot, which has more shapes, is taken if its error is smaller by this factor.
        """
        X, t = _planes(basis.size, light.device).flatten(1), light.flatten(2)
        plane = t @ X.T @ torch.linalg.inv(X @ X.T)
        spot = best_spot(-t, basis.light.flatten(1).expand(len(light), -1, -1), basis)
        errors = [(each - t).square().mean((1, 2)) for each in (plane @ X, spot.light(basis.size).flatten(2))]
        is_plane = errors[0] <= advantage * errors[1]
        return cls(torch.where(is_plane[:, None, None], plane, 0.0), Spot.none(light).where(is_plane, spot))

    def on(self, size: Size) -> Tensor:
        """The light on a frame, (B, C, h, w), not negative."""
        plane = self.plane @ _planes(size, self.plane.device).flatten(1)
        return plane.reshape(*plane.shape[:2], *size).clamp(min=0) + self.spot.light(size)


class Phase(NamedTuple):
    """Some steps of equation (2).

    Args:
        steps: how many.
        part: v' of a scene v, both (B, C, *grid), for a frame at the top left of the grid.
        a: length of a step.
        advantage: of a plane over a spot, see `SmoothLight.fit`.
    """

    steps: int
    part: Callable[[Scene, Size], Tensor]
    a: float
    advantage: float


def find_smooth_light(b: Measurement, psf: Psf) -> tuple[SmoothLight, Tensor]:
    """The light in measurements (B, C, h, w) of mean 1, through PSFs (B, C, h, w), and whether it counts, bool (B,)."""
    size = size_of(b)
    pyramid = PsfPyramid.from_psf(psf, size, (COARSEST,))
    basis = cosines(size, b.device)
    none = SmoothLight(b.new_zeros(*b.shape[:2], 3), Spot.none(b))
    light, _ = _run(CAUTIOUS, none, b, pyramid, basis)
    found = light.on(size).mean((1, 2, 3)) >= MIN_SMOOTH_LIGHT
    if not found.any():
        return light, found
    light, misfit = _run(THOROUGH, light, b, pyramid, basis)
    light, _ = _run(GIVE_BACK, light, b, pyramid, basis)
    scene = pyramid.solve(subtract_light(b, light.on(size))).scene
    return light, found & (misfit <= MISFIT) & (dark_part(scene) >= MOSTLY_DARK)


def _run(
    phase: Phase, light: SmoothLight, b: Measurement, pyramid: PsfPyramid, basis: Cosines
) -> tuple[SmoothLight, Tensor]:
    """Steps of equation (2): the light, and the misfit (B,) at the last step.

    The misfit is the root mean square of ``b - C H v' - l`` over that of l.
    """
    (band,) = pyramid.bands
    misfit = b.new_zeros(len(b))
    for _ in range(phase.steps):
        known = light.on(basis.size)
        own = phase.part(pyramid.solve(subtract_light(b, known)).grid_scene, basis.size)
        seen = inverse_spectrum(band.transfer * band.norm * spectrum(own, band.grid), band.grid, basis.size)
        missing = b - seen - known
        misfit = root_mean_square(missing).flatten() / root_mean_square(known).flatten()
        light = SmoothLight.fit(known + phase.a * missing, basis, phase.advantage)
    return light, misfit


def dark_part(frame: Scene) -> Tensor:
    """Part (B,) of the frame, in 12 x 12 blocks, where a scene is darker than a quarter of its mean."""
    blocks = F.adaptive_avg_pool2d(frame.mean(1), 12).flatten(1)
    return (blocks < blocks.mean(1, keepdim=True) / 4).float().mean(1)


def _planes(size: Size, device: torch.device) -> Tensor:
    """Even light, and light that rises linearly down and to the right: (3, H, W), each of mean square 1 (nearly)."""
    lengths = (torch.arange(length, device=device, dtype=torch.float32) for length in size)
    down, right = (math.sqrt(3) * ((2 * each + 1) / len(each) - 1) for each in lengths)
    return torch.stack([torch.ones_like(down[:, None]).expand(size), down[:, None].expand(size), right.expand(size)])


def _fit_below(y: Tensor, X: Tensor, inside: Tensor) -> Tensor:
    """Coefficients (..., T) of the largest combination of X (T, P) below y (..., P): asymmetric least squares.

    Args:
        y: the values.
        X: the basis.
        inside: (..., P), 0 where a value does not count, else 1.
    """
    penalty = RIDGE * X.shape[1] * torch.eye(len(X), device=X.device, dtype=X.dtype)
    inside = inside.expand_as(y)
    weight, c = inside, y
    for _ in range(10):  # each round lowers the weight of the values above the last fit
        XW = X * weight[..., None, :]
        c = torch.linalg.solve(XW @ X.mT + penalty, XW @ y[..., None])[..., 0]
        weight = torch.where(c @ X < y, ABOVE * inside, inside)
    return c


def _without_surface(scene: Scene, size: Size) -> Tensor:
    """The scene without the smooth surface below the dark part of its frame."""
    frame = scene[..., : size[0], : size[1]]
    dark = ~bright_mask(frame)
    X = cosines(size, scene.device, SURFACE_ORDER).light.flatten(1)
    c = _fit_below(frame.flatten(2), X, dark.flatten(2).float())
    below = torch.minimum((c @ X).reshape(frame.shape).clamp(min=0), frame) * dark
    return scene - on_grid(below, scene)


def _bright_part(scene: Scene, size: Size) -> Tensor:
    """The bright part of the frame."""
    frame = scene[..., : size[0], : size[1]]
    return on_grid(frame * bright_mask(frame), scene)


def bright_mask(frame: Scene) -> Tensor:
    """The bright part of scenes and the pixels around it, bool (B, 1, h, w)."""
    grey = frame.mean(1, keepdim=True)
    limit = BRIGHT * grey.flatten(1).quantile(0.95, dim=1)
    return F.max_pool2d((grey > limit[:, None, None, None]).float(), 3, 1, 1) > 0


def on_grid(frame: Tensor, scene: Scene) -> Tensor:
    """A frame on the grid of a scene, with zeros around it."""
    return F.pad(frame, (0, scene.shape[-1] - frame.shape[-1], 0, scene.shape[-2] - frame.shape[-2]))


CAUTIOUS = Phase(4, _without_surface, a=1.5, advantage=1.0)
"""v' keeps faint objects and all light from outside the frame. So only a part of the room's light is found, but next to
nothing of the scene's. If it is too little (`MIN_SMOOTH_LIGHT`), there is no more to do."""

THOROUGH = Phase(8, _bright_part, a=1.5, advantage=2.0)
"""v' is the bright part of the frame: all other light is the room's."""

GIVE_BACK = Phase(10, lambda scene, _: scene, a=1.0, advantage=2.0)
"""v' is the whole scene. Its residual is negative where too much has been subtracted, and gives it back. With 3 steps
`universal` loses 0.4 dB at even light and at a slope, with 10 it loses 0.06."""

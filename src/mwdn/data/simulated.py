"""Pairs made on the fly: photographs placed in a scene, passed through a camera that is not quite the calibrated one.

Every sample draws from its own generator, seeded by (seed, number of the sample): a run gives the same pairs however
many processes share it, and in whatever batches.
"""

import math
from dataclasses import dataclass, fields
from typing import NamedTuple, Protocol, runtime_checkable

import torch
from torch import Tensor
from torch.nn import functional as F

from mwdn.data.photographs import Photographs
from mwdn.errors import ParameterError
from mwdn.fourier import Size
from mwdn.optics.camera import Camera
from mwdn.optics.field import FieldCamera
from mwdn.optics.sensor import Sensor
from mwdn.optics.warp import hazed
from mwdn.types import Measurement, Psf, Scene

Range = tuple[float, float]


@dataclass(frozen=True)
class Placement:
    """How a photograph stands in the scene. Each number is drawn evenly from its range for each sample.

    Args:
        extent: side of the photograph over the shorter side of the sensor. The paper's display takes 137 / 320.
        aspect: width over height, drawn from [1 / aspect, aspect].
        turn_degrees: drawn from [-turn, turn].
        offset: displacement of its centre, over half the space beside it; 1 lets it touch the border.
        ambient: light that reaches the whole sensor from elsewhere, over the mean of the measurement.
        exposure: brightest pixel of the measurement over saturation: the less, the noisier. Each stop is as likely.
    """

    extent: Range = (0.3, 0.7)
    aspect: float = 1.3
    turn_degrees: float = 10.0
    offset: float = 0.6
    ambient: Range = (0.0, 0.05)
    exposure: Range = (0.4, 0.95)

    def __post_init__(self) -> None:
        for name in ("extent", "ambient", "exposure"):
            low, high = getattr(self, name)
            if not 0 <= low <= high:
                raise ParameterError(f"`{name}` ({low}, {high}) must be a range: not negative, the smaller one first.")
        for name, of in (("extent", "the sensor's shorter side"), ("exposure", "saturation")):
            if not getattr(self, name)[0] > 0:
                raise ParameterError(f"`{name}` {getattr(self, name)} must be positive: a part of {of}.")
        if not self.aspect >= 1:
            raise ParameterError(f"`aspect` ({self.aspect}) must be at least 1, a square.")
        if not 0 <= self.offset <= 1:
            raise ParameterError(f"`offset` ({self.offset}) must be in [0, 1]; 1 reaches the border.")


@dataclass(frozen=True)
class Mismatch:
    """How the camera differs from its calibration. Each number is the largest size of a draw.

    Args:
        shift_px: displacement of the PSF.
        turn_degrees: rotation of the PSF.
        scale: relative magnification of the PSF.
        blur_px: standard deviation of a Gaussian blur of the PSF.
        sharpen: how much finer than its calibration the PSF is: weight of what a blur by one pixel takes from it.
        background: even light under the PSF, as a part of its sum.
        colour_shift_px: displacement of red and blue against green.
        vignetting: relative loss of light in the corners of the measurement.
        tilt: relative gain or loss of light at one side of the measurement against its centre, in any direction.
        grain: relative error of the single pixels of the calibrated PSF, as its own noise leaves it.
        full: draw the largest sizes always, with a random sign where there is one.
        exact: part of the samples whose camera is what its calibration says.
    """

    shift_px: float = 0.5
    turn_degrees: float = 0.5
    scale: float = 0.01
    blur_px: float = 0.7
    background: float = 0.1
    colour_shift_px: float = 0.3
    vignetting: float = 0.1
    tilt: float = 0.0
    grain: float = 0.0
    sharpen: float = 0.0
    full: bool = False
    exact: float = 0.0

    def __post_init__(self) -> None:
        if not self.exact <= 1:
            raise ParameterError(f"`exact` ({self.exact}) must be in [0, 1]: it is a part of the samples.")
        for part in fields(self):
            if not getattr(self, part.name) >= 0:
                raise ParameterError(f"`{part.name}` ({getattr(self, part.name)}) must not be negative: it is a size.")
        for name in ("scale", "background", "vignetting", "tilt"):
            if not getattr(self, name) < 1:
                raise ParameterError(f"`{name}` ({getattr(self, name)}) must be below 1.")

    def size(self, generators: list[torch.Generator], largest: float) -> Tensor:
        """(B, 1) draws from [0, largest]."""
        drawn = uniform(generators, 0.0, 1.0)
        return largest * (torch.ones_like(drawn) if self.full else drawn)

    def signed(self, generators: list[torch.Generator], largest: float, count: int = 1) -> Tensor:
        """(B, count) draws from [-largest, largest]."""
        drawn = uniform(generators, -1.0, 1.0, count)
        return largest * (torch.where(drawn < 0, -1.0, 1.0) if self.full else drawn)


EXACT = Mismatch(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
"""A camera that is what its calibration says."""


class Pair(NamedTuple):
    """What the network sees and what it should give; and each sample's PSF where cameras differ."""

    measurement: Measurement
    scene: Scene
    psf: Psf | None = None


@runtime_checkable
class Samples(Protocol):
    """A source of pairs that are numbered without end: the same number is the same pair."""

    @property
    def name(self) -> str:
        """Tells it from another source, on which a run must not go on."""

    def batch(self, numbers: range | list[int]) -> Pair:
        """Pairs of these numbers, on one device."""


def uniform(generators: list[torch.Generator], low: float, high: float, count: int = 1) -> Tensor:
    """(B, count) numbers, each row from its own generator."""
    return torch.stack([torch.rand(count, generator=g) for g in generators]) * (high - low) + low


def affine(turn: Tensor, scale_y: Tensor, scale_x: Tensor, shift: Tensor, aspect: float) -> Tensor:
    """(B, 2, 3) matrices for ``affine_grid`` that scale, then turn (clockwise), then shift a picture's content.

    Args:
        turn: (B,), radian.
        scale_y: (B,), height of the content over that of the frame.
        scale_x: (B,), width of the content over that of the frame.
        shift: (B, 2), down and right, over half the frame.
        aspect: width over height of the frame, so that a turned square stays a square.
    """
    c, s = turn.cos(), turn.sin()
    # affine_grid asks where each output pixel comes from: the inverse map, undone from the outside in.
    inverse = torch.stack(
        [
            torch.stack([c / scale_x, s / aspect / scale_x], -1),
            torch.stack([-s * aspect / scale_y, c / scale_y], -1),
        ],
        dim=1,
    )
    origin = -(inverse @ shift.flip(-1)[..., None])
    return torch.cat([inverse, origin], dim=-1)


@dataclass(frozen=True, eq=False)
class SimulatedPairs:
    """A source of pairs for one calibrated camera.

    Args:
        photographs: what stands in the scenes.
        psf: of the calibration, (1, C, H, W), unit sum; also the size of the sensor.
        placement: how photographs stand in the scene.
        mismatch: how the camera differs from its calibration.
        sensor: noise, black level and saturation.
        seed: of everything.
        camera: the true one, where it is known and always the same; no PSF is perturbed then.
    """

    photographs: Photographs
    psf: Psf
    placement: Placement = Placement()
    mismatch: Mismatch = Mismatch()
    sensor: Sensor = Sensor()
    seed: int = 0
    camera: FieldCamera | None = None

    @property
    def name(self) -> str:
        """The same for all photographs: more of them do not make another run."""
        return "simulated"

    def batch(self, numbers: range | list[int]) -> Pair:
        """Make the samples of these numbers.

        Returns:
            measurement (B, 3, H, W), its noise relative to the exposure, in units of the scene; and the scene
            (B, 3, H, W), linear light in [0, 1].
        """
        generators = self.generators(numbers)
        scene = self.scenes(generators)
        psf = self.psf.expand(len(scene), -1, -1, -1)
        true = psf if self.camera else perturb(psf, self.mismatch, generators)
        shading = self._shading(generators, (psf.shape[-2], psf.shape[-1])).to(psf)
        if self.mismatch.exact:
            exact = (uniform(generators, 0.0, 1.0)[..., None, None] < self.mismatch.exact).to(psf.device)
            true, shading = torch.where(exact, psf, true), torch.where(exact, 1.0, shading)
        light = (self.camera or Camera(true)).forward(scene) * shading
        ambient = uniform(generators, *self.placement.ambient)[..., None, None].to(light)
        light = light + ambient * light.mean((1, 2, 3), keepdim=True)
        brightest = light.amax((1, 2, 3), keepdim=True).clamp(min=1e-6)
        darkest, lightest = self.placement.exposure
        stops = uniform(generators, math.log(darkest), math.log(lightest))
        gain = stops.exp()[..., None, None].to(light) / brightest
        exposed = torch.cat([self._expose(one, g) for one, g in zip(light * gain, generators, strict=True)])
        return Pair(exposed / gain, scene)

    def generators(self, numbers: range | list[int]) -> list[torch.Generator]:
        """One for each sample of these numbers."""
        # Two neighbouring seeds share no sample before the millionth; torch looks at the lower 32 bits alone.
        return [torch.Generator().manual_seed((self.seed * 1_000_003 + n) & (2**63 - 1)) for n in numbers]

    def scenes(self, generators: list[torch.Generator]) -> Scene:
        """Place one photograph in each scene: chosen, mirrored, scaled, turned, shifted."""
        height, width = self.psf.shape[-2:]
        index = torch.cat([torch.randint(len(self.photographs), (1,), generator=g) for g in generators])
        pictures = self.photographs.light(index.to(self.psf.device))
        pictures = torch.where(
            (uniform(generators, 0.0, 1.0)[..., None, None] < 0.5).to(pictures.device), pictures.flip(-1), pictures
        )
        p = self.placement
        extent = uniform(generators, *p.extent)[:, 0] * min(height, width)
        stretch = torch.exp(uniform(generators, -1.0, 1.0)[:, 0] * math.log(p.aspect) / 2)
        scale_y, scale_x = extent / stretch / height, extent * stretch / width
        turn = torch.deg2rad(uniform(generators, -1.0, 1.0)[:, 0] * p.turn_degrees)
        room = torch.stack([1 - scale_y, 1 - scale_x], -1).clamp(min=0.1)
        shift = uniform(generators, -1.0, 1.0, 2) * p.offset * room
        theta = affine(turn, scale_y, scale_x, shift, width / height).to(pictures)
        return _resample(pictures, theta, (height, width))

    def _shading(self, generators: list[torch.Generator], size: Size) -> Tensor:
        loss = self.mismatch.size(generators, self.mismatch.vignetting)[..., None, None]
        y, x = torch.linspace(-1, 1, size[0])[:, None], torch.linspace(-1, 1, size[1])
        shading = 1 - loss * (y.square() + x.square()) / 2
        if self.mismatch.tilt:
            tilt = self.mismatch.size(generators, self.mismatch.tilt)[..., None, None]
            angle = uniform(generators, 0.0, 2 * math.pi)[..., None, None]
            shading = shading * (1 + tilt * (y * angle.sin() + x * angle.cos()))
        return shading

    def _expose(self, light: Tensor, generator: torch.Generator) -> Tensor:
        if light.device.type != "cpu":
            seed = int(torch.randint(2**62, (1,), generator=generator))
            generator = torch.Generator(light.device).manual_seed(seed)
        return self.sensor.expose(light[None], generator=generator)


def _resample(pictures: Tensor, theta: Tensor, size: Size) -> Tensor:
    """Draw pictures into frames of ``size``, each frame pixel the mean of 2 x 2 samples; black outside."""
    fine = [len(pictures), pictures.shape[1], 2 * size[0], 2 * size[1]]
    grid = F.affine_grid(theta, fine, align_corners=False)
    return F.avg_pool2d(F.grid_sample(pictures, grid, align_corners=False), 2).clamp(0, 1)


def perturb(psf: Psf, mismatch: Mismatch, generators: list[torch.Generator]) -> Psf:
    """Turn, scale, shift, blur and haze each PSF of a batch, each by its own draw; sums stay 1.

    Args:
        psf: (B, C, H, W) of unit sum.
        mismatch: largest sizes.
        generators: one a sample.
    """
    if mismatch == EXACT:
        return psf
    batch, channels, height, width = psf.shape
    colours = torch.tensor([-1.0, 0.0, 1.0]) if channels == 3 else torch.zeros(channels)
    base = mismatch.signed(generators, mismatch.shift_px, 2)
    spread = mismatch.signed(generators, mismatch.colour_shift_px, 2)
    shift = base[:, None] + colours[:, None] * spread[:, None]
    # The PSF's centre is pixel n // 2, half a pixel from the middle of an even frame: turn about it.
    turn = torch.deg2rad(mismatch.signed(generators, mismatch.turn_degrees)[:, 0]).repeat_interleave(channels)
    scale = (1 + mismatch.signed(generators, mismatch.scale)[:, 0]).repeat_interleave(channels)
    half = torch.tensor([height, width]) / 2
    centre = (torch.tensor([height // 2 + 0.5, width // 2 + 0.5]) - half) / half
    theta = affine(turn, scale, scale, shift.flatten(0, 1) / half, width / height)
    centre_xy = centre.flip(0)[:, None]
    theta[..., 2:] += centre_xy - theta[..., :2] @ centre_xy
    planes = psf.reshape(batch * channels, 1, height, width)
    grid = F.affine_grid(theta.to(psf), list(planes.shape), align_corners=False)
    moved = F.grid_sample(planes, grid, mode="bilinear", align_corners=False)
    if mismatch.sharpen:
        amount = mismatch.size(generators, mismatch.sharpen)[:, 0].repeat_interleave(channels)[:, None, None, None]
        fine = moved - _blur(moved, torch.ones(len(moved), device=moved.device))
        moved = (moved + amount.to(moved) * fine).clamp(min=0)
    sigma = mismatch.size(generators, mismatch.blur_px)[:, 0].repeat_interleave(channels)
    blurred = _blur(moved, sigma.to(psf)).reshape(psf.shape)
    if mismatch.grain:
        noise = torch.stack([torch.randn(blurred.shape[1:], generator=g) for g in generators]).to(blurred)
        blurred = blurred * (1 + mismatch.grain * noise).clamp(min=0)
    blurred = blurred / blurred.sum((-2, -1), keepdim=True).clamp(min=1e-12)
    return hazed(blurred, mismatch.size(generators, mismatch.background)[..., None, None].to(psf))


def _blur(planes: Tensor, sigma: Tensor) -> Tensor:
    """Gaussian blur of (N, 1, H, W), each plane by its own sigma (N,) in pixels, over 7 pixels."""
    distance = torch.arange(-3, 4, device=planes.device)
    weights = torch.exp(-0.5 * (distance / sigma.clamp(min=1e-3)[:, None]).square())
    weights = weights / weights.sum(1, keepdim=True)
    stacked = planes.movedim(0, 1)
    stacked = F.conv2d(stacked, weights[:, None, :, None], padding=(3, 0), groups=len(planes))
    return F.conv2d(stacked, weights[:, None, None, :], padding=(0, 3), groups=len(planes)).movedim(0, 1)

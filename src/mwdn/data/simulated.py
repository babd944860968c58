"""Pairs simulated during training: photographs in scenes, captured by a camera that differs from its calibration.

Every sample has its own random generator, seeded by (seed, number of the sample): a run makes the same pairs for any
number of processes and any batch size.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import wraps
from typing import NamedTuple, ParamSpec, Protocol, TypeVar, runtime_checkable

import torch
from torch import Tensor
from torch.nn import functional as F

from mwdn.arguments import checked
from mwdn.data.mismatch import Mismatch, perturb, shading
from mwdn.data.photographs import Photographs
from mwdn.data.random import seeded, uniform
from mwdn.data.real_camera import RealCamera
from mwdn.errors import ParameterError
from mwdn.optics.field import FieldCamera
from mwdn.optics.sensor import Sensor
from mwdn.optics.warp import affine
from mwdn.types import Measurement, Psf, Scene, Size, size_of

P = ParamSpec("P")
R = TypeVar("R")
Range = tuple[float, float]


@checked
@dataclass(frozen=True)
class Placement:
    """The [placement] of a recipe: where a photograph is in the scene, and how it is lit.

    Each value is drawn for each sample, uniformly unless stated otherwise.

    Args:
        extent: range of the photograph's side, relative to the shorter side of the sensor. The paper's display has
            137 / 320.
        aspect: width over height is drawn log-uniformly from [1 / aspect, aspect].
        turn_degrees: rotation, drawn from [-turn_degrees, turn_degrees].
        offset: largest displacement of the centre, relative to half the free space; at 1 the photograph can touch the
            border.
        ambient: range of uniform stray light on the sensor, relative to the mean of the measurement.
        exposure: range of the measurement's brightest pixel, relative to saturation; drawn log-uniformly. The lower,
            the noisier.
        backdrop: range of uniform light around the photograph, such as a wall behind an object, drawn for each colour;
            1 is the photograph's white.
    """

    extent: Range = (0.3, 0.7)
    aspect: float = 1.3
    turn_degrees: float = 10.0
    offset: float = 0.6
    ambient: Range = (0.0, 0.05)
    exposure: Range = (0.4, 0.95)
    backdrop: Range = (0.0, 0.0)

    def __post_init__(self) -> None:
        for name in ("extent", "ambient", "exposure", "backdrop"):
            low, high = getattr(self, name)
            if not 0 <= low <= high:
                raise ParameterError(
                    f"`{name}` ({low}, {high}) must be a range: not negative, the smaller value first."
                )
        for name, whole in (("extent", "the sensor's shorter side"), ("exposure", "saturation")):
            if not getattr(self, name)[0] > 0:
                raise ParameterError(f"`{name}` {getattr(self, name)} must be positive: it is a fraction of {whole}.")
        if not self.backdrop[1] <= 1:
            raise ParameterError(f"`backdrop` {self.backdrop} must be 1 at most, the photograph's white.")
        if not self.aspect >= 1:
            raise ParameterError(f"`aspect` ({self.aspect}) must be at least 1, a square.")
        if not 0 <= self.offset <= 1:
            raise ParameterError(f"`offset` ({self.offset}) must be in [0, 1]; 1 reaches the border.")


class Batch(NamedTuple):
    """Samples for a network: its two inputs and its target.

    Args:
        measurement: (B, C, H, W).
        scene: (B, C, H, W).
        psf: (1, C, H, W) of the one camera, or (B, C, H, W) of each sample's camera.
    """

    measurement: Measurement
    scene: Scene
    psf: Psf


@runtime_checkable
class NumberedSamples(Protocol):
    """Samples with unlimited numbers, and what tells a run that they are the same when it resumes."""

    @property
    def name(self) -> str:
        """Identifies the source of the samples."""

    @property
    def content(self) -> str:
        """Hash of the files that the samples are made from; empty without files."""
        return ""

    @property
    def fingerprint(self) -> str:
        """Hash of what the samples show, the same for a copy of the files."""
        return self.content

    def describe(self, numbers: range) -> str:
        """Names the samples in an error message."""
        return f"samples {numbers.start} to {numbers.stop - 1}"


@runtime_checkable
class Samples(NumberedSamples, Protocol):
    """A source of pairs: the same number always gives the same pair."""

    def batch(self, numbers: range | list[int]) -> Batch:
        """The samples of these numbers, on one device."""

    def prefetched(self, stride: int) -> "Samples":
        """The same samples, the next batch loaded in advance where loading is slow.

        Args:
            stride: from the numbers of one batch to those of the next.
        """
        return self


def full_precision(make: Callable[P, R]) -> Callable[P, R]:
    """Decorator: make samples in float32, also inside the autocast of a network's training.

    bfloat16 would displace a scene by up to one pixel, and change a PSF by 7 % of its norm.
    """

    @wraps(make)
    def made(*args: P.args, **kwargs: P.kwargs) -> R:
        with torch.autocast("cpu", enabled=False), torch.autocast("cuda", enabled=False):
            return make(*args, **kwargs)

    return made


@dataclass(frozen=True, eq=False)
class SimulatedPairs(Samples):
    """Simulated pairs of one calibrated camera.

    Args:
        photographs: shown in the scenes.
        psf: of the calibration, (1, C, H, W), unit sum; its size is the sensor's.
        placement: where the photographs are in the scenes.
        mismatch: how the camera differs from its calibration.
        sensor: noise, black level and saturation.
        seed: of all random numbers.
        camera: a fixed true camera, in place of randomly perturbed PSFs.
        grey: average the colours of the scenes, for a grey camera.
    """

    photographs: Photographs
    psf: Psf
    placement: Placement = Placement()
    mismatch: Mismatch = Mismatch()
    sensor: Sensor = Sensor()
    seed: int = 0
    camera: FieldCamera | None = None
    grey: bool = False

    @property
    def name(self) -> str:
        """Independent of the photographs, so that a run may resume with more of them."""
        return "simulated"

    @property
    def content(self) -> str:
        """Hash of the photographs."""
        return self.photographs.content

    @full_precision
    def batch(self, numbers: range | list[int]) -> Batch:
        """Simulate the samples of these numbers.

        Returns:
            measurement (B, 3, H, W), with the noise of its exposure, in units of the scene; scene (B, 3, H, W), linear
            light in [0, 1], both of 1 channel if ``grey``; PSF of the calibration (1, C, H, W).
        """
        generators = self.generators(numbers)
        scene = self.scenes(generators)
        psf = self.psf.expand(len(scene), -1, -1, -1)
        real = RealCamera(self.mismatch, tuple(map(self.sample_seed, numbers)), (False,) * len(scene))
        true = psf if self.camera else perturb(real.psf(psf), self.mismatch, generators)
        factors = shading(self.mismatch, generators, size_of(psf)).to(psf)
        if self.mismatch.exact:
            exact = (uniform(generators, 0.0, 1.0)[..., None, None] < self.mismatch.exact).to(psf.device)
            true, factors = torch.where(exact, psf, true), torch.where(exact, 1.0, factors)
            real = replace(real, exact=tuple(exact.flatten().tolist()))
        light = (self.camera.forward(scene) if self.camera else real.forward(scene, true)) * factors
        ambient = uniform(generators, *self.placement.ambient)[..., None, None].to(light)
        light = real.lit(light) + ambient * light.mean((1, 2, 3), keepdim=True)
        brightest = light.amax((1, 2, 3), keepdim=True).clamp(min=1e-6)
        darkest, lightest = self.placement.exposure
        stops = uniform(generators, math.log(darkest), math.log(lightest))
        gain = stops.exp()[..., None, None].to(light) / brightest
        exposures = zip(real.heated(light * gain), generators, real.sensors(self.sensor), strict=True)
        captures = real.decoded(torch.cat([_expose(one, g, sensor) for one, g, sensor in exposures]))
        return Batch(captures / gain, scene, self.psf)

    def generators(self, numbers: range | list[int]) -> list[torch.Generator]:
        """A random generator for each sample of these numbers."""
        return [seeded(self.sample_seed(n)) for n in numbers]

    def sample_seed(self, number: int) -> int:
        """Seed of a sample."""
        return self.seed * 1_000_003 + number  # neighbouring seeds share no sample before the millionth

    def scenes(self, generators: list[torch.Generator]) -> Scene:
        """Choose a photograph for each scene; mirror, scale, rotate and shift it, in front of a backdrop."""
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
        scene = _resample(pictures, theta, (height, width))
        if p.backdrop[1]:
            background = 1 - _resample(torch.ones_like(pictures[:, :1]), theta, (height, width))
            scene = scene + background * uniform(generators, *p.backdrop, 3)[..., None, None].to(scene)
        return scene.mean(1, keepdim=True) if self.grey else scene


def _expose(light: Tensor, generator: torch.Generator, sensor: Sensor) -> Tensor:
    if light.device.type != "cpu":
        seed = int(torch.randint(2**62, (1,), generator=generator))
        generator = torch.Generator(light.device).manual_seed(seed)
    return sensor.expose(light[None], generator=generator)


def _resample(pictures: Tensor, theta: Tensor, size: Size) -> Tensor:
    """Resample pictures into frames of ``size``: the mean of 2 x 2 samples for each pixel, black outside."""
    fine = [len(pictures), pictures.shape[1], 2 * size[0], 2 * size[1]]
    grid = F.affine_grid(theta, fine, align_corners=False)
    return F.avg_pool2d(F.grid_sample(pictures, grid, align_corners=False), 2).clamp(0, 1)

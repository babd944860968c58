"""A solver, a network, a mask and a camera for mwdn, each in its smallest useful form (docs/plugins.md)."""

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn

from mwdn.capture import CameraFrame, CameraSource, Kind
from mwdn.errors import ParameterError
from mwdn.fourier import convolve, correlate, wiener
from mwdn.networks import Network
from mwdn.optics import Mask, Setup, unit_sum


@dataclass(frozen=True)
class RichardsonLucy:
    """Maximum likelihood for photon noise by multiplicative steps, from an even scene.

    Args:
        iterations: number of steps. More of them give finer detail and more noise.

    References:
        W. H. Richardson, J. Opt. Soc. Am. 62, 55 (1972); L. B. Lucy, Astron. J. 79, 745 (1974).
    """

    iterations: int = 50

    def __post_init__(self) -> None:
        if self.iterations < 1:
            raise ParameterError(f"`iterations` ({self.iterations}) must be at least 1.")

    def __call__(self, measurement: Tensor, psf: Tensor) -> Tensor:
        """Scene (B, C, H, W) of a measurement (B, C, H, W) and a PSF."""
        psf, light = unit_sum(psf), measurement.clamp(min=0)
        scene = light.mean((-2, -1), keepdim=True).expand_as(light)
        reached = correlate(torch.ones_like(light), psf).clamp(min=1e-6)  # how much of each point's light is captured
        for _ in range(self.iterations):
            ratio = light / convolve(scene, psf).clamp(min=1e-9)
            scene = scene * correlate(ratio, psf).clamp(min=0) / reached
        return scene


class Residual(Network[Tensor]):
    """A Wiener filter, and two layers that correct it.

    Args:
        width: channels between the layers.
    """

    def __init__(self, width: int = 16) -> None:
        super().__init__()
        self.log_regularisation = nn.Parameter(torch.tensor(-7.0))  # lambda is positive whatever is learned
        self.layers = nn.Sequential(
            nn.Conv2d(3, width, 3, padding=1), nn.ReLU(inplace=True), nn.Conv2d(width, 3, 3, padding=1)
        )

    def prepare(self, psf: Tensor, size: tuple[int, int]) -> Tensor:
        """The PSF."""
        return psf

    def reconstruct(self, measurement: Tensor, prepared: Tensor) -> Tensor:
        """Scene (B, 3, H, W) of a measurement (B, 3, H, W)."""
        estimate = wiener(measurement, unit_sum(prepared), self.log_regularisation.exp())
        return estimate + self.layers(estimate)


@dataclass(frozen=True)
class Ring:
    """A narrow open ring: its PSF is a ring of the same size.

    Args:
        radius_mm: of the middle of the opening.
        width_mm: of the opening.
        pitch_um: sample spacing.
    """

    radius_mm: float = 0.8
    width_mm: float = 0.02
    pitch_um: float = 4.0

    def build(self, setup: Setup) -> Mask:
        """The mask; it fills the aperture."""
        height, width = (round(1000 * side / self.pitch_um) for side in setup.aperture_mm)
        y, x = torch.meshgrid(
            torch.arange(float(height)) - height // 2, torch.arange(float(width)) - width // 2, indexing="ij"
        )
        away_mm = (torch.hypot(y, x) * self.pitch_um / 1000 - self.radius_mm).abs()
        return Mask("amplitude", (away_mm < self.width_mm / 2).float(), self.pitch_um)


class TestCard(CameraSource):
    """A camera that needs no hardware: a grey wedge that moves by a pixel each frame.

    Args:
        height: rows.
        width: columns.
    """

    __test__ = False  # pytest takes classes of this name for tests
    live = False

    def __init__(self, *, height: int = 120, width: int = 160) -> None:
        super().__init__("test-card")
        self.size, self._number = (height, width), -1

    def open(self) -> None:
        """Start at the first frame."""
        self._number = 0

    def read(self) -> CameraFrame:
        """The next frame, 12 bits."""
        if self._number < 0:
            raise self.not_open()
        height, width = self.size
        row = (np.arange(width) + self._number) % width * 4095 // width
        self._number += 1
        return CameraFrame(array=np.broadcast_to(row, (height, width)).astype(np.uint16)[..., None], bit_depth=12)

    def close(self) -> None:
        """Stop."""
        self._number = -1


TEST_CARD = Kind(TestCard)
"""How mwdn opens it: `test-card,width=320`. A camera with an address has `Kind(Camera, "its serial number")`."""

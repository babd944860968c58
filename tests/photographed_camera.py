"""A simulated camera on the bench: raw frames of a point source, of darkness and of even light."""

from pathlib import Path

import cv2
import numpy as np
import torch

from cameras import contour_psf
from mwdn.optics import Sensor
from mwdn.optics.displacement import shifted

SENSOR = Sensor(full_well=15_000.0, read_noise=3.0, bit_depth=12, black_level=0.01)
STEPS = 2**12 - 1


class Bench:
    """Takes frames with a `mwdn.optics.Sensor` and its hot pixels.

    Args:
        size: height and width of the sensor.
        seed: of the pattern, the hot pixels and the noise.
        hot: number of hot pixels.
        peak: of the PSF in a frame of exposure 1, as a fraction of saturation.
    """

    def __init__(self, size=(128, 160), *, seed=5, hot=20, peak=0.75):
        self.generator = torch.Generator().manual_seed(seed)
        psf = contour_psf(size, cell=20, generator=self.generator)
        y, x = (torch.linspace(-1, 1, n) for n in size)
        halo = torch.exp(-3 * (y[:, None].square() + x.square()))[None, None]
        self.light = peak * (psf / psf.max() + 1e-3 * halo) / 1.001
        pixels = torch.randperm(size[0] * size[1], generator=self.generator)[:hot]
        self.hot = torch.zeros(size[0] * size[1])
        self.hot[pixels] = torch.empty(hot).uniform_(0.01, 0.5, generator=self.generator)
        self.hot = self.hot.reshape(1, 1, *size)

    def frame(self, light, sensor=SENSOR):
        """A raw frame (H, W, C), uint16, of light (1, C, H, W), 1 at saturation."""
        capture = sensor.expose(light + self.hot, generator=self.generator)
        counts = ((capture * (1 - sensor.black_level) + sensor.black_level) * STEPS).round()
        return counts[0].movedim(0, -1).numpy().astype(np.uint16)

    def point(self, exposure=1.0, move=(0, 0)):
        """A frame of the point source."""
        return self.frame(exposure * shifted(self.light, *move))

    def dark(self):
        """A frame without light."""
        return self.frame(torch.zeros_like(self.light))

    def flat(self, level):
        """A frame of even light that falls off towards the corners."""
        y, x = (torch.linspace(-1, 1, n) for n in self.light.shape[-2:])
        return self.frame(level * (1 - 0.15 * (y[:, None].square() + x.square())).expand_as(self.light))


def save(folder, frames, name="frame"):
    """Write frames as 16-bit PNG: name_1.png, name_2.png ..."""
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    paths = [folder / f"{name}_{number}.png" for number in range(1, len(frames) + 1)]
    for path, frame in zip(paths, frames, strict=True):
        assert cv2.imwrite(str(path), frame[..., ::-1])
    return paths

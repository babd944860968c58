"""What a sweep varies."""

import pytest
import torch

from mwdn.benchmark.robustness import noisier
from mwdn.optics import Sensor


@pytest.mark.parametrize("level", [0.05, 0.5])
def test_noise_is_a_multiple_at_every_brightness(level, generator):
    light = torch.full((1, 1, 300, 300), level)
    sensor = Sensor(full_well=4000.0, read_noise=20.0, bit_depth=16)
    usual, more = (s.expose(light, generator=generator).std() for s in (sensor, noisier(sensor, 3.0)))
    # 90,000 pixels: a standard deviation is known to 1 / sqrt(180,000) = 0.24 % of it.
    assert float(more / usual) == pytest.approx(3.0, rel=0.02)

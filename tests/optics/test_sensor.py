"""Photon transfer, saturation and quantisation of the sensor."""

import math

import pytest
import torch

from mwdn.errors import ParameterError
from mwdn.optics import Sensor
from mwdn.optics.sensor import gamma_coded


@pytest.mark.parametrize("signal", [0.0, 0.1, 0.5, 0.8])
@pytest.mark.parametrize(
    "sensor",
    [
        Sensor(full_well=1000.0, read_noise=5.0, bit_depth=12, black_level=0.05),
        Sensor(full_well=1000.0, read_noise=5.0, bit_depth=7, black_level=0.05),
        Sensor(full_well=15_000.0, read_noise=30.0, bit_depth=12, black_level=0.02),
        Sensor(full_well=15_000.0, read_noise=0.0, bit_depth=12, black_level=0.02),
    ],
    ids=["few electrons", "coarse", "deep well", "no read noise"],
)
def test_photon_transfer(sensor, signal, generator):
    """Mean and variance follow the theory of the docstring, within the statistical error of the sample.

    The mean of n samples of variance s^2 has variance s^2 / n. Their sample variance has a relative spread
    of sqrt((2 + k) / n), where k, the excess kurtosis of electrons, is 1 / their number. Five standard
    deviations are allowed: 6e-7 of all draws lie outside.

    Rounding adds step^2 / 12 only to noise that is wider than a step. From 0.6 steps on, the error of that is
    (4 s^2 + 1 / pi^2) exp(-2 pi^2 s^2) < 0.002 step^2. Of less noise only the bounds of rounding are asked.
    """
    n = 200_000
    step = 1 / ((2**sensor.bit_depth - 1) * (1 - sensor.black_level))
    spread = signal / sensor.full_well + (sensor.read_noise / sensor.full_well) ** 2
    if math.sqrt(spread) < 0.6 * step:
        spread_allowed, mean_allowed = step**2 / 4, step / 2
        variance = spread
    else:
        variance = spread + step**2 / 12
        kurtosis = 1 / max(signal * sensor.full_well, 1.0)
        spread_allowed = 5 * variance * math.sqrt((2 + kurtosis) / n) + 0.004 * step**2
        mean_allowed = 5 * math.sqrt(variance / n) + 0.004 * step
    captured = sensor.expose(torch.full((1, 1, 400, 500), signal), generator=generator).double()
    assert abs(captured.mean().item() - signal) <= mean_allowed
    assert abs(captured.var().item() - variance) <= spread_allowed


def test_noise_of_neighbours_is_independent(generator):
    """The correlation of n independent pairs has standard deviation 1 / sqrt(n)."""
    noise = Sensor().expose(torch.full((1, 3, 200, 200), 0.4), generator=generator) - 0.4
    for shift, axis in ((1, -1), (1, -2), (1, 1)):
        product = (noise * noise.roll(shift, axis)).mean() / noise.var()
        assert abs(product.item()) < 5 / math.sqrt(noise.numel())


@pytest.mark.parametrize("black_level", [0.0, 0.01, 0.02, 0.05, 0.1, 0.25, 0.7])
@pytest.mark.parametrize("bit_depth", [1, 8, 10, 12, 14, 16])
def test_saturation_is_exactly_one(bit_depth, black_level, generator):
    sensor = Sensor(bit_depth=bit_depth, black_level=black_level)
    captured = sensor.expose(torch.full((1, 1, 4, 4), 1.5), generator=generator)
    assert captured.unique().tolist() == [1.0]


def test_nothing_exceeds_saturation(generator):
    light = torch.linspace(0, 3, 4000).reshape(1, 1, 40, 100)
    captured = Sensor().expose(light, generator=generator)
    assert captured.max() == 1
    assert (captured[light > 1.1] == 1).all()
    assert (captured[light < 0.9] < 1).all()


@pytest.mark.parametrize("light", [10.0, 1e30, math.inf])
def test_light_far_beyond_saturation_saturates(light, generator):
    assert (Sensor().expose(torch.full((1, 1, 8, 8), light), generator=generator) == 1).all()


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16, torch.float64])
def test_noise_is_that_of_float32_in_every_precision(dtype, generator):
    """float16 ends at 65,504 electrons, and bfloat16 counts them in steps of 512."""
    capture = Sensor(full_well=1e5).expose(torch.full((1, 1, 200, 200), 0.875, dtype=dtype), generator=generator)
    assert capture.dtype == torch.float32
    assert capture.mean().item() == pytest.approx(0.875, abs=1e-4)
    assert capture.std().item() == pytest.approx((0.875 / 1e5) ** 0.5, rel=0.02)


@pytest.mark.usefixtures("unchecked")
def test_a_seed_is_no_generator():
    with pytest.raises(ParameterError, match=r"`generator` \(3\)"):
        Sensor().expose(torch.ones(1, 1, 4, 4), generator=3)


def test_light_that_is_no_number_is_refused():
    with pytest.raises(ParameterError, match="`light` holds NaN"):
        Sensor().expose(torch.full((1, 1, 8, 8), math.nan))


def test_black_level_keeps_the_negative_half_of_the_noise(generator):
    """Dark pixels: half of the noise is below zero, down to -black / (1 - black), and the mean is zero."""
    dark = torch.zeros(1, 1, 300, 300)
    noisy = {"full_well": 1000.0, "read_noise": 10.0, "bit_depth": 12}
    kept = Sensor(black_level=0.1, **noisy).expose(dark, generator=generator)
    cut = Sensor(black_level=0.0, **noisy).expose(dark, generator=generator)
    assert 0.48 < (kept < 0).float().mean() < 0.52
    assert kept.mean().abs() < 5 * 0.01 / 300
    assert kept.min() >= -0.1 / 0.9
    assert cut.min() == 0
    # The mean of the positive half of a normal distribution is sigma / sqrt(2 pi): the bias of a cut black.
    assert abs(cut.mean().item() - 0.01 / math.sqrt(2 * math.pi)) < 2e-4


@pytest.mark.parametrize("bit_depth", [1, 3, 8, 10])
@pytest.mark.parametrize("black_level", [0.0, 0.04])
def test_quantisation_has_all_steps_of_the_converter(bit_depth, black_level, generator):
    sensor = Sensor(full_well=1e5, read_noise=100.0, bit_depth=bit_depth, black_level=black_level)
    light = torch.linspace(0, 1.01, 200 * 500).reshape(1, 1, 200, 500)
    captured = sensor.expose(light, generator=generator).double()
    counts = (captured * (1 - black_level) + black_level) * (2**bit_depth - 1)
    assert (counts - counts.round()).abs().max() < 1e-3
    assert counts.round().min() >= 0
    assert counts.round().max() == 2**bit_depth - 1
    reached = counts.round().unique().numel()
    # Dark pixels read the black level: with one, a few steps below it stay unused.
    assert reached <= 2**bit_depth
    assert reached >= (2**bit_depth if black_level == 0 else 0.95 * 2**bit_depth)


def test_light_is_left_as_it_was_and_negative_light_is_dark(generator):
    light = torch.tensor([-1.0, -1e-7, 0.0, 0.5]).reshape(1, 1, 2, 2)
    before = light.clone()
    captured = Sensor().expose(light, generator=generator)
    assert torch.equal(light, before)
    assert captured.flatten()[:3].abs().max() < 0.005


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"full_well": 0.0}, r"`full_well` \(0.0\) must be positive"),
        ({"full_well": -3.0}, "`full_well`"),
        ({"full_well": math.nan}, "`full_well`"),
        ({"read_noise": -0.1}, r"`read_noise` \(-0.1\) must not be negative"),
        ({"read_noise": math.nan}, "`read_noise`"),
        ({"bit_depth": 0}, r"`bit_depth` \(0\) must be 1 to 16"),
        ({"bit_depth": 17}, "`bit_depth`"),
        ({"black_level": 1.0}, r"`black_level` \(1.0\) must be in \[0, 1\)"),
        ({"black_level": -0.01}, "`black_level`"),
        ({"black_level": math.nan}, "`black_level`"),
    ],
)
def test_impossible_sensors_are_refused(options, message):
    with pytest.raises(ParameterError, match=message):
        Sensor(**options)


def test_right_gamma_leaves_the_rounding_and_a_wrong_one_a_power():
    """Half a step of 8 bits is worth 2.2 / 510 v^(1 - 1 / 2.2) of light; darkness below 0 and light above 1 are cut."""
    light = torch.linspace(-0.1, 1.1, 1201)[None, None, None]
    inside = light.clamp(0, 1)
    error = (gamma_coded(light, 2.2, 2.2) - inside).abs()
    bound = 2.2 / 510 * inside ** (1 - 1 / 2.2)
    assert (error <= 1.1 * bound + 1e-5).all()  # to first order; more at the darkest levels
    assert error.max() > 0.8 * 2.2 / 510  # it is rounded
    wrong = gamma_coded(light, 2.2, 2.42, bit_depth=16)
    torch.testing.assert_close(wrong, inside**1.1, rtol=0, atol=1e-4)

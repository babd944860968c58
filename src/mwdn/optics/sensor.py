"""Image sensor: shot noise, read noise, black level, saturation, quantisation; gamma-coded files."""

from dataclasses import dataclass, replace

import torch

from mwdn.arguments import check_batch, checked
from mwdn.errors import ParameterError, ShapeError
from mwdn.types import Image, Size, size_of


@checked
@dataclass(frozen=True)
class Sensor:
    """A linear image sensor.

    Args:
        full_well: electrons at saturation. The best signal-to-noise ratio of a pixel is its square root (shot noise).
        read_noise: standard deviation in electrons, of every pixel and frame.
        bit_depth: bits of the analogue-to-digital converter.
        black_level: mean reading of a dark pixel, as a fraction of the full scale; so that the noise of dark pixels is
            not clipped at zero.

    Raises:
        ParameterError: a number is out of its range.

    References:
        J. R. Janesick, Photon Transfer (SPIE, 2007): the variance of a measurement in units of the full scale is
        ``signal / full_well + (read_noise / full_well)^2 + quantisation_step^2 / 12``.
    """

    full_well: float = 15_000.0
    read_noise: float = 3.0
    bit_depth: int = 12
    black_level: float = 0.01

    def __post_init__(self) -> None:
        if not self.full_well > 0:
            raise ParameterError(f"`full_well` ({self.full_well}) must be positive: electrons at saturation.")
        if not self.read_noise >= 0:
            raise ParameterError(f"`read_noise` ({self.read_noise}) must not be negative: it is in electrons.")
        if not 1 <= self.bit_depth <= 16:
            raise ParameterError(f"`bit_depth` ({self.bit_depth}) must be 1 to 16.")
        if not 0 <= self.black_level < 1:
            raise ParameterError(f"`black_level` ({self.black_level}) must be in [0, 1): a fraction of the full scale.")

    def binned(self, side: int) -> "Sensor":
        """The sensor of pixels that sum side x side of this one's: n of them hold n times the electrons."""
        n = side**2
        return replace(self, full_well=n * self.full_well, read_noise=n**0.5 * self.read_noise)

    @checked
    def expose(self, light: Image, *, generator: torch.Generator | None = None) -> Image:
        """One capture of the light on the sensor. Its gradient is zero: counts are whole numbers.

        Args:
            light: (B, C, H, W); 1 saturates a pixel.
            generator: source of the noise, on the device of the light.

        Returns:
            Same shape, float32. The black level is subtracted and saturation is 1; noise makes dark pixels negative.

        Raises:
            ParameterError: the light holds NaN (not checked on a GPU), or is no tensor of floats; or the generator is
                something else, such as a seed.
            ShapeError: other axes.
        """
        check_batch(light, "light")
        # Beyond 2^63 electrons, torch's Poisson numbers overflow to darkness; a light of 1e6 saturates as any other.
        light = light.float().clamp(0, 1e6)
        try:
            electrons = torch.poisson(light * self.full_well, generator=generator)
        except RuntimeError as error:
            if not light.isnan().any():
                raise
            raise ParameterError("`light` holds NaN. Replace it: `torch.nan_to_num(light)`.") from error
        electrons += self.read_noise * torch.randn(
            light.shape, generator=generator, device=light.device, dtype=light.dtype
        )
        span = 1 - self.black_level
        steps = 2**self.bit_depth - 1
        counts = ((electrons / self.full_well * span + self.black_level) * steps).round().clamp(0, steps)
        return (counts / steps - self.black_level) / span


def check_sensor_size(measurement: Image, size: Size) -> None:
    """Check that a measurement is a batch of a camera's sensor size.

    Raises:
        ShapeError: it is not.
        ParameterError: it is no tensor of floats.
    """
    check_batch(measurement, "measurement")
    if size_of(measurement) != tuple(size):
        raise ShapeError(
            f"`measurement` {tuple(measurement.shape)} must have the camera's sensor size {tuple(size)}. For another "
            "sensor, make the camera with `size=(height, width)`."
        )


def gamma_coded(capture: Image, gamma: float, decoded: float, *, bit_depth: int = 8) -> Image:
    """Store a capture as a gamma-coded file and read it again.

    A pixel of light v in [0, 1] is stored as v^(1 / gamma), rounded to a step of the file, and read as its power of
    ``decoded``. With the right gamma only the rounding error remains: for half a step s,
    ``s gamma v^(1 - 1 / gamma) / 2``. With a wrong gamma, light v becomes ``v^(decoded / gamma)``.

    Args:
        capture: (B, C, H, W); below 0 and above 1 it is clipped.
        gamma: of the file.
        decoded: the gamma that the reader assumes.
        bit_depth: of the file.
    """
    steps = 2**bit_depth - 1
    return ((capture.clamp(0, 1) ** (1 / gamma) * steps).round() / steps) ** decoded

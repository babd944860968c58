"""Levels of the coarse-to-fine ADMM, and how its total variation follows the noise of a measurement."""

from dataclasses import dataclass

from torch import Tensor

from mwdn.optics.noise import noise_level
from mwdn.solvers.splitting import Penalties
from mwdn.types import TINY, Measurement


@dataclass(frozen=True)
class Level:
    """One size of the pyramid: ADMM that starts with zero multipliers.

    Args:
        downsampling: side of the level's pixels, in pixels of the measurement; a power of two.
        iterations: of ADMM.
        penalties: mu of the data, the gradient and the sign.
        regularisation: tau, weight of the total variation; 0 for none, whatever the gradient's mu. Both tau and the
            gradient's mu are multiplied by `smoothing_scale`.
        min_smoothing: lower limit of `smoothing_scale`. In real captures the errors of the PSF exceed the noise.
        relaxation: alpha of the over-relaxation (`mwdn.solvers.splitting`), 1 to 2.
        lit: whether the level starts at even light in the frame (`mwdn.solvers.pyramid.even_start`). Otherwise it
            starts at the coarser level's scene, and the coarsest level at black.
    """

    downsampling: int
    iterations: int
    penalties: Penalties
    regularisation: float = 0.0
    min_smoothing: float = 1.0
    relaxation: float = 1.0
    lit: bool = False

    def smoothing(self, smoothing_scale: Tensor) -> tuple[Penalties, Tensor]:
        """Penalties mu and weight tau for the noise of each sample."""
        mu, smoothing_scale = self.penalties, smoothing_scale.clamp(min=self.min_smoothing)
        return mu._replace(gradient=mu.gradient * smoothing_scale), smoothing_scale * self.regularisation


LEVELS = (
    Level(8, 80, Penalties(0.015, 0.4, 0.06), 0.01, relaxation=1.7),
    Level(4, 60, Penalties(0.05, 1.3, 0.2), 0.01, relaxation=1.7),
    Level(2, 12, Penalties(0.2, 4.0, 0.9), 0.01, relaxation=1.7),
    Level(1, 12, Penalties(0.1, 1.5, 1.5), 0.01, relaxation=1.7),
)
"""The coarse levels decide how the light is shared between the scene in the frame and around it. They need small
penalties and many iterations, which cost little there: 20 each, with penalties ten times as large, leave a photograph
that fills the frame dark at its edges, 1 to 5 dB worse. Over-relaxation brings such photographs 0.2 to 1.3 dB more,
with a third fewer iterations at full size."""

COARSE_LEVELS = (
    Level(8, 18, Penalties(0.05, 2.0, 0.12), 0.005, relaxation=1.85, lit=True),
    Level(4, 11, Penalties(0.3, 0.0, 0.5), relaxation=1.75),
    Level(2, 8, Penalties(0.2, 0.0, 0.9)),
)
"""Levels of a network whose bank restores the detail (`mwdn.networks.wiener_bank`). Total variation at the coarsest
decides how the light is shared between the scene in the frame and around it, which takes many iterations where
photographs fill the frame: 18 from even light are better than 40 from black. Twice this tau loses 0.5 dB there in low
light. The other levels have no total variation, which saves time. At half the size over-relaxation loses 0.2 to 0.7
dB."""

REFERENCE_NOISE = 0.009
"""Noise over the root mean square of the measurement for which the tau of `LEVELS` are stated. They grow with the noise
to the power 1.25, which is within 0.2 dB of the best of eight tau, on the mean of 64 captures through four measured
PSFs and 53 through random ones."""

REFERENCE_SIDE = 320
"""Side of the measurement in pixels for which tau is stated. Tau grows with the side: the same scene in finer pixels
changes less from pixel to pixel. `admm` does the same by scaling the whole measurement to a norm of 1."""


def pyramid_levels(finest: int) -> tuple[Level, ...]:
    """Levels of the iterations from the coarsest to a downsampling of ``finest``; none for 0."""
    levels = LEVELS if finest == 1 else COARSE_LEVELS
    return tuple(level for level in levels if finest and level.downsampling >= finest)


def root_mean_square(measurement: Measurement) -> Tensor:
    """Root mean square of each sample, (B, 1, 1, 1); never 0."""
    square = measurement.float().square().mean((1, 2, 3), keepdim=True)
    return square.sqrt().clamp(min=TINY)


def relative_noise(measurement: Measurement) -> Tensor:
    """Standard deviation of each sample's noise over its `root_mean_square`, (B, 1, 1, 1)."""
    b = measurement.detach().float()
    return noise_level(b / root_mean_square(b)).square().mean(1, keepdim=True).sqrt()


def smoothing_scale(noise: Tensor) -> Tensor:
    """Factor on tau for a `relative_noise`, see `REFERENCE_NOISE`."""
    return (noise / REFERENCE_NOISE) ** 1.25

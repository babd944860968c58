"""Le-ADMM: unrolled ADMM with learned penalties and thresholds."""

import math

import torch
from torch import Tensor, nn

from mwdn.arguments import check_at_least
from mwdn.errors import ParameterError
from mwdn.fourier.transforms import fast_length, transfer_function
from mwdn.networks.network import Network
from mwdn.networks.wiener_filter import check_size, unit_psf
from mwdn.solvers.proximal import Variation
from mwdn.solvers.splitting import Penalties, Problem, initial_state, make_filters, rescale, update_copies, update_scene
from mwdn.types import TINY, Measurement, Psf, Scene, Size, Transfer


class LeAdmm(Network[Tensor]):
    """Unrolled ADMM with total variation; each iteration learns mu1, mu2, mu3 and tau. 20 learnable parameters.

    From the source: five iterations from a zero scene; a grey PSF, the sum of the colours at unit L2 norm, shared by
    all colours; a grid of twice the sensor; mu initialised at 1e-4; the result is divided by its maximum, so absolute
    brightness is lost. The paper's gradient threshold is tau / mu2. As in the source's code, this ratio is learned as
    one number, initialised at 2e-4 (1000 times as much in its notebook); the family of iterations is the same.

    Different here:

    - The measurement is divided by its maximum, as the source's data are, so initial values fit every exposure.
    - All constants are stored as logarithms, which keeps them positive.
    - The PSF's background is not subtracted: calibration has done so.
    - tau can be trained. The source's gradient is infinite where the scene's gradient is zero, which is everywhere in
      the first iteration; that of `mwdn.solvers.proximal.dual_projection` is finite.

    Args:
        iterations: number of iterations; each adds 4 learnable parameters.
        penalty: initial value of mu1, mu2 and mu3.
        threshold: initial value of tau / mu2, in brightness of the scene for a PSF of unit L2 norm.
        variation: kind of total variation, see `mwdn.solvers.proximal.Variation`; the source's is isotropic.

    Raises:
        ParameterError: an initial value is not positive, or ``iterations`` is below 1.

    References:
        K. Monakhova et al., Learned reconstructions for practical mask-based lensless imaging, Optics Express 27,
        28075 (2019); github.com/Waller-Lab/LenslessLearning.
    """

    def __init__(
        self,
        *,
        iterations: int = 5,
        penalty: float = 1e-4,
        threshold: float = 2e-4,
        variation: Variation = "isotropic",
    ) -> None:
        super().__init__()
        check_at_least(1, iterations=iterations)
        for name, value in (("penalty", penalty), ("threshold", threshold)):
            if not value > 0:
                raise ParameterError(f"`{name}` ({value}) must be positive: its logarithm is learned.")
        self.variation = variation
        self.log_data, self.log_gradient, self.log_sign = (
            nn.Parameter(torch.full((iterations,), math.log(penalty))) for _ in range(3)
        )
        self.log_threshold = nn.Parameter(torch.full((iterations,), math.log(threshold)))

    def prepare(self, psf: Psf, size: Size) -> Transfer:
        """Transfer function (B, 1, ...) of the grey PSF at unit L2 norm, on a grid of twice the sensor."""
        check_size(psf, size)
        grey = unit_psf(psf).float().sum(1, keepdim=True)
        grey = grey / torch.linalg.vector_norm(grey, dim=(1, 2, 3), keepdim=True)
        return transfer_function(grey, (fast_length(2 * size[0]), fast_length(2 * size[1])))

    def reconstruct(self, measurement: Measurement, prepared: Transfer) -> Scene:
        """Scene (B, C, H, W) with maximum 1."""
        return divide_by_maximum(self.iterates(measurement, prepared)[-1])

    def iterates(self, measurement: Measurement, prepared: Transfer) -> list[Tensor]:
        """Scene (B, C, H, W) after each iteration, for a measurement of peak 1 and a PSF of unit L2 norm.

        Pixels can be negative, as in any ADMM before convergence.
        """
        problem = Problem.from_transfer(divide_by_maximum(measurement.float()), prepared)
        height, width = problem.sensor
        state, scenes, previous = initial_state(problem), [], None
        constants = (self.log_data, self.log_gradient, self.log_sign, self.log_threshold)
        for data, gradient, sign, threshold in zip(*(logarithm.exp() for logarithm in constants), strict=True):
            mu = Penalties(data, gradient, sign)
            if previous is not None:
                state = rescale(state, previous, mu)
            state = update_copies(state, problem, mu, threshold * gradient, self.variation)
            state = update_scene(state, problem, make_filters(problem, mu))
            previous = mu
            scenes.append(state.v[..., :height, :width])
        return scenes


def divide_by_maximum(picture: Tensor) -> Tensor:
    """Divide each picture by its largest value."""
    return picture / picture.amax((1, 2, 3), keepdim=True).clamp(min=TINY)

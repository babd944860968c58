"""Wiener deconvolution that chooses its regularisation from the noise of the measurement."""

from dataclasses import dataclass

import torch
from torch import Tensor

from mwdn.arguments import checked
from mwdn.errors import ParameterError
from mwdn.fourier.convolution import check_fit
from mwdn.fourier.padding import Boundary, pad
from mwdn.fourier.transforms import column_counts, inverse_spectrum, spectrum, transfer_function
from mwdn.fourier.wiener import deconvolution_grid
from mwdn.optics.noise import noise_level
from mwdn.optics.psf import checked_psf
from mwdn.types import TINY, Measurement, Psf, Scene, size_of


@checked
@dataclass(frozen=True)
class Wiener:
    """Wiener deconvolution, eq. (2) of the paper, with lambda given or chosen.

    Called with a measurement (B, C, H, W) and a PSF, it returns the scene (B, C, H, W), not negative.

    Args:
        regularisation: lambda for a PSF of unit sum. ``None`` chooses it for each channel of each sample by the
            discrepancy principle: the largest with which the scene, blurred again, still fits the measurement to
            within its noise and ``tolerance``.
        tolerance: part of the measurement's contrast that may remain as residual besides the noise: the error of a
            cropped pattern, a measured PSF and a field that is not quite shift-invariant.
        boundary: values beyond the border of what is filtered, see `mwdn.fourier.padding.Boundary`.

    Raises:
        ParameterError: a constant is not positive.

    References:
        V. A. Morozov, Soviet Mathematics Doklady 7, 414 (1966), for the discrepancy principle.
    """

    regularisation: float | None = None
    tolerance: float = 0.03
    boundary: Boundary = "taper"

    def __post_init__(self) -> None:
        for name, value in (("regularisation", self.regularisation), ("tolerance", self.tolerance)):
            if value is not None and not value > 0:
                raise ParameterError(f"`{name}` ({value}) must be positive.")

    @torch.no_grad()
    def __call__(self, measurement: Measurement, psf: Psf) -> Scene:
        """Reconstruct a batch."""
        check_fit(measurement, psf, "measurement")
        psf = checked_psf(psf).float()
        size = size_of(measurement)
        grid = deconvolution_grid(size, self.boundary)
        total = psf.sum((-2, -1), keepdim=True)
        H = transfer_function(psf / total, grid)
        B = spectrum(pad(measurement.float(), grid, self.boundary), grid)
        regularisation = self.regularisation or self.discrepancy(measurement, B, H, grid[1])
        V = H.conj() * B / (H.abs().square() + regularisation)
        return (inverse_spectrum(V, grid, size) / total).clamp(min=0)

    def discrepancy(self, measurement: Measurement, B: Tensor, H: Tensor, width: int) -> Tensor:
        """Lambda (B, C, 1, 1) whose residual has the power of the noise and the tolerance.

        In the Fourier domain the residual is ``B lambda / (|H|^2 + lambda)``. It grows with lambda, so lambda is found
        by forty bisections of log10 lambda between -16 and 1.

        Args:
            measurement: (B, C, H, W).
            B: half spectrum of the padded measurement.
            H: transfer function for a PSF of unit sum.
            width: of the grid.
        """
        # In units of the contrast, so that no square leaves the range of float32.
        contrast = measurement.float().std((-2, -1), correction=0, keepdim=True)
        contrast = contrast.clamp(min=TINY)
        allowed = (noise_level(measurement) / contrast).square() + self.tolerance**2
        # Parseval: sum |B|^2 = pixels x variance. The mean is left out.
        count = column_counts(width, device=B.device).repeat(B.shape[-2], 1)
        count[0, 0] = 0
        power, filtered = (B.abs() / contrast).square() * count, H.abs().square()
        target = allowed * power.sum((-2, -1), keepdim=True)
        low, high = torch.full_like(target, -16.0), torch.full_like(target, 1.0)
        for _ in range(40):
            middle = (low + high) / 2
            regularisation = 10**middle
            residual = (power * (regularisation / (filtered + regularisation)).square()).sum((-2, -1), keepdim=True)
            fits = residual < target
            low, high = torch.where(fits, middle, low), torch.where(fits, high, middle)
        return 10**high

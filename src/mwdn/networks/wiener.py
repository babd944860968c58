"""A single learned Wiener filter (section 3.2.3 of the paper)."""

from torch import Tensor, nn

from mwdn.fourier.padding import Boundary
from mwdn.networks.blocks import Wiener, peak_one
from mwdn.types import Measurement, Psf, Scene


class WienerNetwork(nn.Module):
    """Pure physics: eq. (2) with a learned weight w and regularisation lambda. 2 learnable numbers.

    Args:
        weight: start value of w, for a PSF whose peak is 1.
        regularisation: start value of lambda.
        boundary: see `mwdn.fourier.padding.Boundary`.
    """

    def __init__(self, *, weight: float = 1e-3, regularisation: float = 1e-2, boundary: Boundary = "taper") -> None:
        super().__init__()
        self.filter = Wiener(weight=weight, regularisation=regularisation, boundary=boundary)

    def forward(self, measurement: Measurement, psf: Psf) -> Scene:
        """Scene (B, C, H, W), each colour deconvolved with its own PSF."""
        return self.reconstruct(measurement, self.bind(psf, measurement))

    def bind(self, psf: Psf, measurement: Measurement) -> list[Tensor]:
        """Transfer function of the filter: all that the network needs of the PSF."""
        return [self.filter.known(peak_one(psf, measurement))]

    def reconstruct(self, measurement: Measurement, bound: list[Tensor]) -> Scene:
        """The same as `forward`, from what `bind` gave."""
        return self.filter.filtered(measurement, *bound)

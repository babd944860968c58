"""A single learned Wiener filter (section 3.2.3 of the paper)."""

from torch import Tensor

from mwdn.fourier.padding import Boundary
from mwdn.networks.network import Network
from mwdn.networks.wiener_filter import WienerFilter, normalise_psf
from mwdn.types import Measurement, Psf, Scene, Size


class WienerNetwork(Network[Tensor]):
    """Wiener filter, eq. (2), with a learned weight w and regularisation lambda. 2 learnable parameters.

    Args:
        weight: initial value of w, for a PSF whose peak is 1.
        regularisation: initial value of lambda.
        boundary: values beyond the border of what is filtered, see `mwdn.fourier.padding.Boundary`.
        authors_form: the authors' form of w and lambda, see `mwdn.networks.Mwdn`.
    """

    def __init__(
        self,
        *,
        weight: float = 1e-3,
        regularisation: float = 1e-2,
        boundary: Boundary = "taper",
        authors_form: bool = False,
    ) -> None:
        super().__init__()
        self.stored_psf = authors_form
        self.filter = WienerFilter(weight=weight, regularisation=regularisation, boundary=boundary, linear=authors_form)

    def prepare(self, psf: Psf, size: Size) -> Tensor:
        """Transfer function of the filter."""
        return self.filter.prepare(normalise_psf(psf, size, stored=self.stored_psf))

    def reconstruct(self, measurement: Measurement, prepared: Tensor) -> Scene:
        """Scene (B, C, H, W), each colour deconvolved with its own PSF."""
        return self.filter.deconvolve(measurement, prepared)

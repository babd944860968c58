"""FlatNet for masks of any kind: a learnable inverse filter, then a U-Net."""

import math

import torch
from torch import Tensor, nn

from mwdn.errors import ParameterError
from mwdn.fourier.padding import Boundary, pad
from mwdn.fourier.transforms import inverse_spectrum, spectrum, transfer_function
from mwdn.fourier.wiener import deconvolution_grid
from mwdn.networks.blocks import check_channels, peak_one_in_colour, resized
from mwdn.networks.generator import Generator
from mwdn.networks.network import Network
from mwdn.types import Measurement, Psf, Scene, Size, Transfer


class FlatNet(Network[Tensor]):
    """FlatNet-gen without its adversarial part: deconvolve with a filter that is learned tap by tap, then denoise.

    From the source: an inverse filter as large as the PSF, which begins as the Wiener filter of the measured PSF and
    which all colours share; the measurement continued by its border before; a U-Net with GroupNorm of 8 groups over
    blocks of 2 x 2 pixels, of 128 to 1,024 channels; an output of limited range. The separable masks of FlatNet-sep,
    and the discriminator, are left out.

    Different here: what is learned is the filter's difference from the Wiener filter of the measured PSF, which is an
    input. The differences belong to one size of sensor, ``size``, and are stretched to any other. Inferred: the
    U-Net is built of this package's blocks (max-pooling and bilinear up-sampling, where the code has strides and
    sub-pixel convolutions), and the range, [0, 1], is kept by a sigmoid. 34,669,260 learnable numbers, of which 129,600
    are the filter's at 270 x 480; a count that no source gives.

    Args:
        channels: colours of the measurement.
        width: feature channels at the U-Net's finest scale.
        size: height and width of the sensor whose filter is learned; ``None`` keeps the Wiener filter.
        regularisation: lambda of the Wiener filter that it begins as, for a PSF of unit sum.
        boundary: what stands beyond the measurement, see `mwdn.fourier.padding.Boundary`.

    References:
        S. S. Khan et al., FlatNet: towards photorealistic scene reconstruction from lensless measurements, IEEE Trans.
        Pattern Anal. Mach. Intell. 44, 1934 (2020); github.com/siddiquesalman/flatnet.
    """

    def __init__(
        self,
        *,
        channels: int = 3,
        width: int = 128,
        size: Size | None = (270, 480),
        regularisation: float = 1e-3,
        boundary: Boundary = "replicate",
    ) -> None:
        super().__init__()
        if not regularisation > 0:
            raise ParameterError(f"`regularisation` ({regularisation}) must be positive; try 1e-3.")
        self.channels, self.regularisation, self.boundary = channels, regularisation, boundary
        self.correction = None if size is None else nn.Parameter(torch.zeros(1, 1, *size))
        self.generator = Generator(channels, channels, width=width)

    def prepare(self, psf: Psf, size: Size) -> Transfer:
        """Transfer function of the learned filter."""
        psf = peak_one_in_colour(psf, size, self.channels)
        grid = deconvolution_grid(size, self.boundary)
        H = transfer_function(psf / psf.sum((-2, -1), keepdim=True), grid)
        W = H.conj() / (H.abs().square() + self.regularisation)
        if self.correction is not None:
            # All N taps moved by s together move W by N s at frequency 0, where it is about 1. Learned in units of
            # 1 / sqrt(N), a step of 3e-4 is at most 3e-4 sqrt(129,600) = 0.1 there, and 3e-4 where signs are random.
            # (The source gives the filter a rate a millionth of the U-Net's.) At N' pixels taps are N / N' as large.
            taps = resized(self.correction, size) * (math.sqrt(self.correction.numel()) / (size[0] * size[1]))
            W = W + transfer_function(taps, grid)
        return W

    def inverse(self, measurement: Measurement, prepared: Transfer) -> Tensor:
        """The measurement (B, C, H, W) through the learned filter."""
        size = measurement.shape[-2], measurement.shape[-1]
        grid = deconvolution_grid(size, self.boundary)
        B = spectrum(pad(measurement.float(), grid, self.boundary), grid)
        return inverse_spectrum(prepared * B, grid, size)

    def reconstruct(self, measurement: Measurement, prepared: Transfer) -> Scene:
        """Scene (B, C, H, W), between 0 and 1."""
        check_channels(measurement, self.channels)
        return torch.sigmoid(self.generator(self.inverse(measurement, prepared)).float())

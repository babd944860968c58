"""FlatNet for arbitrary masks: a learned inverse filter, then a U-Net."""

import math

import torch
from torch import Tensor, nn

from mwdn.errors import ParameterError
from mwdn.fourier.filtering import filter_image
from mwdn.fourier.padding import Boundary
from mwdn.fourier.transforms import transfer_function
from mwdn.fourier.wiener import deconvolution_grid, wiener_transfer
from mwdn.networks.blocks import check_channels, resize
from mwdn.networks.flatnet_unet import FlatNetUNet
from mwdn.networks.network import Network
from mwdn.networks.wiener_filter import normalise_psf
from mwdn.optics.psf import unit_sum
from mwdn.types import Measurement, Psf, Scene, Size, Transfer, size_of


class FlatNet(Network[Tensor]):
    """FlatNet-gen without adversarial training: an inverse filter with learned taps, then a U-Net.

    34,669,260 learnable parameters; 129,600 of them are the filter's at 270 x 480. No source gives a count.

    From the source: an inverse filter of the PSF's size, initialised as the Wiener filter of the measured PSF and
    shared by all colours; replicate padding of the measurement; a U-Net with GroupNorm of 8 groups on 2 x 2
    pixel-unshuffled input, 128 to 1,024 channels; an output of limited range.

    Left out: the separable masks of FlatNet-sep, and the discriminator.

    Different here: the learned taps are a correction of the measured PSF's Wiener filter; the PSF is an input. The
    correction is stored for one sensor size, ``size``, and resampled to any other.

    Inferred: the U-Net has this package's blocks (max-pooling and bilinear upsampling; the code has strides and
    sub-pixel convolutions), and a sigmoid limits the range to [0, 1].

    Args:
        channels: colours of the measurement.
        width: feature channels at the U-Net's finest scale.
        size: height and width for which the correction is stored; ``None`` for a plain Wiener filter.
        regularisation: lambda of the Wiener filter, for a PSF of unit sum.
        boundary: values beyond the border of what is filtered, see `mwdn.fourier.padding.Boundary`.

    References:
        S. S. Khan et al., FlatNet: towards photorealistic scene reconstruction from lensless measurements, IEEE Trans.
        Pattern Anal. Mach. Intell. 44, 1934 (2022); github.com/siddiquesalman/flatnet.
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
        self.generator = FlatNetUNet(channels, channels, width=width)

    def prepare(self, psf: Psf, size: Size) -> Transfer:
        """Transfer function of the learned filter."""
        psf = normalise_psf(psf, size, self.channels)
        grid = deconvolution_grid(size, self.boundary)
        W = wiener_transfer(unit_sum(psf), self.regularisation, grid)
        if self.correction is not None:
            # A step of 3e-4 in all N = 129,600 taps changes W by at most 3e-4 sqrt(N) = 0.1 at frequency 0, where W is
            # about 1. Without the unit 1 / sqrt(N) it would be 3e-4 N = 39. (The source's learning rate for the filter
            # is 1e-6 of the U-Net's.) At N' pixels taps scale by N / N'.
            taps = resize(self.correction, size) * (math.sqrt(self.correction.numel()) / (size[0] * size[1]))
            W = W + transfer_function(taps, grid)
        return W

    def inverse(self, measurement: Measurement, prepared: Transfer) -> Tensor:
        """Measurement (B, C, H, W) deconvolved with the learned filter."""
        size = size_of(measurement)
        return filter_image(measurement.float(), prepared, deconvolution_grid(size, self.boundary), self.boundary)

    def reconstruct(self, measurement: Measurement, prepared: Transfer) -> Scene:
        """Scene (B, C, H, W), between 0 and 1."""
        check_channels(measurement, self.channels)
        return torch.sigmoid(self.generator(self.inverse(measurement, prepared)).float())

"""Deconvolution with a PSF that varies over the field, the first stage of PhoCoLens."""

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
from mwdn.types import Measurement, Psf, Scene, Size


def field_weights(side: int, size: Size, device: torch.device) -> Tensor:
    """How much each of ``side`` x ``side`` places of the field counts at each pixel, (side^2, H, W); they sum to 1.

    In inverse proportion to the distance, as a part of the field, from the middle of the place's tile.
    """
    middles = (torch.arange(side, device=device) + 0.5) / side
    rows, columns = ((torch.arange(n, device=device) + 0.5) / n for n in size)
    down = (rows - middles[:, None]).square()[:, None, :, None]
    along = (columns - middles[:, None]).square()[None, :, None, :]
    # A thousandth of the field: at the middle itself its own estimate counts all but alone.
    weights = 1 / ((down + along).sqrt() + 1e-3)
    return (weights / weights.sum((0, 1))).flatten(0, 1)


class SvDeconv(Network[Tensor]):
    """Wiener filters with a 3 x 3 field of learned PSFs, blended over the picture, then a U-Net.

    From the source: K x K PSFs and one more for all of the field, each beginning as the measured one, each with its own
    learned lambda; every one deconvolves the whole measurement, continued by its border; the K x K estimates are
    blended in inverse proportion to the distance from where each belongs; blend and single estimate go into the U-Net
    of FlatNet; no adversarial part. PSFs are shared by the colours.

    Different here: learned is each PSF's difference from the measured one, which is an input, in units of its peak. The
    differences belong to one size of sensor, ``size``, and are stretched to any other. Left out: the U-Net that the
    code can put before the filters, and the diffusion model that is the second stage. Inferred: the U-Net's parts, see
    `mwdn.networks.flatnet.FlatNet`; lambda starts at 1e-3 for a PSF of unit sum (the code's 100 has other units); the
    output is a sigmoid's. 35,849,494 learnable numbers, of which 1,296,000 are the PSFs' at 270 x 480; a count that no
    source gives.

    Args:
        channels: colours of the measurement.
        width: feature channels at the U-Net's finest scale.
        field: K, places along each side of the field.
        size: height and width of the sensor whose PSFs are learned.
        regularisation: start value of each lambda.
        boundary: what stands beyond the measurement, see `mwdn.fourier.padding.Boundary`.

    References:
        X. Cai et al., PhoCoLens: photorealistic and consistent reconstruction in lensless imaging, NeurIPS (2024);
        github.com/OpenImagingLab/PhoCoLens.
    """

    def __init__(
        self,
        *,
        channels: int = 3,
        width: int = 128,
        field: int = 3,
        size: Size = (270, 480),
        regularisation: float = 1e-3,
        boundary: Boundary = "replicate",
    ) -> None:
        super().__init__()
        if field < 1 or not regularisation > 0:
            raise ParameterError(f"`field` ({field}) must be at least 1, `regularisation` ({regularisation}) positive.")
        self.channels, self.field, self.boundary = channels, field, boundary
        self.correction = nn.Parameter(torch.zeros(1, field**2 + 1, *size))
        self.log_regularisation = nn.Parameter(torch.full((field**2 + 1,), math.log(regularisation)))
        self.generator = Generator(2 * channels, channels, width=width)

    def prepare(self, psf: Psf, size: Size) -> Tensor:
        """The PSF at peak 1, one for each colour. Transfer functions are not kept: K^2 + 1 of them would be needed."""
        return peak_one_in_colour(psf, size, self.channels)

    def deconvolve(self, measurement: Measurement, prepared: Tensor) -> tuple[Tensor, Tensor]:
        """Estimates (B, C, H, W) by the PSF for the whole field, and by the field of PSFs.

        Raises:
            ShapeError: the measurement has other channels than the network.
        """
        check_channels(measurement, self.channels)
        total = prepared.sum((-2, -1), keepdim=True)
        size = measurement.shape[-2], measurement.shape[-1]
        grid = deconvolution_grid(size, self.boundary)
        B = spectrum(pad(measurement.float(), grid, self.boundary), grid)
        corrections = torch.split(resized(self.correction, size), 1, dim=1)
        estimates = []
        for correction, regularisation in zip(corrections, self.log_regularisation.exp(), strict=True):
            H = transfer_function((prepared + correction) / total, grid)
            estimates.append(inverse_spectrum(H.conj() * B / (H.abs().square() + regularisation), grid, size))
        single, *places = estimates
        weights = field_weights(self.field, size, measurement.device)
        return single, sum((weight * place for weight, place in zip(weights, places, strict=True)), start=0 * single)

    def reconstruct(self, measurement: Measurement, prepared: Tensor) -> Scene:
        """Scene (B, C, H, W), between 0 and 1."""
        return torch.sigmoid(self.generator(torch.cat(self.deconvolve(measurement, prepared), dim=1)).float())

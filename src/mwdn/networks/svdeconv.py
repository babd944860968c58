"""SVDeconv: deconvolution with a spatially varying PSF, the first stage of PhoCoLens."""

import math

import torch
from torch import Tensor, nn

from mwdn.errors import ParameterError
from mwdn.fourier.padding import Boundary, pad
from mwdn.fourier.transforms import inverse_spectrum, spectrum, transfer_function
from mwdn.fourier.wiener import deconvolution_grid
from mwdn.networks.blocks import check_channels, resize
from mwdn.networks.flatnet_unet import FlatNetUNet
from mwdn.networks.network import Network
from mwdn.networks.wiener_filter import normalise_psf
from mwdn.types import Measurement, Psf, Scene, Size, size_of


def field_weights(side: int, size: Size, device: torch.device) -> Tensor:
    """Blending weights (side^2, H, W) of ``side`` x ``side`` tiles of the field; they sum to 1 at each pixel.

    Inversely proportional to the distance from the tile's centre, with the field's height and width as units.
    """
    centres = (torch.arange(side, device=device) + 0.5) / side
    rows, columns = ((torch.arange(n, device=device) + 0.5) / n for n in size)
    vertical = (rows - centres[:, None]).square()[:, None, :, None]
    horizontal = (columns - centres[:, None]).square()[None, :, None, :]
    # 1e-3 keeps the weights finite; at a tile's centre the tile's own weight is then nearly 1.
    weights = 1 / ((vertical + horizontal).sqrt() + 1e-3)
    return (weights / weights.sum((0, 1))).flatten(0, 1).float()


class SvDeconv(Network[Tensor]):
    """Wiener filters with a 3 x 3 field of learned PSFs, blended over the picture, then a U-Net.

    35,849,494 learnable parameters; 1,296,000 of them are the PSFs' at 270 x 480. No source gives a count.

    From the source: K x K local PSFs and a global one, all initialised as the measured PSF and shared by the colours,
    each with a learned lambda; each deconvolves the whole measurement with replicate padding; the K x K estimates are
    blended with weights inversely proportional to the distance from each PSF's place; the blend and the global estimate
    enter FlatNet's U-Net; no adversarial training.

    Different here: each PSF is learned as a correction of the measured one, which is an input, in units of its peak.
    Corrections are stored for one sensor size, ``size``, and resampled to any other.

    Left out: the code's optional U-Net before the filters, and the second stage, a diffusion model.

    Inferred: the U-Net's blocks, see `mwdn.networks.flatnet.FlatNet`; lambda starts at 1e-3 for a PSF of unit sum (the
    code's 100 has other units); a sigmoid at the output.

    Args:
        channels: colours of the measurement.
        width: feature channels at the U-Net's finest scale.
        field: K, local PSFs along each side of the field.
        size: height and width for which the corrections are stored.
        regularisation: initial value of each lambda.
        boundary: values beyond the border of what is filtered, see `mwdn.fourier.padding.Boundary`.

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
        self.generator = FlatNetUNet(2 * channels, channels, width=width)

    def prepare(self, psf: Psf, size: Size) -> Tensor:
        """PSF of each colour at peak 1. The K^2 + 1 transfer functions are not stored: they need too much memory."""
        return normalise_psf(psf, size, self.channels)

    def deconvolve(self, measurement: Measurement, prepared: Tensor) -> tuple[Tensor, Tensor]:
        """Estimates (B, C, H, W) with the global PSF, and with the field of local PSFs.

        Raises:
            ShapeError: the measurement does not have the network's number of channels.
        """
        check_channels(measurement, self.channels)
        total = prepared.sum((-2, -1), keepdim=True)
        size = size_of(measurement)
        grid = deconvolution_grid(size, self.boundary)
        B = spectrum(pad(measurement.float(), grid, self.boundary), grid)
        corrections = torch.split(resize(self.correction, size), 1, dim=1)
        estimates = []
        for correction, regularisation in zip(corrections, self.log_regularisation.exp(), strict=True):
            H = transfer_function((prepared + correction) / total, grid)
            estimates.append(inverse_spectrum(H.conj() * B / (H.abs().square() + regularisation), grid, size))
        single, *tiles = estimates
        weights = field_weights(self.field, size, measurement.device)
        return single, sum((weight * tile for weight, tile in zip(weights, tiles, strict=True)), start=0 * single)

    def reconstruct(self, measurement: Measurement, prepared: Tensor) -> Scene:
        """Scene (B, C, H, W), between 0 and 1."""
        return torch.sigmoid(self.generator(torch.cat(self.deconvolve(measurement, prepared), dim=1)).float())

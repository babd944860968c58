"""A bank of Wiener estimates in front of a U-Net; not from the paper."""

from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional as F

from mwdn.errors import ParameterError
from mwdn.fourier.memory_format import pixel_unshuffle
from mwdn.fourier.padding import Boundary, pad
from mwdn.fourier.transforms import inverse_spectrum, spectrum
from mwdn.fourier.wiener import deconvolution_grid, wiener_transfer
from mwdn.networks.blocks import Decoder, Encoder, check_channels, paper_widths, peak_one
from mwdn.networks.drunet import Drunet
from mwdn.networks.network import Network
from mwdn.solvers.plug_and_play import plug_and_play
from mwdn.solvers.pyramid import LEVELS, Band, PsfPyramid
from mwdn.types import Measurement, Psf, Scene, Size

QUICK = {8: 12, 4: 18, 2: 8}
"""Iterations of each size where detail is left to the bank: three quarters of the time, for a tenth of a decibel."""

BOUNDARY: Boundary = "taper"
"""How a measurement goes on beyond its border, where the bank filters it as it is."""


class BankTransfers(NamedTuple):
    """What `WienerBank` needs of a PSF.

    Args:
        levels: transfer function and norm of the PSF at each level of the iterations, the coarsest first.
        filters: transfer function of each Wiener filter; none where the last level's serves.
    """

    levels: tuple[tuple[Tensor, Tensor], ...]
    filters: tuple[Tensor, ...]


class WienerBank(Network[BankTransfers]):
    """Several Wiener filters, from strong to weak regularisation, in picture space; a U-Net corrects their estimates.

    A strong lambda leaves a smooth picture of right brightness, a weak one keeps detail and amplifies noise; no single
    one serves all frequencies. No linear filter knows that the sensor crops the pattern and that light is not negative,
    which decides about shading and colour. So a few iterations that know both (`mwdn.solvers.pyramid`) explain what
    they can, and the bank filters the rest. The U-Net learns what is then still wrong.

    Nothing before the U-Net is learned with it: `estimates` of a sample can be kept. Everything is measured in units of
    the smoothest estimate's brightest pixel and scaled back at the end, so exposure and gain cannot matter: the network
    of a scaled measurement is the scaled scene.

    Args:
        channels: colours of the measurement and the scene.
        width: feature channels at the U-Net's finest scale.
        fold: pixels along each side of the blocks that the U-Net sees as one pixel of more channels. With 2 it takes
            a quarter of the time and sees twice as far; the estimates it corrects keep the full resolution.
        regularisations: lambda of each estimate, for a PSF of unit sum, the strongest first.
        finest: pixels of the measurement along each side of those of the finest iterations: 1, 2, 4 or 8. With 4 they
            take a tenth of the time and leave the detail to the bank. 0 for none: the bank filters the measurement,
            continued by its border.
        align: `mwdn.Reconstructor` turns, scales and hazes the PSF until it explains the capture
            (`mwdn.solvers.alignment`) before it calls the network. The network takes PSFs as they are, in training
            too: train it with the mismatch that the alignment leaves.
        block: pixels along each side of the blocks whose mean light stays as the iterations found it. They know the
            crop, and measure shading and colour better than a U-Net guesses them, by up to 5 dB.
        rounds: of plug and play (`mwdn.solvers.plug_and_play`) between the iterations and the bank, where ``finest``
            is 1. Their denoiser is trained alone, by noisy pictures, and has nothing to learn here; 0 for none.
    """

    def __init__(  # noqa: PLR0913
        self,
        *,
        channels: int = 3,
        width: int = 24,
        fold: int = 2,
        regularisations: tuple[float, ...] = (1e-3, 1e-4, 2e-5),
        finest: int = 1,
        align: bool = True,
        block: int = 32,
        rounds: int = 0,
    ) -> None:
        super().__init__()
        if not regularisations or min(regularisations) <= 0:
            raise ParameterError(f"`regularisations` {tuple(regularisations)} must be one or more positive numbers.")
        if finest not in (0, *(level.downsampling for level in LEVELS)):
            raise ParameterError(f"`finest` ({finest}) must be 0 or one of {[level.downsampling for level in LEVELS]}.")
        if rounds and finest != 1:
            raise ParameterError(f"`rounds` ({rounds}) of plug and play need iterations of the full size: `finest` 1.")
        for name, value, least in (("width", width, 1), ("fold", fold, 1), ("block", block, 1), ("rounds", rounds, 0)):
            if not isinstance(value, int) or value < least:
                raise ParameterError(f"`{name}` ({value!r}) must be a whole number, at least {least}.")
        self.channels, self.fold, self.regularisations = channels, fold, regularisations
        self.finest, self.align, self.block = finest, align, block
        self.levels = tuple(level for level in LEVELS if finest and level.downsampling >= finest)
        if finest > 1:  # the bank has what total variation would smooth away
            self.levels = tuple(
                replace(level, regularisation=0.0, iterations=QUICK[level.downsampling]) for level in self.levels
            )
        self.rounds = rounds
        if rounds:
            self.denoiser = Drunet(channels=channels).requires_grad_(False)
        pictures = len(regularisations) + (2 if self.levels else 1)
        self.encoder = Encoder(channels * pictures * fold**2, paper_widths(width))
        self.decoder = Decoder(channels * fold**2, paper_widths(width))
        with torch.no_grad():
            self.decoder.head.weight.mul_(0.1)  # begin near the estimate

    def prepare(self, psf: Psf, size: Size) -> BankTransfers:
        """Transfer functions and norms of the iterations, and the transfer functions of the bank.

        Args:
            psf: taken as it is: `mwdn.Reconstructor` aligns it before.
            size: height and width of the measurement.
        """
        psf = peak_one(psf, size)
        psf = psf / psf.sum((-2, -1), keepdim=True)
        bands = PsfPyramid.from_psf(psf, size, self.levels).bands if self.levels else ()
        levels = tuple((band.transfer, band.norm) for band in bands)
        if self.finest == 1:  # the bank's transfer function is that of the last level
            return BankTransfers(levels, ())
        grid = deconvolution_grid(size, BOUNDARY)
        return BankTransfers(levels, tuple(wiener_transfer(psf, value, grid) for value in self.regularisations))

    def reconstruct(self, measurement: Measurement, prepared: BankTransfers) -> Scene:
        """Scene (B, C, H, W), each colour deconvolved with its own PSF.

        Raises:
            ShapeError: the measurement is neither grey nor has the network's number of channels.
        """
        if measurement.shape[1] == 1 < self.channels:  # a grey camera: three equal colours
            return self.reconstruct(measurement.expand(-1, self.channels, -1, -1), prepared).mean(1, keepdim=True)
        check_channels(measurement, self.channels)
        estimates = self._estimates(measurement, prepared)
        return self.correct(estimates, self.unit(estimates))

    def estimates(self, measurement: Measurement, psf: Psf) -> Tensor:
        """Estimates of the scene, the smoothest first, and the measurement: (B, C * pictures, H, W)."""
        return self._estimates(measurement, self.prepare(psf, (measurement.shape[-2], measurement.shape[-1])))

    def _estimates(self, measurement: Measurement, prepared: BankTransfers) -> Tensor:
        b = measurement.float()
        if not self.levels:
            return torch.cat([*self._filtered(b, prepared.filters, BOUNDARY), b], dim=1)
        bands = [Band(level, *each) for level, each in zip(self.levels, prepared.levels, strict=True)]
        estimate = PsfPyramid(tuple(bands)).solve(b)
        if self.rounds:
            estimate = plug_and_play(estimate, self.denoiser, self.rounds)
        if self.finest == 1:
            details = [estimate.detail(value) for value in self.regularisations]
        else:
            details = self._filtered(estimate.residual, prepared.filters, "zero")
        return torch.cat([estimate.scene, *(estimate.scene + detail for detail in details), b], dim=1)

    def _filtered(self, picture: Tensor, transfers: tuple[Tensor, ...], boundary: Boundary) -> list[Tensor]:
        """The bank: one spectrum, several filters."""
        size = picture.shape[-2], picture.shape[-1]
        grid = deconvolution_grid(size, BOUNDARY)
        # Transforms pad with zeros by themselves, and skip the rows that hold nothing else.
        B = spectrum(picture if boundary == "zero" else pad(picture, grid, boundary), grid)
        return [inverse_spectrum(B * transfer, grid, size) for transfer in transfers]

    def unit(self, estimates: Tensor) -> Tensor:
        """Brightest pixel of the smoothest of `estimates`, (B, 1, 1, 1)."""
        brightest = estimates[:, : self.channels].detach().amax((1, 2, 3), keepdim=True)
        return brightest.clamp(min=torch.finfo(torch.float32).tiny)

    def correct(self, estimates: Tensor, unit: Tensor) -> Scene:
        """Scene (B, C, H, W) from `estimates`, or a part of them: the learned part, a correction of the smoothest."""
        first = estimates[:, : self.channels]
        height, width = estimates.shape[-2:]
        below, right = (max(-size % self.fold, 32 * self.fold - size) for size in (height, width))
        if below or right:
            estimates = F.pad(estimates, (0, right, 0, below))
        rows, columns = (-(-size // self.fold) for size in (height, width))
        blocks = pixel_unshuffle(estimates, self.fold).div_(unit)
        correction = self.decoder(self.encoder(blocks))[..., :rows, :columns]
        if self.levels:  # of each place in the folded blocks by itself, or their pattern would be seen in dark areas
            correction = correction - mean_light(correction, max(1, self.block // self.fold))
        return first + unit * F.pixel_shuffle(correction, self.fold)[..., :height, :width]


def mean_light(picture: Tensor, block: int) -> Tensor:
    """The smooth picture, (B, C, H, W), through the means of its blocks."""
    height, width = picture.shape[-2:]
    below, right = -height % block, -width % block
    whole = F.pad(picture, (0, right, 0, below), mode="replicate") if below or right else picture
    means = F.avg_pool2d(whole, block)
    return F.interpolate(means, scale_factor=block, mode="bilinear")[..., :height, :width]

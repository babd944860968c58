"""A bank of Wiener filters followed by a U-Net; not from the paper."""

from typing import Literal, NamedTuple

import torch
from torch import Tensor
from torch.nn import functional as F

from mwdn.arguments import check_at_least
from mwdn.errors import ParameterError
from mwdn.fourier.memory_format import pixel_shuffle, pixel_unshuffle
from mwdn.fourier.padding import Boundary, pad
from mwdn.fourier.transforms import inverse_spectrum, spectrum
from mwdn.fourier.wiener import deconvolution_grid, wiener_transfer
from mwdn.networks.block_means import block_means
from mwdn.networks.blocks import Decoder, Encoder, check_channels, paper_widths
from mwdn.networks.checkerboard import remove_checkerboard
from mwdn.networks.drunet import Drunet
from mwdn.networks.evidence import MAPS, against_psf, doubt_of_psf
from mwdn.networks.network import FixedFront
from mwdn.networks.wiener_filter import normalise_psf
from mwdn.optics.distortion import distort, undistort
from mwdn.optics.polynomials import coefficient_count
from mwdn.optics.psf import unit_sum
from mwdn.optics.shading import shade
from mwdn.solvers.levels import LEVELS, pyramid_levels
from mwdn.solvers.plug_and_play import Denoiser, plug_and_play
from mwdn.solvers.pyramid import Band, Estimate, PsfPyramid
from mwdn.types import TINY, Measurement, Psf, Scene, Size, size_of

BOUNDARY: Boundary = "taper"
"""Boundary handling where the bank filters the measurement itself."""

MeanLight = Literal["kept", "free", "gated"]
"""How far the U-Net may change the mean light of a block:

- ``kept``: not at all. The iterations' shading is right if the PSF is.
- ``free``: without limit.
- ``gated``: times a gate, which the U-Net learns to open where the measurement contradicts the PSF.
"""

CLOSED = 2.0
"""A gate of output 0 lets ``sigmoid(-2)`` = 12 % through."""


class BankTransfers(NamedTuple):
    """What `WienerBank` precomputes from a PSF.

    Args:
        levels: transfer function and norm of the PSF at each level of the iterations, coarsest first.
        filters: transfer function of each Wiener filter; empty if the finest level's is used instead.
    """

    levels: tuple[tuple[Tensor, Tensor], ...]
    filters: tuple[Tensor, ...]


def _check_iterations(finest: int, rounds: int, mean_light: MeanLight, *, evidence: bool) -> None:
    """Check `finest`, and that there are iterations for what needs them."""
    sizes = [level.downsampling for level in LEVELS]
    if finest not in (0, *sizes):
        raise ParameterError(f"`finest` ({finest}) must be 0 or one of {sizes}.")
    if rounds and finest != 1:
        raise ParameterError(f"`rounds` ({rounds}) of plug and play need iterations at full size: `finest` 1.")
    if not finest and (evidence or mean_light != "kept"):
        raise ParameterError(
            f"`mean_light` ({mean_light}) and `evidence` ({evidence}) need iterations: `finest` 1, 2, 4 or 8."
        )


class WienerBank(FixedFront[BankTransfers]):
    """Wiener estimates with strong to weak regularisation, corrected by a U-Net.

    A strong lambda gives a smooth picture of correct brightness, a weak one keeps detail and amplifies noise; no single
    value suits all frequencies. Linear filters also ignore that the sensor crops the pattern and that light is
    non-negative, which distorts shading and colour. So a few iterations that model both (`mwdn.solvers.pyramid`)
    estimate the scene, and the bank filters their residual. The U-Net corrects the remaining errors.

    Only the U-Net is trained, so the `estimates` of a sample can be stored. All pictures are divided by the maximum of
    the smoothest estimate and multiplied again at the end: scaling the measurement scales the scene.

    Args:
        channels: colours of the measurement and the scene.
        width: feature channels at the U-Net's finest scale.
        fold: block size of the pixel unshuffling before the U-Net. 2 takes a quarter of the time of 1 and doubles the
            receptive field; the estimates keep the full resolution.
        regularisations: lambda of each estimate, for a PSF of unit sum, strongest first.
        finest: downsampling of the finest iterations: 1, 2, 4 or 8. With 4 they take a tenth of the time and the bank
            restores the detail. 0 for no iterations: the bank filters the padded measurement.
        align: whether `mwdn.Reconstructor` aligns the PSF to each capture (`mwdn.solvers.alignment`) before it calls
            the network. The network itself never aligns: train it with the mismatch that alignment leaves.
        block: size of the blocks in which the U-Net keeps the mean of the iterations' estimate. The iterations model
            the crop; their shading and colour are up to 5 dB better than a U-Net's.
        rounds: rounds of plug and play (`mwdn.solvers.plug_and_play`) between the iterations and the bank, for
            ``finest`` 1. The denoiser is trained separately on noisy pictures and frozen here; 0 for none. A result of
            plug and play is freed from the denoiser's checkerboard (`mwdn.networks.checkerboard`).
        mean_light: how far the U-Net may change a block's mean light: not at all (``kept``), without limit (``free``),
            or where the measurement contradicts the PSF (``gated``). All but ``kept`` need iterations.
        evidence: whether evidence against the PSF (`mwdn.networks.evidence`) is also an input of U-Net and denoiser;
            needs iterations.
        distortion: order of the polynomials of the recorded scenes' distortion; 0 for none.
        shading: order of the polynomials of the recorded scenes' shading, 0 for a gain of each colour; ``None`` for
            none.

    Attributes:
        distortion: coefficients (2, K) for `mwdn.optics.distortion`, measured before the training; or ``None``.
        shading: coefficients (C, K) for `mwdn.optics.shading`, measured after it, before the training; or ``None``.
    """

    distortion: Tensor | None
    shading: Tensor | None

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
        mean_light: MeanLight = "kept",
        evidence: bool = False,
        distortion: int = 0,
        shading: int | None = None,
    ) -> None:
        super().__init__()
        if not regularisations or min(regularisations) <= 0:
            raise ParameterError(f"`regularisations` {tuple(regularisations)} must be one or more positive numbers.")
        check_at_least(1, width=width, fold=fold, block=block)
        check_at_least(0, rounds=rounds, distortion=distortion, shading=shading or 0)
        _check_iterations(finest, rounds, mean_light, evidence=evidence)
        self.channels, self.fold, self.regularisations = channels, fold, regularisations
        self.finest, self.align, self.block, self.rounds = finest, align, block, rounds
        self.levels = pyramid_levels(finest)
        if rounds:
            self.denoiser = Drunet(channels=channels, conditions=1 + evidence).requires_grad_(False)
        self.register_buffer("distortion", torch.zeros(2, coefficient_count(distortion)) if distortion else None)
        self.register_buffer("shading", None if shading is None else torch.zeros(channels, coefficient_count(shading)))
        self.mean_light, self.has_evidence = mean_light, evidence
        self.pictures = channels * (len(regularisations) + (2 if self.levels else 1))
        evidence_channels = channels + MAPS if evidence else 0
        self.encoder = Encoder(self.pictures * fold**2 + evidence_channels, paper_widths(width))
        self.decoder = Decoder(channels * fold**2 + (mean_light == "gated"), paper_widths(width))
        with torch.no_grad():
            self.decoder.head.weight.mul_(0.1)  # start near the estimate

    def prepare(self, psf: Psf, size: Size) -> BankTransfers:
        """Transfer functions and norms for the iterations, and the transfer functions of the bank."""
        psf = unit_sum(normalise_psf(psf, size))
        bands = PsfPyramid.from_psf(psf, size, self.levels).bands if self.levels else ()
        levels = tuple((band.transfer, band.norm) for band in bands)
        if self.finest == 1:  # the bank uses the transfer function of the finest level
            return BankTransfers(levels, ())
        grid = deconvolution_grid(size, BOUNDARY)
        return BankTransfers(levels, tuple(wiener_transfer(psf, value, grid) for value in self.regularisations))

    def reconstruct(self, measurement: Measurement, prepared: BankTransfers) -> Scene:
        """Scene (B, C, H, W), each colour deconvolved with its own PSF.

        Raises:
            ShapeError: the measurement has neither one channel nor the network's number.
        """
        if measurement.shape[1] == 1 < self.channels:  # a grey camera: equal colours
            return self.reconstruct(measurement.expand(-1, self.channels, -1, -1), prepared).mean(1, keepdim=True)
        check_channels(measurement, self.channels)
        estimates = self._estimates(measurement, prepared)
        return self.correct(estimates, self.unit(estimates))

    def as_recorded(self, scene: Scene) -> Scene:
        """Convert a result of `reconstruct` to the geometry and light of the scenes that the network was trained on."""
        scene = scene if self.distortion is None else undistort(scene, self.distortion)
        return scene if self.shading is None else shade(scene, self.shading)

    def as_reconstructed(self, scene: Scene) -> Scene:
        """Inverse of `as_recorded`, for a recorded scene."""
        scene = scene if self.shading is None else shade(scene.float(), -self.shading)
        return scene if self.distortion is None else distort(scene.float(), self.distortion)

    def estimates(self, measurement: Measurement, psf: Psf) -> Tensor:
        """Estimates of the scene, smoothest first, the measurement, and the evidence if any: (B, channels, H, W).

        A grey measurement is expanded to equal colours.
        """
        if measurement.shape[1] == 1:
            measurement = measurement.expand(-1, self.channels, -1, -1)
        return self._estimates(measurement, self.prepare(psf, size_of(measurement)))

    def _estimates(self, measurement: Measurement, prepared: BankTransfers) -> Tensor:
        b = measurement.float()
        if not self.levels:
            return torch.cat([*self._filter(b, prepared.filters, BOUNDARY), b], dim=1)
        return self.filtered(self.refined(self.iterate(b, prepared)), prepared)

    def iterate(self, measurement: Measurement, prepared: BankTransfers) -> Estimate:
        """The iterations' estimate of the scene, before plug and play and the bank."""
        bands = [Band(level, *transfer) for level, transfer in zip(self.levels, prepared.levels, strict=True)]
        return PsfPyramid(tuple(bands)).solve(measurement)

    def refined(self, estimate: Estimate) -> Estimate:
        """The iterations' estimate after plug and play."""
        return plug_and_play(estimate, self.denoise(estimate), self.rounds) if self.rounds else estimate

    def filtered(self, estimate: Estimate, prepared: BankTransfers) -> Tensor:
        """The `estimates`: those of the bank added to the refined one, its measurement, and the evidence."""
        if self.finest == 1:
            details = [estimate.detail(value) for value in self.regularisations]
        else:
            details = self._filter(estimate.residual, prepared.filters, "zero")
        evidence = [against_psf(estimate, details[0], self.block)] if self.has_evidence else []
        scenes = [estimate.scene, *(estimate.scene + detail for detail in details)]
        return torch.cat([*scenes, estimate.measurement, *evidence], dim=1)

    def denoise(self, estimate: Estimate) -> Denoiser:
        """The denoiser of plug and play. With evidence, its inputs are the level sigma and sigma times the doubt."""
        if not self.has_evidence:
            return self.denoiser
        doubt = doubt_of_psf(estimate)
        return lambda image, level: self.denoiser(image, torch.cat([level, level * doubt], dim=1))

    def _filter(self, picture: Tensor, transfers: tuple[Tensor, ...], boundary: Boundary) -> list[Tensor]:
        """Wiener filters of the bank, applied to one spectrum."""
        size = size_of(picture)
        grid = deconvolution_grid(size, BOUNDARY)
        # `spectrum` pads with zeros itself and skips the empty rows.
        B = spectrum(picture if boundary == "zero" else pad(picture, grid, boundary), grid)
        return [inverse_spectrum(B * transfer, grid, size) for transfer in transfers]

    def unit(self, estimates: Tensor) -> Tensor:
        """Maximum of the smoothest of the `estimates`, (B, 1, 1, 1)."""
        brightest = estimates[:, : self.channels].detach().amax((1, 2, 3), keepdim=True)
        return brightest.clamp(min=TINY)

    def correct(self, estimates: Tensor, unit: Tensor) -> Scene:
        """Scene (B, C, H, W) from `estimates` or a crop of them: the U-Net's correction added to the smoothest.

        In evaluation mode with rounds of plug and play, the denoiser's checkerboard is removed too.
        """
        border = self._border(estimates)
        if border:
            wide = self._correct(F.pad(estimates, (border,) * 4, mode="reflect"), unit)
            return remove_checkerboard(wide[..., border:-border, border:-border])
        return self._correct(estimates, unit)

    def _border(self, estimates: Tensor) -> int:
        """Pixels of mirror padding around a frame's estimates, in place of the U-Net's zero padding.

        Zeros left a visible border around the picture. A whole block keeps the grid of blocks in place. Networks
        without plug and play, for live pictures, show no such border; training uses crops, which have no border of a
        frame.
        """
        if self.training or not self.rounds:
            return 0
        return min(self.block, *(n - 1 for n in estimates.shape[-2:]))

    def _correct(self, estimates: Tensor, unit: Tensor) -> Scene:
        """Smoothest estimate + unit * correction; the U-Net works on blocks of ``fold`` x ``fold`` pixels."""
        height, width = size_of(estimates)
        rows, columns = (-(-side // self.fold) for side in (height, width))
        output = self.decoder(self.encoder(self._unet_inputs(estimates, unit)))[..., :rows, :columns]
        correction = pixel_shuffle(self._limit_light(output), self.fold)[..., :height, :width]
        return estimates[:, : self.channels] + unit * correction

    def _unet_inputs(self, estimates: Tensor, unit: Tensor) -> Tensor:
        """The pictures in whole blocks, at least 32 x 32 of them, and the smooth evidence at one pixel of each."""
        below, right = (max(-side % self.fold, 32 * self.fold - side) for side in size_of(estimates))
        if below or right:
            estimates = F.pad(estimates, (0, right, 0, below))
        pictures = pixel_unshuffle(estimates[:, : self.pictures], self.fold).div_(unit)
        if not self.has_evidence:
            return pictures
        evidence = estimates[:, self.pictures :, :: self.fold, :: self.fold]
        light, maps = evidence[:, : self.channels], evidence[:, self.channels :]
        evidence = torch.cat([light / unit, maps], dim=1).contiguous(memory_format=torch.channels_last)
        return torch.cat([pictures, evidence], dim=1)

    def _limit_light(self, output: Tensor) -> Tensor:
        """The U-Net's correction, whose mean light is limited by `MeanLight`."""
        correction = output[:, : self.channels * self.fold**2]
        if self.mean_light == "free" or not self.levels:
            return correction
        block = max(1, self.block // self.fold)
        means = block_means(correction, block)  # for each channel; otherwise the block pattern shows in dark areas
        if self.mean_light == "kept":
            return correction - means
        gate = torch.sigmoid(block_means(output[:, -1:], block) - CLOSED)
        return correction - (1 - gate) * means

"""Learnable Wiener filters, eq. (2), and checks and scaling of PSFs."""

import math
from collections.abc import Iterator
from typing import cast

import torch
from torch import Tensor, nn

from mwdn.arguments import check_batch
from mwdn.errors import ParameterError, ShapeError
from mwdn.fourier.filtering import filter_image
from mwdn.fourier.memory_format import chunked
from mwdn.fourier.padding import Boundary
from mwdn.fourier.wiener import deconvolution_grid, wiener_transfer
from mwdn.optics.psf import checked_psf
from mwdn.types import Psf, Size, size_of


class WienerFilter(nn.Module):
    """Wiener filter, eq. (2), with a learned weight w and regularisation lambda.

    Both are stored as logarithms, so that they stay positive during training.

    Args:
        weight: initial value of w; ``None`` leaves w out (MWDN-CPSF, whose PSF is learned).
        regularisation: initial value of lambda.
        boundary: values beyond the border of what is filtered, see `mwdn.fourier.padding.Boundary`.
        linear: learn w and lambda themselves, as the authors' code does. w may then be or become negative, and training
            moves both by about the learning rate a step, whatever their size.

    Attributes:
        max_grid_pixels: transfer functions with more grid pixels than this, over all channels, are not stored but
            computed when needed. The default is 2^27 complex numbers of half spectra, 1 GB; MWDN-CPSF exceeds it at
            1080 x 1920.
    """

    max_grid_pixels = 2**28
    log_weight: nn.Parameter
    linear_weight: nn.Parameter
    log_regularisation: nn.Parameter
    linear_regularisation: nn.Parameter

    def __init__(
        self, *, weight: float | None, regularisation: float, boundary: Boundary, linear: bool = False
    ) -> None:
        super().__init__()
        self.boundary, self.linear, self.has_weight = boundary, linear, weight is not None
        if not regularisation > 0:
            why = "a filter with a negative lambda has poles" if linear else "its logarithm is learned"
            raise ParameterError(f"`regularisation` ({regularisation}) must be positive: {why}.")
        if weight is not None and not weight > 0 and not linear:
            raise ParameterError(f"`weight` ({weight}) must be positive: its logarithm is learned.")
        # The names tell `mwdn.training.schedule.make_optimiser` which numbers are logarithms.
        if linear:
            self.linear_regularisation = _parameter(regularisation)
            if weight is not None:
                self.linear_weight = _parameter(weight)
        else:
            self.log_regularisation = _parameter(math.log(regularisation))
            if weight is not None:
                self.log_weight = _parameter(math.log(weight))

    @property
    def weight(self) -> Tensor | None:
        """w, a scalar; ``None`` without one."""
        if not self.has_weight:
            return None
        return self.linear_weight if self.linear else self.log_weight.exp()

    @property
    def regularisation(self) -> Tensor:
        """lambda, a scalar."""
        return self.linear_regularisation if self.linear else self.log_regularisation.exp()

    def prepare(self, psf: Psf) -> Tensor:
        """Transfer function of a PSF of 1 or C channels; the PSF itself where that would exceed `max_grid_pixels`."""
        grid = self.grid(psf)
        if psf[:, :, 0, 0].numel() * grid[0] * grid[1] > self.max_grid_pixels:
            return psf.contiguous()
        step = self._channels_per_chunk(grid)
        parts = [self.transfer(psf[:, i : i + step]) for i in range(0, psf.shape[1], step)]
        return parts[0] if len(parts) == 1 else torch.cat(parts, dim=1)

    def transfer(self, psf: Psf) -> Tensor:
        """``w conj(H) / (|w H|^2 + lambda)`` on the grid for features of the PSF's size."""
        if self.weight is not None:
            psf = self.weight * psf
        return wiener_transfer(psf, self.regularisation, self.grid(psf))

    def deconvolve(self, features: Tensor, prepared: Tensor) -> Tensor:
        """Deconvolve features (B, C, H, W) with the result of `prepare`."""
        grid = self.grid(features)
        if prepared.is_complex():
            return filter_image(features, prepared, grid, self.boundary)

        def deconvolve_chunk(features: Tensor, psf: Tensor) -> Tensor:
            return filter_image(features, self.transfer(psf), grid, self.boundary)

        return chunked(deconvolve_chunk, features, prepared, self._channels_per_chunk(grid))

    def grid(self, image: Tensor) -> Size:
        """Size of the Fourier transforms for features or a PSF of this size."""
        return deconvolution_grid(size_of(image), self.boundary)

    def _channels_per_chunk(self, grid: Size) -> int:
        """Channels whose transfer functions are computed at once: intermediate arrays take ten times their memory."""
        return max(1, self.max_grid_pixels // (32 * grid[0] * grid[1]))


def _parameter(value: float) -> nn.Parameter:
    return nn.Parameter(torch.tensor(float(value)))


class WienerFilters(nn.ModuleList):
    """One Wiener filter for each scale, finest first."""

    def __iter__(self) -> Iterator[WienerFilter]:
        return cast(Iterator[WienerFilter], super().__iter__())

    def prepare(self, psfs: list[Tensor]) -> list[Tensor]:
        """Transfer function of each scale's filter. The list is emptied, which frees each PSF once it is used."""
        return [wiener.prepare(psfs.pop(0)) for wiener in self]

    def deconvolve(self, features: list[Tensor], prepared: list[Tensor]) -> list[Tensor]:
        """Deconvolve the features of each scale that has a filter, in the list itself, which frees those before."""
        for scale, (wiener, transfer) in enumerate(zip(self, prepared, strict=True)):
            features[scale] = wiener.deconvolve(features[scale], transfer)
        return features


def normalise_psf(psf: Psf, size: Size, channels: int | None = None, *, stored: bool = False) -> Tensor:
    """Scale each channel to unit sum, then each PSF to a peak of 1, as the paper's PSFs have.

    Args:
        psf: (1 or B, 1 or C, H, W), of any scale.
        size: height and width of the measurement.
        channels: number of channels to which a grey PSF is expanded; ``None`` keeps it grey.
        stored: leave the scale as it is, for a network with ``stored_psf``.

    Raises:
        ShapeError: the PSF does not have the height and width of the measurement.
    """
    check_size(psf, size)
    if not stored:
        psf = unit_psf(psf)
        psf = psf / psf.amax(dim=(1, 2, 3), keepdim=True)
    return psf if channels is None or psf.shape[1] != 1 else psf.expand(-1, channels, -1, -1)


def unit_psf(psf: Psf) -> Tensor:
    """Scale each channel to unit sum; not in an export, whose `prepare` takes such PSFs only."""
    return psf if torch.compiler.is_exporting() else checked_psf(psf, values=False)


def check_size(psf: Psf, size: Size) -> None:
    """Raise a `ShapeError` unless the PSF has the height and width of the measurement."""
    check_batch(psf, "psf")
    if tuple(psf.shape[-2:]) != tuple(size):
        raise ShapeError(
            f"`psf` ({psf.shape[-2]} x {psf.shape[-1]}) and `measurement` ({size[0]} x {size[1]}) must have the same "
            "height and width. Bin or crop the PSF: `bin`, `crop`."
        )

"""Wiener deconvolution, of images or of hundreds of feature channels."""

from torch import Tensor

from mwdn.arguments import checked
from mwdn.errors import ParameterError, ShapeError
from mwdn.fourier.convolution import check_fit
from mwdn.fourier.filtering import filter_image
from mwdn.fourier.padding import Boundary
from mwdn.fourier.transforms import fast_length, transfer_function
from mwdn.types import Image, Measurement, Psf, Size, Spectrum, size_of


def deconvolution_grid(size: Size, boundary: Boundary) -> Size:
    """Grid on which a measurement of ``size`` is deconvolved: 1.5 times as long; ``size`` itself if circular."""
    if boundary == "circular":
        return size
    return fast_length(size[0] + size[0] // 2), fast_length(size[1] + size[1] // 2)


@checked
def wiener(
    measurement: Measurement, psf: Psf, regularisation: float | Tensor, *, boundary: Boundary = "taper"
) -> Image:
    """Wiener estimate of the scene, eq. (2) of the paper: ``V = conj(H) B / (|H|^2 + lambda)``.

    Args:
        measurement: (B, C, H, W).
        psf: (1 or B, 1 or C, h, w), centred; the paper's weight w is already multiplied into it.
        regularisation: lambda, positive; a number, or a tensor that broadcasts against (B, C, 1, 1). It is the
            noise-to-signal power ratio: as it grows, noise and detail fade and the estimate dims. For a PSF of
            unit sum, |H|^2 is 1 at frequency zero and useful values lie between 1e-5 and 1e-1.
        boundary: values beyond the measurement's border, see `Boundary`.

    Returns:
        (B, C, H, W), float32; its range is that of ``measurement`` over the sum of ``psf``.

    Raises:
        ShapeError: batch or channels do not fit, ``psf`` exceeds `deconvolution_grid`, or ``regularisation`` has other
            axes.
        ParameterError: ``regularisation`` is a number that is not positive, or ``boundary`` is unknown.

    References:
        N. Wiener, Extrapolation, Interpolation, and Smoothing of Stationary Time Series (1949).
    """
    check_fit(measurement, psf, "measurement")
    if isinstance(regularisation, Tensor):
        samples, channels = measurement.shape[:2]
        axes = (1,) * (4 - regularisation.ndim) + tuple(regularisation.shape)
        if axes[0] not in (1, samples) or axes[1] not in (1, channels) or axes[2:] != (1, 1):
            raise ShapeError(
                f"`regularisation` {tuple(regularisation.shape)} must broadcast against (B, C, 1, 1) of `measurement` "
                f"{tuple(measurement.shape)}. For one a channel: `regularisation.reshape(1, -1, 1, 1)`."
            )
    grid = deconvolution_grid(size_of(measurement), boundary)
    return filter_image(measurement.float(), wiener_transfer(psf, regularisation, grid), grid, boundary)


def wiener_transfer(psf: Psf, regularisation: float | Tensor, grid: Size) -> Spectrum:
    """Transfer function of the Wiener filter, ``conj(H) / (|H|^2 + lambda)``.

    Args:
        psf: (B, C, h, w), centred, at most as large as ``grid``.
        regularisation: lambda, as for `wiener`.
        grid: see `deconvolution_grid`.

    Raises:
        ParameterError: ``regularisation`` is a number that is not positive.
    """
    if not isinstance(regularisation, Tensor) and not regularisation > 0:
        raise ParameterError(f"`regularisation` ({regularisation}) must be positive; try 1e-3.")
    H = transfer_function(psf, grid)
    return H.conj() / (H.abs().square() + regularisation)

"""Convolution, correlation and Wiener deconvolution by fast Fourier transforms.

The only file that calls ``torch.fft``. Everything here is computed in float32, whatever the autocast state, because
half-precision transforms do not exist on CPUs and lose the small values of a spectrum everywhere.

A PSF enters centred at ``(height // 2, width // 2)``; the shift to the origin happens here and nowhere else.
"""

import math
from functools import cache
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from mwdn.errors import ParameterError, ShapeError
from mwdn.planes import Boundary as Boundary
from mwdn.planes import Continuation, in_parts, laid_out_as, paired, planar, together, unpaired
from mwdn.planes import Size as Size
from mwdn.planes import extend as extend
from mwdn.types import Image, Measurement, Psf, Scene, Spectrum


@cache
def fast_length(length: int) -> int:
    """Smallest even number of at least ``length`` with no prime factor above 7, quick to transform."""
    candidate = length + length % 2
    while True:
        rest = candidate
        for prime in (2, 3, 5, 7):
            while rest % prime == 0:
                rest //= prime
        if rest == 1:
            return candidate
        candidate += 2


def frequency_grid(grid: Size, *, device: torch.device | str | None = None) -> tuple[Tensor, Tensor]:
    """Frequencies of a `spectrum`'s rows, (H, 1), and columns, (1, W // 2 + 1), in cycles per pixel."""
    rows = torch.fft.fftfreq(grid[0], device=device)[:, None]
    return rows, torch.fft.rfftfreq(grid[1], device=device)[None]


def gaussian_transfer(grid: Size, sigma: float, *, device: torch.device | str | None = None) -> Tensor:
    """What a blur by a Gaussian of standard deviation ``sigma`` in pixels multiplies a `spectrum` with."""
    rows, columns = frequency_grid(grid, device=device)
    return torch.exp(-2 * math.pi**2 * sigma**2 * (rows.square() + columns.square()))


def spectrum(image: Tensor, grid: Size) -> Spectrum:
    """Real Fourier transform of a picture, zero-padded at the bottom and the right to ``grid``."""
    # Rows first, so that the rows which are only padding are never transformed.
    rows = torch.fft.rfft(image.float(), n=grid[1])
    return torch.fft.fft(rows, n=grid[0], dim=-2)


def inverse_spectrum(spectrum: Tensor, grid: Size, size: Size) -> Image:
    """Top left ``size`` of the picture on ``grid`` that has this spectrum."""
    rows = torch.fft.ifft(spectrum, dim=-2)[..., : size[0], :]
    # In one piece: MKL takes half as long again for rows that it must gather itself.
    return torch.fft.irfft(rows.contiguous(), n=grid[1])[..., : size[1]]


def frequencies(length: int) -> Tensor:
    """Frequencies of a grid's transform in cycles a sample, float64, origin first."""
    return torch.fft.fftfreq(length, dtype=torch.float64)


def filter_field(field: Tensor, transfer: Tensor) -> Tensor:
    """Multiply the spectrum of a complex field, zero-padded at the bottom and the right, with a transfer function.

    Args:
        field: complex, at most as large as ``transfer``.
        transfer: complex, of the whole grid, origin first.
    """
    # Rows first and columns last, so that rows which are only padding are never transformed.
    rows = torch.fft.fft(field.to(torch.complex64), n=transfer.shape[1])
    return torch.fft.ifft2(torch.fft.fft(rows, n=transfer.shape[0], dim=0).mul_(transfer))


def transfer_function(psf: Psf, grid: Size, origin: Size | None = None) -> Spectrum:
    """Spectrum of a PSF whose pixel ``origin`` is moved to (0, 0).

    Args:
        psf: (B, C, h, w), at most as large as ``grid``.
        grid: the size to transform at.
        origin: the pixel that stands for "no displacement"; the centre ``(h // 2, w // 2)`` unless given.
    """
    height, width = psf.shape[-2:]
    if height > grid[0] or width > grid[1]:
        raise ShapeError(f"`psf` ({height} x {width}) must not be larger than the grid ({grid[0]} x {grid[1]}).")
    row, column = (height // 2, width // 2) if origin is None else origin
    padded = torch.nn.functional.pad(psf.float().contiguous(), (0, grid[1] - width, 0, grid[0] - height))
    return spectrum(padded.roll((-row, -column), dims=(-2, -1)), grid)


def _operator(psf: Tensor, scene: Size, sensor: Size, *, circular: bool) -> tuple[Spectrum, Size]:
    """Transfer function that takes a scene at (0, 0) to a sensor at (0, 0), their centres aligned; and its grid.

    The grid must be so long that no wrapped end of the full convolution lands on the sensor. Counted from the
    centres, the sensor is [-(o//2), o-o//2-1] and the full convolution [-(s//2+p//2), (s-s//2-1)+(p-p//2-1)], so
    the grid needs 1 + the larger of the two overhangs: 1.5 n for equal sizes n, where 2 n is the usual choice.
    """
    grid, origin = [], []
    for s, o, p in zip(scene, sensor, psf.shape[-2:], strict=True):
        before = s // 2 + p // 2 + (o - o // 2 - 1)
        after = (s - s // 2 - 1) + (p - p // 2 - 1) + o // 2
        grid.append(max(s, o) if circular else fast_length(max(1 + before, 1 + after, s, o, p)))
        origin.append(p // 2 + s // 2 - o // 2)
    size = (grid[0], grid[1])
    return transfer_function(psf, size, (origin[0], origin[1])), size


def check_fit(image: Tensor, psf: Tensor, name: str) -> None:
    """Raise a `ShapeError` unless the PSF's batch and channels are 1 or those of the picture called ``name``."""
    for axis, of in ((0, "batch"), (1, "channels")):
        if psf.shape[axis] not in (1, image.shape[axis]):
            raise ShapeError(f"`psf` {tuple(psf.shape)} must have {of} 1 or that of `{name}` {tuple(image.shape)}.")


def convolve(scene: Scene, psf: Psf, *, size: Size | None = None, circular: bool = False) -> Image:
    """Convolution of a scene with a PSF, as seen by a sensor of ``size`` whose centre faces the scene's centre.

    Args:
        scene: (B, C, H, W).
        psf: (1 or B, 1 or C, h, w), centred at ``(h // 2, w // 2)``.
        size: height and width of the result; the scene's unless given. A smaller one crops, as a sensor does.
        circular: let what leaves the scene at one border enter at the other, instead of leaving for good.

    Returns:
        (B, C, *size), float32.

    Raises:
        ShapeError: batch, channels or (circular only) sizes do not fit.

    References:
        Eq. (1) of the MWDN paper, without the noise.
    """
    check_fit(scene, psf, "scene")
    size = size or (scene.shape[-2], scene.shape[-1])
    transfer, grid = _operator(psf, (scene.shape[-2], scene.shape[-1]), size, circular=circular)
    return inverse_spectrum(spectrum(scene, grid) * transfer, grid, size)


def correlate(measurement: Measurement, psf: Psf, *, size: Size | None = None, circular: bool = False) -> Scene:
    """Exact adjoint of `convolve`: ``<convolve(v, psf), b> == <v, correlate(b, psf)>``.

    Args:
        measurement: (B, C, H, W).
        psf: as for `convolve`.
        size: height and width of the scene; the measurement's unless given.
        circular: as for `convolve`.

    Returns:
        (B, C, *size), float32.
    """
    check_fit(measurement, psf, "measurement")
    size = size or (measurement.shape[-2], measurement.shape[-1])
    transfer, grid = _operator(psf, size, (measurement.shape[-2], measurement.shape[-1]), circular=circular)
    return inverse_spectrum(spectrum(measurement, grid) * transfer.conj(), grid, size)


class Convolution(NamedTuple):
    """`convolve` and `correlate` between fixed sizes, for a method that needs both many times: see `convolution`."""

    transfer: Spectrum
    grid: Size
    scene: Size
    sensor: Size

    def forward(self, scene: Scene) -> Image:
        """What the sensor sees of a scene."""
        return inverse_spectrum(spectrum(scene, self.grid) * self.transfer, self.grid, self.sensor)

    def adjoint(self, measurement: Measurement) -> Scene:
        """Exact adjoint of `forward`."""
        return inverse_spectrum(spectrum(measurement, self.grid) * self.transfer.conj(), self.grid, self.scene)


def convolution(psf: Psf, scene: Size, sensor: Size) -> Convolution:
    """Linear convolution of scenes with a PSF that is transformed once, here."""
    transfer, grid = _operator(psf, scene, sensor, circular=False)
    return Convolution(transfer, grid, scene, sensor)


def deconvolution_grid(size: Size, boundary: Boundary) -> Size:
    """Grid on which a measurement of ``size`` is deconvolved: 1.5 times as long, or itself if circular."""
    if boundary == "circular":
        return size
    return fast_length(size[0] + size[0] // 2), fast_length(size[1] + size[1] // 2)


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
        boundary: what stands beyond the measurement's border, see `Boundary`.

    Returns:
        (B, C, H, W), float32; its range is that of ``measurement`` over the sum of ``psf``.

    Raises:
        ShapeError: batch or channels do not fit.
        ParameterError: ``regularisation`` is a number that is not positive, or ``boundary`` is unknown.

    References:
        N. Wiener, Extrapolation, Interpolation, and Smoothing of Stationary Time Series (1949).
    """
    check_fit(measurement, psf, "measurement")
    grid = deconvolution_grid((measurement.shape[-2], measurement.shape[-1]), boundary)
    return filtered(measurement.float(), wiener_transfer(psf, regularisation, grid), grid, boundary)


def wiener_transfer(psf: Psf, regularisation: float | Tensor, grid: Size) -> Spectrum:
    """Transfer function of the Wiener filter, ``conj(H) / (|H|^2 + lambda)``; what it needs of a camera.

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


def filtered(image: Tensor, transfer: Tensor, grid: Size, boundary: Boundary) -> Tensor:
    """Multiply a picture's spectrum with a transfer function: the picture continued to ``grid``, the result cropped.

    On a CPU a few channels at a time, whose planes stay in its cache: fresh memory for a whole spectrum costs more
    than the transforms. The gradient transforms the picture again rather than keep its spectrum.

    Args:
        image: (B, C, H, W), also in half precision.
        transfer: (1 or B, 1 or C, height, width // 2 + 1), complex.
        grid: (height, width), at least (H, W).
        boundary: see `Boundary`.

    Returns:
        Of the shape, the precision and the memory format of ``image``; computed in float32.
    """
    if torch.compiler.is_compiling():  # also an export: one transform of everything is simpler to write down
        spread = spectrum(extend(image.float(), grid, boundary), grid)
        return inverse_spectrum(transfer * spread, grid, (image.shape[-2], image.shape[-1])).to(image.dtype)
    return _Filter.apply(image, transfer, grid, boundary)  # type: ignore[no-untyped-call]


class _Filter(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, image: Tensor, transfer: Tensor, grid: Size, boundary: Boundary) -> Tensor:  # noqa: ANN401
        ctx.save_for_backward(image, transfer)
        ctx.grid, ctx.boundary = grid, boundary
        return in_parts(lambda few, own: _filtered(few, own, grid, boundary), image, transfer)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, Tensor | None, None, None]:  # noqa: ANN401
        image, transfer = ctx.saved_tensors
        (to_image, to_transfer, *_), grid, size = ctx.needs_input_grad, ctx.grid, (image.shape[-2], image.shape[-1])
        slopes, planes = planar(gradient), planar(image) if to_transfer else image
        image_slope = torch.empty_like(slopes) if to_image else None
        transfer_slope = torch.zeros_like(transfer) if to_transfer else None
        continued = Continuation(size, grid, ctx.boundary, slopes)
        for part in together(slopes, grid):
            G = torch.fft.rfft2(slopes[part].float(), s=grid)
            if transfer_slope is not None:
                of_part = _of(transfer_slope, part)
                product = torch.fft.rfft2(continued(planes[part])).conj().resolve_conj().mul_(G)
                of_part.add_(product if of_part.shape[1] > 1 else product.sum(1, keepdim=True))
            if image_slope is not None:
                G.mul_(_of(transfer, part).conj())
                image_slope[part] = continued.adjoint(inverse_spectrum(G, grid, grid))
        if transfer_slope is not None:
            # Half a spectrum: a column stands for itself and its mirror image, but for the first and, of an even
            # width, the last; and the inverse transform divides by the number of pixels.
            transfer_slope.div_(grid[0] * grid[1])[..., 1 : (grid[1] + 1) // 2].mul_(2)
        slope = None if image_slope is None else laid_out_as(image, image_slope).to(image.dtype)
        return slope, transfer_slope, None, None


def _filtered(image: Tensor, transfer: Tensor, grid: Size, boundary: Boundary) -> Tensor:
    if transfer.shape[1] == 1 and image.shape[1] % 2 == 0:
        return _filtered_pairs(image, transfer, grid, boundary)
    planes, size = planar(image), (image.shape[-2], image.shape[-1])
    result = torch.empty_like(planes)
    continued = Continuation(size, grid, boundary, planes)
    for part in together(planes, grid):
        V = torch.fft.rfft2(continued(planes[part])).mul_(_of(transfer, part))
        result[part] = inverse_spectrum(V, grid, size)
    return laid_out_as(image, result)


def _filtered_pairs(image: Tensor, transfer: Tensor, grid: Size, boundary: Boundary) -> Tensor:
    """What one filter with a real kernel does to two channels, it does to both at once as a complex plane.

    A complex transform of two axes is one call of MKL, there and back; back to real numbers it takes several, with
    copies between them.
    """
    pairs, (height, width) = paired(image), (image.shape[-2], image.shape[-1])
    result = torch.empty(pairs.shape, dtype=image.dtype, device=image.device)
    continued = Continuation((height, width), grid, boundary, image)
    whole = _whole(transfer, grid[1])
    for part in together(pairs, grid):
        V = torch.fft.fft2(continued(pairs[part])).mul_(_of(whole, part))
        result[part] = torch.view_as_real(torch.fft.ifft2(V)[..., :height, :width])
    return unpaired(result, image)


def _whole(half: Spectrum, width: int) -> Tensor:
    """The spectrum of a real picture of this width, from its half."""
    mirrored = half[..., 1 : (width + 1) // 2].flip((-2, -1)).roll(1, -2).conj()
    return torch.cat([half, mirrored], dim=-1)


def _of(transfer: Tensor, part: tuple[slice, slice]) -> Tensor:
    """What of a transfer function belongs to some channels of a sample."""
    sample, channels = part
    own = transfer[sample] if len(transfer) > 1 else transfer
    return own[:, channels] if own.shape[1] > 1 else own

"""A camera as an operator of SCICO, made of SCICO's own parts: jax can compile and differentiate it."""

from typing import Any

from mwdn.arguments import checked
from mwdn.bridges.forward_model import ForwardModel
from mwdn.fourier.transforms import fast_length
from mwdn.optics import Camera
from mwdn.runtime.requirement import require
from mwdn.types import Size


@checked
def scico_operator(camera: Camera, *, scene_size: Size | None = None, channels: int | None = None) -> Any:  # noqa: ANN401
    """The forward model as a `scico.linop.LinearOperator` from scenes (C, H, W) to measurements (C, h, w), float32.

    Args:
        camera: with one PSF.
        scene_size: height and width of scenes; the sensor's unless given.
        channels: of scenes and measurements; those of the PSF unless given.

    Raises:
        MissingPackageError: scico is not installed.
        ShapeError: the PSF has another number of channels, or there is one for each sample of a batch.
    """
    linop = require("scico.linop", "scico")
    numpy = require("scico.numpy", "scico")
    model = ForwardModel.of(camera, scene_size, channels)
    psf = camera.psf[0].detach().cpu().numpy()
    pad, crop, grid = [(0, 0)], [(0, 0)], [model.scene[0]]
    for s, o, p in zip(model.scene[1:], model.measurement[1:], psf.shape[1:], strict=True):
        # The scene starts at `start`, the sensor at `first`: no end of the full convolution leaves the grid and wraps.
        start = p // 2 + max(0, o // 2 - s // 2)
        first = start + s // 2 - o // 2
        length = fast_length(max(start + s + p - p // 2 - 1, first + o))
        pad.append((start, length - start - s))
        crop.append((first, length - first - o))
        grid.append(length)
    shape, centre = tuple(grid), [length // 2 for length in psf.shape[1:]]
    convolve = linop.CircularConvolve(numpy.array(psf), shape, ndims=2, h_center=centre)
    return linop.Crop(crop, shape) @ convolve @ linop.Pad(model.scene, pad_width=pad)

"""A camera as a matrix for scipy: `scipy.sparse.linalg.LinearOperator`."""

from collections.abc import Callable
from math import prod
from typing import Any

import numpy as np
import torch
from torch import Tensor

from mwdn.arguments import checked
from mwdn.bridges.forward_model import ForwardModel, Shape
from mwdn.errors import ParameterError
from mwdn.optics import Camera, FieldCamera
from mwdn.runtime.requirement import require
from mwdn.types import Size


@checked
def linear_operator(
    camera: Camera | FieldCamera, *, scene_size: Size | None = None, channels: int | None = None
) -> Any:  # noqa: ANN401
    """The forward model as a `scipy.sparse.linalg.LinearOperator`, for `lsqr`, `lsmr`, `svds` and others.

    A vector is a scene (C, H, W) or a measurement (C, h, w), flattened: ``scene.ravel()``. Products are computed in
    float32, on the device of the PSF; those with several columns as one batch. So a relative tolerance below 1e-6 is
    never reached.

    Args:
        camera: with one PSF.
        scene_size: height and width of scenes; the sensor's unless given.
        channels: of scenes and measurements; those of the PSF unless given.

    Raises:
        MissingPackageError: scipy is not installed.
        ShapeError: the PSF has another number of channels, or there is one for each sample of a batch.
    """
    linalg = require("scipy.sparse.linalg", "scipy")
    model = ForwardModel.of(camera, scene_size, channels)
    psf = camera.kernels if isinstance(camera, FieldCamera) else camera.psf
    forward = _on_columns(model.forward, model.scene, psf.device)
    adjoint = _on_columns(model.adjoint, model.measurement, psf.device)
    return linalg.LinearOperator(
        (prod(model.measurement), prod(model.scene)),
        matvec=forward,
        rmatvec=adjoint,
        matmat=forward,
        rmatmat=adjoint,
        dtype=np.dtype(np.float32),
    )


def _on_columns(
    function: Callable[[Tensor], Tensor], shape: Shape, device: torch.device
) -> Callable[[np.ndarray], np.ndarray]:
    """The function on each column of an array (N,) or (N, K), as a batch of K."""

    @torch.no_grad()
    def call(columns: np.ndarray) -> np.ndarray:
        if np.iscomplexobj(columns):
            raise ParameterError(f"Vectors ({columns.dtype}) must be real: light. Apply it to `x.real` and `x.imag`.")
        batch = np.ascontiguousarray(columns.T, np.float32).reshape(-1, *shape)
        result = function(torch.from_numpy(batch).to(device)).cpu().flatten(1).numpy()
        return result.T.reshape(-1, *columns.shape[1:])

    return call

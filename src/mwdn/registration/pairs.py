"""From captured pairs to aligned ones: the displayed pictures warped to the camera's frame."""

import json
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from mwdn.calibration.psf_identity import psf_identity
from mwdn.data.pair_checks import DISPLAY_WHITE, REFINED
from mwdn.data.pair_writer import Attribute
from mwdn.data.pairs import PairFile
from mwdn.errors import AlignmentError
from mwdn.fourier.convolution import convolve
from mwdn.inference.reconstructor import Reconstructor
from mwdn.registration.captured import SessionPairs
from mwdn.registration.projection import Projection
from mwdn.registration.registration import KEY
from mwdn.registration.views import Views
from mwdn.registration.warp import warp_pictures
from mwdn.types import Psf, size_of

Track = Callable[[list[int]], Iterable[int]]


def chosen(count: int, most: int) -> list[int]:
    """At most ``most`` positions of ``count``, evenly spread."""
    step = max(1.0, count / most)
    return [int(step * number) for number in range(min(count, most))]


def reconstruct_views(pairs: SessionPairs, reconstruct: Reconstructor, rows: list[int], track: Track = iter) -> Views:
    """Reconstruct the session's patterns and some of the captures, for `mwdn.registration.estimate`.

    Raises:
        MwdnError: a pair is damaged, or does not fit the camera.
    """
    scenes, pictures = [], []
    for measurement, picture in pairs.patterns():
        scenes.append(reconstruct(measurement)[0])
        pictures.append(picture[0])
    for row in track(rows):
        scenes.append(reconstruct(pairs.measurement(row))[0])
        pictures.append(pairs.picture(row)[0])
    return Views.of(pictures, scenes)


def fit_levels(pairs: SessionPairs, projection: Projection, psf: Psf, rows: list[int]) -> Tensor:
    """Light of the display's white in each colour of the measurements, (C,), by least squares over some pairs.

    A measurement is ``g_c h * s_c + o_c``, with s the displayed picture in the camera's frame, and o the room's light.

    Raises:
        AlignmentError: a colour does not grow with the displayed light.
    """
    shown, measured = [], []
    for row in rows:
        measurement = pairs.measurement(row)
        scene = warp_pictures(pairs.picture(row), projection)
        shown.append(_coarse(convolve(_like(scene, measurement), psf)))
        measured.append(_coarse(measurement))
    x, y = (torch.cat(parts).movedim(1, 0).flatten(1).double() for parts in (shown, measured))
    x, y = x - x.mean(1, keepdim=True), y - y.mean(1, keepdim=True)
    gains = (x * y).sum(1) / x.square().sum(1).clamp(min=1e-12)
    if not (gains > 0).all():
        raise AlignmentError(
            "The measurements do not grow with the displayed light. Check the PSF, and that pictures and captures "
            "belong together; without levels: `--no-levels`."
        )
    return gains.float()


def write_aligned(
    path: Path,
    pairs: SessionPairs,
    projection: Projection,
    content: Mapping[str, Any],
    *,
    levels: Tensor | None = None,
    track: Track = iter,
) -> None:
    """Write measurements and their scenes in the camera's frame to a file of pairs.

    Args:
        path: ends in .h5; it appears when it is complete.
        pairs: captured.
        projection: from the displayed pictures to the camera.
        content: of the registration, stored with the pairs.
        levels: (C,), result of `fit_levels`: scene and measurement are scaled so that a PSF of unit sum leads from one
            to the other, and the display's white is 1 in its brightest colour. ``None`` leaves both as they are.
        track: wraps the positions, for a progress bar.

    Raises:
        MwdnError: a pair is damaged, does not fit the camera, or the file cannot be written.
    """
    first = pairs.measurement(0)
    projection.check_camera(size_of(first))
    brightest = 1.0 if levels is None else float(levels.max())
    colours = torch.ones(first.shape[1]) if levels is None else levels / brightest
    shape = (*first.shape[-2:], first.shape[1])
    attributes: dict[str, Attribute] = {
        KEY: json.dumps(content, allow_nan=False),
        **psf_identity(pairs.calibration),
        "source": pairs.path.name,
        DISPLAY_WHITE: brightest,
        **({REFINED: "align"} if pairs.calibration.refinement else {}),
    }
    with PairFile.create(
        path, measurement_shape=shape, scene_shape=shape, attributes=attributes, psf=pairs.calibration.psf
    ) as file:
        for row in track(list(range(len(pairs)))):
            measurement = pairs.measurement(row) / brightest
            scene = _like(warp_pictures(pairs.picture(row), projection), measurement)
            file.append(measurement, scene * colours[:, None, None])


def _like(scene: Tensor, measurement: Tensor) -> Tensor:
    """The scene with the measurement's number of channels."""
    channels = measurement.shape[1]
    if scene.shape[1] == channels:
        return scene
    return scene.mean(1, keepdim=True).expand(-1, channels, -1, -1)


def _coarse(image: Tensor) -> Tensor:
    factor = max(1, min(image.shape[-2:]) // 64)
    return torch.nn.functional.avg_pool2d(image, factor)

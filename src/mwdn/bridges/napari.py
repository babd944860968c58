"""The napari plugin: files of lensless cameras as layers, and a widget that reconstructs them (`napari.yaml`)."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch

from mwdn.calibration import Calibration
from mwdn.data.pair_writer import PAIR_SUFFIXES
from mwdn.data.pairs import PairFile
from mwdn.errors import ParameterError
from mwdn.inference.reconstructor import Reconstructor
from mwdn.io.contact_sheets import to_display
from mwdn.io.images import read_frame, srgb_encode
from mwdn.io.raw import RAW
from mwdn.runtime.requirement import require
from mwdn.types import FloatFrame, Frame
from mwdn.weights.bundled import BUNDLED

WIDGET_METHODS = (*BUNDLED, "pyramid", "admm", "fista", "wiener")
"""Choices of the widget."""

READ_SUFFIXES = frozenset({*PAIR_SUFFIXES, ".toml", ".npy", ".png", ".tif", ".tiff"}) | RAW
"""Of the files that are read."""

Layer = tuple[Any, dict[str, Any], str]
"""Numbers, options and kind of a layer of napari."""


def get_reader(path: str | list[str]) -> Callable[[str | list[str]], list[Layer]] | None:
    """The reader of one file or several, for napari; `None` for files of other kinds.

    - Pairs (``.h5``): stacks of measurements and scenes, each picture read when it is shown.
    - A camera file (``.toml``): its PSF.
    - Captures (PNG, TIFF, NPY, raw files of cameras): the numbers as stored, which the widget takes.
    """
    return _read if all(Path(each).suffix.lower() in READ_SUFFIXES for each in _paths(path)) else None


def _paths(path: str | list[str]) -> list[str]:
    return [path] if isinstance(path, str) else path


def _read(path: str | list[str]) -> list[Layer]:
    return [layer for each in _paths(path) for layer in _layers(Path(each))]


def _layers(path: Path) -> list[Layer]:
    if path.suffix.lower() in PAIR_SUFFIXES:
        file = PairFile(path)
        shapes = {"measurement": file.measurement_shape, "scene": file.scene_shape}
        return [_layer(_stack(file, part, shapes[name]), f"{path.stem} {name}") for part, name in enumerate(shapes)]
    if path.suffix.lower() == ".toml":
        psf = Calibration.from_file(path).psf
        return [_layer((psf / psf.max())[0].movedim(0, -1).numpy(), f"{path.stem} PSF")]
    return [_layer(read_frame(path), path.stem)]


def _stack(file: PairFile, part: int, shape: tuple[int, ...]) -> Any:  # noqa: ANN401
    """Measurements (part 0) or scenes (part 1) of a file, (N, H, W, C), each read when it is shown."""
    dask, array = (require(module, "napari") for module in ("dask", "dask.array"))

    def read(index: int) -> FloatFrame:
        return file[index][part].movedim(0, -1).numpy()

    return array.stack([array.from_delayed(dask.delayed(read)(i), shape, np.float32) for i in range(len(file))])


def _layer(data: Any, name: str) -> Layer:  # noqa: ANN401
    """An image layer, in colour or without the axis of its one channel."""
    rgb = data.shape[-1] == 3
    return data if rgb else data[..., 0], {"name": name, "rgb": rgb}, "image"


def reconstruct_layer(frame: Frame, psf: Path, method: str, name: str) -> Layer:
    """Reconstruct a capture as a layer: sRGB for viewing, the linear numbers in its metadata.

    Args:
        frame: (H, W) or (H, W, 1 or 3), the sensor's numbers.
        psf: camera file, or picture of a point source.
        method: as for `mwdn.Reconstructor`.
        name: of the capture.

    Raises:
        MwdnError: files or method cannot be used, or do not fit the capture.
    """
    reconstruct = Reconstructor(method, Calibration.from_file(psf))
    scene = reconstruct(np.ascontiguousarray(frame))
    shown = srgb_encode(torch.from_numpy(to_display(scene))).numpy()
    about = {"method": method, "psf_hash": reconstruct.calibration.psf_hash, "scene": scene}
    data, options, kind = _layer(shown, f"{name}, {method}")
    return data, options | {"metadata": {"mwdn": about}}, kind


def reconstruct_widget() -> Any:  # noqa: ANN401
    """The widget: a capture's layer, the PSF and a method; the picture becomes a layer. napari stays usable meanwhile.

    Raises:
        MissingPackageError: napari is not installed.
    """
    names = ("magicgui", "napari", "napari.layers", "napari.types", "napari.qt.threading")
    magicgui, napari, layers, types, threading = (require(name, "napari") for name in names)

    def reconstruct(capture: Any, psf: Path, method: str = WIDGET_METHODS[0]) -> Any:  # noqa: ANN401
        if capture is None or not psf.is_file():
            raise ParameterError("Choose the layer of a capture, and a camera file or the picture of a point source.")
        viewer, frame = napari.current_viewer(), capture.data
        stacked = frame.ndim - 2 - capture.rgb  # of a stack, the picture that is shown
        position = viewer.dims.current_step[:stacked] if stacked else ()
        given = (np.asarray(frame[position]), psf, method, capture.name)
        return threading.create_worker(reconstruct_layer, *given, _start_thread=True)

    # magicgui reads the types of napari from the annotations.
    worker = threading.FunctionWorker[types.LayerDataTuple]
    reconstruct.__annotations__ |= {"capture": layers.Image, "return": worker}
    files = "*.toml *.png *.tif *.tiff *.npy"
    psf, methods = {"filter": files}, {"choices": WIDGET_METHODS}
    return magicgui.magicgui(reconstruct, call_button="Reconstruct", psf=psf, method=methods)

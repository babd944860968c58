"""Image reconstruction for lensless cameras, in PyTorch.

>>> from mwdn import Calibration, Reconstructor, read_frame, to_display, write_picture
>>> calibration = Calibration.from_file("psf.png")
>>> reconstruct = Reconstructor("universal", calibration)
>>> scene = reconstruct(read_frame("capture.png"))
>>> write_picture("scene.png", to_display(scene))

Subpackages: `mwdn.solvers` (ADMM, FISTA, ...), `mwdn.networks` (MWDN, MWDN-CPSF, ...),
`mwdn.optics` (masks, PSFs, forward models), `mwdn.data` (pairs), `mwdn.training`, `mwdn.evaluation`, `mwdn.export`.
"""

import warnings
from importlib import import_module
from typing import Any

from mwdn import networks, solvers
from mwdn.calibration import Calibration, FrameFormat
from mwdn.errors import MwdnError
from mwdn.fourier import convolve, correlate, wiener
from mwdn.inference import Reconstructor
from mwdn.io import read_frame, read_picture, write_linear, write_picture
from mwdn.io.contact_sheets import to_display
from mwdn.networks import build
from mwdn.optics import Camera, Sensor
from mwdn.runtime.memory import keep_memory
from mwdn.solvers import align
from mwdn.version import __version__ as __version__
from mwdn.weights import load_network

__all__ = [
    "Calibration",
    "Camera",
    "FrameFormat",
    "MwdnError",
    "Reconstructor",
    "Sensor",
    "align",
    "build",
    "convolve",
    "correlate",
    "keep_memory",
    "load_network",
    "lpips",
    "networks",
    "psnr",
    "read_frame",
    "read_picture",
    "simulate",
    "solvers",
    "ssim",
    "to_display",
    "train",
    "wiener",
    "write_linear",
    "write_picture",
]

# Imported at first use: together they take as long as everything above.
_LATER = {
    "lpips": "mwdn.evaluation.distances",
    "psnr": "mwdn.evaluation.metrics",
    "simulate": "mwdn.training.experiment",
    "ssim": "mwdn.evaluation.distances",
    "train": "mwdn.training.experiment",
}
_FOLDERS = ("data", "evaluation", "export", "training")
_RENAMED = {"for_people": "to_display"}


def __getattr__(name: str) -> Any:  # noqa: ANN401
    if name in _LATER:
        return getattr(import_module(_LATER[name]), name)
    if name in _FOLDERS:
        return import_module(f"mwdn.{name}")
    if name in _RENAMED:
        warnings.warn(f"`mwdn.{name}` is now `mwdn.{_RENAMED[name]}`.", DeprecationWarning, stacklevel=2)
        return globals()[_RENAMED[name]]
    raise AttributeError(f"module 'mwdn' has no attribute '{name}'")

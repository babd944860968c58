"""Image reconstruction for lensless cameras, in PyTorch.

>>> from mwdn import Calibration, Reconstructor, to_display, write_picture
>>> calibration = Calibration.from_file("psf.png")
>>> reconstruct = Reconstructor("universal", calibration)
>>> scene = reconstruct(calibration.frames.read("capture.png"))
>>> write_picture("scene.png", to_display(scene))

Subpackages: `mwdn.solvers` (ADMM, FISTA, ...), `mwdn.networks` (MWDN, MWDN-CPSF, ...),
`mwdn.optics` (masks, PSFs, forward models), `mwdn.data` (pairs), `mwdn.training`, `mwdn.evaluation`, `mwdn.export`.

Each name is imported at its first use: torch takes two seconds, which `mwdn --version` need not wait for.
"""

import warnings
from importlib import import_module
from typing import TYPE_CHECKING, Any

from mwdn.first_use import at_first_use
from mwdn.version import __version__ as __version__

if TYPE_CHECKING:  # the names of _MODULES and _PACKAGES, for mypy and editors
    from mwdn import benchmark as benchmark
    from mwdn import bridges as bridges
    from mwdn import calibration as calibration
    from mwdn import capture as capture
    from mwdn import data as data
    from mwdn import diagnosis as diagnosis
    from mwdn import errors as errors
    from mwdn import evaluation as evaluation
    from mwdn import export as export
    from mwdn import fourier as fourier
    from mwdn import inference as inference
    from mwdn import io as io
    from mwdn import networks as networks
    from mwdn import optics as optics
    from mwdn import preview as preview
    from mwdn import registration as registration
    from mwdn import runtime as runtime
    from mwdn import solvers as solvers
    from mwdn import training as training
    from mwdn import types as types
    from mwdn import weights as weights
    from mwdn.calibration import Calibration, FrameFormat
    from mwdn.errors import MwdnError
    from mwdn.evaluation import lpips, psnr, ssim
    from mwdn.fourier import convolve, correlate, wiener
    from mwdn.inference import Reconstructor
    from mwdn.io import read_frame, read_picture, write_linear, write_picture
    from mwdn.io.contact_sheets import to_display
    from mwdn.networks import build
    from mwdn.optics import Camera, Sensor
    from mwdn.runtime import keep_memory
    from mwdn.solvers import align
    from mwdn.training.experiment import simulate, train
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

_PACKAGES = {
    *("benchmark", "bridges", "calibration", "capture", "data", "diagnosis", "errors", "evaluation", "export"),
    *("fourier", "inference", "io", "networks", "optics", "preview", "registration", "runtime", "solvers", "training"),
    *("types", "weights"),
}
_MODULES = {
    "Calibration": "calibration",
    "Camera": "optics",
    "FrameFormat": "calibration",
    "MwdnError": "errors",
    "Reconstructor": "inference",
    "Sensor": "optics",
    "align": "solvers",
    "build": "networks",
    "convolve": "fourier",
    "correlate": "fourier",
    "keep_memory": "runtime",
    "load_network": "weights",
    "lpips": "evaluation",
    "psnr": "evaluation",
    "read_frame": "io",
    "read_picture": "io",
    "simulate": "training.experiment",
    "ssim": "evaluation",
    "to_display": "io.contact_sheets",
    "train": "training.experiment",
    "wiener": "fourier",
    "write_linear": "io",
    "write_picture": "io",
}
"""Modules that hold the public names."""

_first_use = at_first_use(__name__, _MODULES)

_RENAMED = {"for_people": "to_display"}


def __getattr__(name: str) -> Any:  # noqa: ANN401
    """Import a public name at its first use (PEP 562); Python then finds it without this function."""
    if name in _RENAMED:
        new = _RENAMED[name]
        warnings.warn(f"`mwdn.{name}` is now `mwdn.{new}`.", DeprecationWarning, stacklevel=2)
        return __getattr__(new)
    if name in _PACKAGES:
        return import_module(f"mwdn.{name}")
    return _first_use(name)


def __dir__() -> list[str]:
    return sorted({*globals(), *_MODULES, *_PACKAGES})

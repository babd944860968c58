"""From the caustic pattern of a lensless camera to a picture.

>>> from mwdn import Calibration, Reconstructor, to_display, read_frame, write_picture
>>> calibration = Calibration.from_file("psf.png")
>>> reconstruct = Reconstructor("universal", calibration)
>>> scene = reconstruct(calibration.correct(read_frame("capture.png")))
>>> write_picture("scene.png", to_display(scene))
"""

from mwdn.calibration import Calibration
from mwdn.errors import MwdnError
from mwdn.fourier.convolution import convolve, correlate
from mwdn.fourier.wiener import wiener
from mwdn.inference.reconstructor import Reconstructor
from mwdn.io.contact_sheets import to_display
from mwdn.io.images import read_frame, read_picture, write_linear, write_picture
from mwdn.networks import build
from mwdn.optics import Camera, Sensor
from mwdn.runtime.memory import keep_memory
from mwdn.version import __version__ as __version__

__all__ = [
    "Calibration",
    "Camera",
    "MwdnError",
    "Reconstructor",
    "Sensor",
    "build",
    "convolve",
    "correlate",
    "to_display",
    "keep_memory",
    "read_frame",
    "read_picture",
    "wiener",
    "write_linear",
    "write_picture",
]

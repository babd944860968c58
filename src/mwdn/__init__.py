"""From the caustic pattern of a lensless camera to a picture.

>>> from mwdn import Calibration, Reconstructor, for_people, read_frame, write_picture
>>> calibration = Calibration.from_file("psf.png")
>>> reconstruct = Reconstructor("universal", calibration)
>>> scene = reconstruct(calibration.correct(read_frame("capture.png")))
>>> write_picture("scene.png", for_people(scene))
"""

from mwdn.calibration import Calibration
from mwdn.data import read_frame, read_picture, write_linear, write_picture
from mwdn.data.sheets import for_people
from mwdn.deconvolution import wiener
from mwdn.errors import MwdnError
from mwdn.fourier import convolve, correlate
from mwdn.memory import keep_memory
from mwdn.networks import build
from mwdn.optics import Camera, Sensor
from mwdn.reconstruct import Reconstructor

__version__ = "0.1.0"

__all__ = [
    "Calibration",
    "Camera",
    "MwdnError",
    "Reconstructor",
    "Sensor",
    "build",
    "convolve",
    "correlate",
    "for_people",
    "keep_memory",
    "read_frame",
    "read_picture",
    "wiener",
    "write_linear",
    "write_picture",
]

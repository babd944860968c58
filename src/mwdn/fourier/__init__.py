"""Convolution, correlation and Wiener deconvolution by fast Fourier transforms."""

from mwdn.fourier.convolution import Convolution, check_fit, convolution, convolve, correlate
from mwdn.fourier.padding import Boundary
from mwdn.fourier.wiener import deconvolution_grid, wiener, wiener_transfer

__all__ = [
    "Boundary",
    "Convolution",
    "check_fit",
    "convolution",
    "convolve",
    "correlate",
    "deconvolution_grid",
    "wiener",
    "wiener_transfer",
]

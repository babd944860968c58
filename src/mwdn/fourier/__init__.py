"""Convolution, correlation and Wiener deconvolution by fast Fourier transforms."""

from mwdn.fourier.convolution import Convolution, check_fit, convolve, correlate
from mwdn.fourier.filtering import filter_image
from mwdn.fourier.padding import Boundary, pad
from mwdn.fourier.transforms import (
    fast_length,
    filter_field,
    frequencies,
    frequency_grid,
    gaussian_transfer,
    inverse_spectrum,
    plane_spectrum,
    spectrum,
    transfer_function,
)
from mwdn.fourier.wiener import deconvolution_grid, wiener, wiener_transfer

__all__ = [
    "Boundary",
    "Convolution",
    "check_fit",
    "convolve",
    "correlate",
    "deconvolution_grid",
    "fast_length",
    "filter_field",
    "filter_image",
    "frequencies",
    "frequency_grid",
    "gaussian_transfer",
    "inverse_spectrum",
    "pad",
    "plane_spectrum",
    "spectrum",
    "transfer_function",
    "wiener",
    "wiener_transfer",
]

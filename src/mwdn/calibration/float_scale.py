"""Whether the floats of a capture are fractions of saturation."""

from mwdn.errors import ParameterError
from mwdn.types import Frame

MAX_FLOAT = 2.0
"""Largest number of a capture of floats, where 1 is saturation; noise and other steps of a pipeline exceed 1."""


def check_float_scale(frame: Frame, bit_depth: int | None) -> None:
    """Raise a `ParameterError` for floats far above 1, such as the numbers of 8 bits, without a bit depth.

    For captures only: the scale of a PSF does not matter.
    """
    if bit_depth is not None or frame.dtype.kind != "f" or not (largest := float(frame.max())) > MAX_FLOAT:
        return
    bits = next((bits for bits in (8, 10, 12, 14, 16) if largest < 2**bits), None)
    way_out = "" if bits is None else f", or give `bit_depth={bits}`"
    raise ParameterError(
        f"The frame holds floats up to {largest:g}, but 1 is saturation. Divide them by the camera's largest "
        f"number{way_out}."
    )

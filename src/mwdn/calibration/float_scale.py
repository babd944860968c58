"""Whether the floats of a frame are fractions of saturation."""

from mwdn.errors import ParameterError
from mwdn.types import Frame

MAX_FLOAT = 2.0
"""Largest number of a capture of floats, where 1 is saturation; noise and other steps of a pipeline exceed 1."""


def check_float_scale(frame: Frame, bit_depth: int | None, *, of: str | None = None) -> None:
    """Raise a `ParameterError` for floats far above 1, such as the numbers of 8 bits, without a bit depth.

    With one, for a capture whose floats are all at most 1: they are fractions of saturation, not the sensor's numbers.

    For captures, and for frames that are subtracted. The scale of a PSF from which nothing is subtracted does not
    matter.

    Args:
        frame: (H, W, C).
        bit_depth: of the frame's format.
        of: what the frame is, for the message; ``None`` for a capture. The bits of a capture are guessed from its
            largest number; a dark frame, for example, may be far below saturation.
    """
    if frame.dtype.kind != "f":
        return
    largest = float(frame.max())
    if bit_depth is not None and of is None and 0 < largest <= 1:
        raise ParameterError(
            f"The frame holds floats up to {largest:g}, but `bit_depth` ({bit_depth}) expects the sensor's numbers. "
            f"Multiply them by {2**bit_depth - 1:,}, or calibrate without a bit depth."
        )
    if bit_depth is not None or not largest > MAX_FLOAT:
        return
    way_out = ", or give the sensor's `bit_depth`"
    if not of:
        bits = next((bits for bits in (8, 10, 12, 14, 16) if largest < 2**bits), None)
        way_out = f", or give `bit_depth={bits}`" if bits else ""
    raise ParameterError(
        f"{of or 'The frame'} holds floats up to {largest:g}, but 1 is saturation. Divide them by the camera's largest "
        f"number{way_out}."
    )

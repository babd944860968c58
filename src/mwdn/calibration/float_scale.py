"""Whether the floats of a frame are fractions of saturation."""

from mwdn.errors import ParameterError
from mwdn.types import Frame

MAX_FLOAT = 2.0
"""Largest number of a capture of floats, where 1 is saturation; noise and other steps of a pipeline exceed 1."""


def check_float_scale(frame: Frame | None, bit_depth: int | None, what: str = "The frame") -> None:
    """Raise a `ParameterError` for floats far above 1, such as the numbers of 8 bits, without a bit depth.

    For captures, and for frames that are subtracted. The scale of a PSF from which nothing is subtracted does not
    matter.

    Args:
        frame: (H, W, C); ``None`` if there is none.
        bit_depth: of the frame's format.
        what: the frame, for the message. The bits of ``"The frame"`` are guessed from its largest number; other frames,
            as dark ones, may be far below saturation.
    """
    if frame is None or bit_depth is not None or frame.dtype.kind != "f":
        return
    if not (largest := float(frame.max())) > MAX_FLOAT:
        return
    bits = next((bits for bits in (8, 10, 12, 14, 16) if largest < 2**bits), None)
    way_out = "" if bits is None else f", or give `bit_depth={bits}`"
    if what != "The frame":
        way_out = ", or give the sensor's `bit_depth`"
    raise ParameterError(
        f"{what} holds floats up to {largest:g}, but 1 is saturation. Divide them by the camera's largest "
        f"number{way_out}."
    )

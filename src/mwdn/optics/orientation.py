"""Quarter turns and mirror images of a PSF about its centre."""

from typing import Literal, cast, get_args

from torch import Tensor

from mwdn.errors import UnknownNameError

Orientation = Literal[
    "flip-left-right", "flip-top-bottom", "rotate-90", "rotate-180", "rotate-270", "transpose", "transverse"
]
"""Rotations and mirror images of a square, except the identity, with the names of `PIL.Image.Transpose`. Rotations are
counter-clockwise, ``transpose`` swaps rows and columns, ``transverse`` also rotates by 180 degrees."""

_STEPS: dict[str, tuple[bool, bool, bool]] = {
    "flip-left-right": (False, False, True),
    "flip-top-bottom": (False, True, False),
    "rotate-90": (True, True, False),
    "rotate-180": (False, True, True),
    "rotate-270": (True, False, True),
    "transpose": (True, False, False),
    "transverse": (True, True, True),
}
"""Whether rows and columns are swapped, then whether rows, then whether columns are reversed."""

_NAMES = {steps: cast(Orientation, name) for name, steps in _STEPS.items()}


def turn(psf: Tensor, orientation: Orientation) -> Tensor:
    """Turn a PSF (..., H, W); its centre ``(H // 2, W // 2)`` stays the centre.

    Not for captures: they have no centre to keep, and for even lengths this moves one border line to the opposite
    border.

    Raises:
        UnknownNameError: no such orientation.
    """
    swap, rows, columns = _STEPS[check_orientation(orientation)]
    psf = psf.mT if swap else psf
    for axis, reverse in ((-2, rows), (-1, columns)):
        if reverse:
            # Reversing sends pixel n / 2 of an even length n to n / 2 - 1, one before the centre.
            psf = psf.flip(axis).roll(1 - psf.shape[axis] % 2, axis)
    return psf.contiguous()


def turn_displacement(down: float, right: float, orientation: Orientation) -> tuple[float, float]:
    """Displacement (down, right) of a point after `turn`."""
    swap, rows, columns = _STEPS[check_orientation(orientation)]
    down, right = (right, down) if swap else (down, right)
    return -down if rows else down, -right if columns else right


def compose(first: Orientation | None, second: Orientation | None) -> Orientation | None:
    """Single turn that equals ``first`` followed by ``second``; None for no turn."""
    if first is None or second is None:
        return first or second
    (swap, *reversed_axes), (swap_next, *reversed_next) = _STEPS[first], _STEPS[second]
    if swap_next:
        reversed_axes.reverse()  # after the swap, reversed rows are reversed columns
    rows, columns = (before != after for before, after in zip(reversed_axes, reversed_next, strict=True))
    return _NAMES.get((swap != swap_next, rows, columns))


def swaps_axes(orientation: Orientation | None) -> bool:
    """Whether a turn swaps rows and columns, so that the PSF's height becomes its width."""
    return orientation is not None and _STEPS[orientation][0]


def check_orientation(name: Orientation) -> Orientation:
    """Return the name, or raise an `UnknownNameError`."""
    if name not in _STEPS:
        raise UnknownNameError("orientation", name, get_args(Orientation))
    return name

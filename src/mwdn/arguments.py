"""Checks of arguments: of options by their annotated types, of batches of pictures, of light."""

import math
from collections.abc import Callable, Iterable, Mapping
from functools import cache, wraps
from inspect import Parameter, signature
from numbers import Integral, Real
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

from mwdn.errors import ParameterError, ShapeError, UnknownNameError, shown

MIN_LIGHT = 1e-12
MAX_LIGHT = 1e15
"""Range of the largest number of a measurement, whose squares and their sums over 1e8 pixels float32 must hold."""

_WORDS = {int: "a whole number", float: "a number", bool: "true or false", str: "text", Path: "a path"}
_WORDS |= {NoneType: "none", Any: "any value"}
_COUNTS = {2: "two", 3: "three"}
_Checked = TypeVar("_Checked", bound=Callable[..., Any])


def check_options(of: Callable[..., Any], what: str, options: Mapping[str, Any]) -> None:
    """Check that a function or class takes these keyword arguments, and that each is of the annotated type.

    Args:
        of: the function or class.
        what: its name in the message, for example ``"network 'mwdn'"``.
        options: the keyword arguments.

    Raises:
        UnknownNameError: it does not take one of them, or a value is not among the names that an option allows.
        ParameterError: a value is of another type: text for a number, 1.5 for a whole number.
    """
    types, takes_any = _annotations(of)
    for option, value in options.items():
        if option not in types and not takes_any:
            raise UnknownNameError(f"option of {what}", option, types)
        if option in types and not fits_type(value, types[option]):
            names = _names(types[option])
            if isinstance(value, str) and names:
                raise UnknownNameError(option, value, names)
            raise ParameterError(f"`{option}` ({shown(value)}) of {what} must be {type_in_words(types[option])}.")
        if isinstance(value, int | float) and not abs(value) < 2**63:
            raise ParameterError(f"`{option}` ({shown(value)}) of {what} must be finite, and below 2^63.")


def checked(decorated: _Checked) -> _Checked:
    """Decorate a class or a function: `check_options` checks the arguments of each new object, or of each call."""
    kind: Any = decorated
    is_class = isinstance(kind, type)
    function = kind.__init__ if is_class else kind

    @wraps(function)
    def call(*values: Any, **options: Any) -> Any:  # noqa: ANN401
        # A mistake in the number of positional arguments is Python's to report.
        given = dict(zip(_annotations(kind)[0], values[is_class:], strict=False)) | options
        check_options(kind, f"`{kind.__name__}`", given)
        return function(*values, **options)

    if is_class:
        kind.__init__ = call
    return kind if is_class else call  # type: ignore[return-value]


@cache
def _annotations(of: Callable[..., Any]) -> tuple[dict[str, Any], bool]:
    """Annotated type of each argument, `Any` if there is none; and whether the function takes any other name."""
    function: Any = of
    try:
        hints = get_type_hints(function.__init__ if isinstance(of, type) else function)
    except NameError:  # annotations as text, of names that are local to a function
        hints = {}
    parameters = signature(of).parameters.values()
    types = {each.name: hints.get(each.name, Any) for each in parameters if each.kind is not Parameter.VAR_KEYWORD}
    return types, len(types) < len(parameters)


def fits_type(value: Any, kind: Any) -> bool:  # noqa: ANN401
    """Whether a value is of an annotated type; a whole number is a float, too, and a list a tuple."""
    origin, parts = get_origin(kind), get_args(kind)
    if origin in (Union, UnionType):
        return any(fits_type(value, part) for part in parts)
    if origin is Literal:
        return isinstance(value, str) and value in parts
    if origin is tuple:  # JSON and TOML have lists
        parts = parts[:1] * len(value) if parts[1:] == (...,) and isinstance(value, tuple | list) else parts
        return isinstance(value, tuple | list) and len(value) == len(parts) and all(map(fits_type, value, parts))
    if origin in (Callable, Iterable):
        return isinstance(value, origin)
    if kind in (int, float):
        return isinstance(value, Integral if kind is int else Real) and not isinstance(value, bool)
    return kind is Any or not isinstance(kind, type) or hasattr(kind, "array_type") or isinstance(value, kind)


def _names(kind: Any) -> list[str]:  # noqa: ANN401
    """The names that a type allows if it allows nothing else: those of a `Literal`, also beside `None`."""
    parts = get_args(kind) if get_origin(kind) in (Union, UnionType) else (kind,)
    kinds = [part for part in parts if part is not NoneType]
    return list(get_args(kinds[0])) if len(kinds) == 1 and get_origin(kinds[0]) is Literal else []


def type_in_words(kind: Any) -> str:  # noqa: ANN401
    """An annotated type as messages and lists call it: ``srgb, a number or none``, ``two whole numbers``."""
    *most, last = dict.fromkeys(_alternatives(kind))
    return f"{', '.join(most)} or {last}" if most else last


def _alternatives(kind: Any) -> list[str]:  # noqa: ANN401
    origin, parts = get_origin(kind), get_args(kind)
    if origin in (Union, UnionType):
        return [words for part in parts for words in _alternatives(part)]
    if origin is Literal:
        return list(map(str, parts))
    if origin is tuple and parts[0] in _WORDS and len(parts) in _COUNTS and ... not in parts:
        return [f"{_COUNTS[len(parts)]} {_WORDS[parts[0]].removeprefix('a ')}s"]
    if origin in (tuple, list):
        return [f"a {origin.__name__}, each {type_in_words(parts[0])}"]
    if origin in (Callable, Iterable):
        return ["a function" if origin is Callable else "a list, or another iterable"]
    return [_WORDS.get(kind) or f"`{getattr(kind, '__name__', kind)}`"]


def check_batch(image: Any, name: str) -> None:  # noqa: ANN401
    """Check that the image called ``name`` is a tensor of floats (B, C, H, W).

    Raises:
        ParameterError: no tensor; one of integers, complex numbers or 8-bit floats; sparse, or on the device "meta".
        ShapeError: it has other axes.
    """
    if not hasattr(image, "is_floating_point"):  # without torch, which takes seconds to import
        raise ParameterError(
            f"`{name}` ({shown(image)}) must be a tensor (B, C, H, W). `Calibration.correct` makes one of a frame, "
            "`Calibration.from_array` of the picture of a PSF."
        )
    if image.ndim != 4:
        raise ShapeError(f"`{name}` {tuple(image.shape)} must be (B, C, H, W). For one picture: `{name}[None]`.")
    if not image.is_floating_point() or image.dtype.itemsize < 2:
        way_out = f"Divide integers by the camera's largest number: `{name} / 255` for 8 bits."
        if image.is_complex():
            way_out = f"Its magnitude: `{name}.abs()`."
        elif image.is_floating_point():
            way_out = f"Convert it: `{name}.float()`."
        raise ParameterError(f"`{name}` ({image.dtype}) must be floats in linear light, 1 for saturation. {way_out}")
    if image.is_sparse or image.is_sparse_csr or image.device.type == "meta":
        is_meta = image.device.type == "meta"
        kind, way_out = ('on the device "meta"', "") if is_meta else ("sparse", f" `{name}.to_dense()`.")
        raise ParameterError(f"`{name}` ({image.dtype}, {kind}) must be a tensor that holds all its numbers.{way_out}")


def check_at_least(least: int, **numbers: Any) -> None:  # noqa: ANN401
    """Check that counts, given by name, also those of numpy, are not below ``least``."""
    for name, value in numbers.items():
        if value < least:
            raise ParameterError(f"`{name}` ({value}) must be at least {least}.")


def check_not_negative(**numbers: Any) -> None:  # noqa: ANN401
    """Check that numbers, given by name, are not negative."""
    for name, value in numbers.items():
        if not value >= 0:
            raise ParameterError(f"`{name}` ({value}) must not be negative.")


def check_light(image: Any, name: str) -> None:  # noqa: ANN401
    """Check that the numbers of the image (B, C, H, W) called ``name`` can be a measurement.

    One NaN or infinity becomes a picture of NaN. From `MIN_LIGHT` to `MAX_LIGHT`, no square or sum of a
    method leaves the range of float32. Darkness, all zeros, is a measurement. Waits for a GPU.

    Raises:
        ParameterError: it holds NaN or infinity; or the largest number of a sample is negative, or of another scale.
    """
    for sample in image:
        low, high = (float(value) for value in sample.aminmax())  # both NaN if there is one
        largest = max(-low, high)
        if not math.isfinite(low + high):
            raise ParameterError(
                f"`{name}` holds NaN or infinity, which would spread over the whole picture. Capture it again, or "
                f"replace them: `torch.nan_to_num({name}, posinf=1)`."
            )
        if high <= 0 > low:
            raise ParameterError(
                f"`{name}` ({low:.3g} to {high:.3g}) holds no light: no number is positive. Check the frame that was "
                "subtracted, `dark` or `ambient`."
            )
        if largest and not MIN_LIGHT <= largest <= MAX_LIGHT:
            raise ParameterError(
                f"`{name}` (up to {largest:.3g}) must be linear light, 1 for saturation, with a largest number from "
                f"{MIN_LIGHT:g} to {MAX_LIGHT:g}. Scale it: `{name} / {name}.max()`."
            )

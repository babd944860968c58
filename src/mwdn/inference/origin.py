"""Hash of everything that a picture depends on, this package's version included: a batch resumes where it stopped."""

import hashlib
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from pathlib import Path

from torch import Tensor, nn

from mwdn.inference.ensemble import Ensemble
from mwdn.inference.reconstructor import Reconstructor
from mwdn.version import __version__


def settings_hash(reconstruct: Reconstructor, format: str, *, full_size: bool = False) -> str:
    """Hash of the method with its weights, the calibration, format and size of files and this package's version."""
    calibration, engine = reconstruct.calibration, reconstruct.engine
    return _digest(
        __version__,
        format,
        full_size and calibration.frames.bin > 1,
        calibration,
        reconstruct.method,
        engine and engine.precision,
        isinstance(engine, Ensemble),
        reconstruct.align,
        reconstruct.room_light,
        reconstruct.white_balance,
    )


def origin(settings: str, capture: Path) -> str:
    """Hash of the settings and of the size and time of modification of a capture; empty if it cannot be read.

    Args:
        settings: see `settings_hash`.
        capture: its file.
    """
    try:
        status = capture.stat()
    except OSError:  # reading the file gives the error
        return ""
    return _digest(settings, status.st_size, status.st_mtime_ns)


def _digest(*parts: object) -> str:
    """First 16 hexadecimal digits of the SHA-256 of tensors' bytes and of other objects' content or text."""
    digest = hashlib.sha256()
    for part in parts:
        if isinstance(part, Tensor):
            digest.update(repr((part.shape, part.dtype)).encode() + part.cpu().contiguous().numpy().tobytes())
        else:
            digest.update(_text(part).encode() + b"\0")
    return digest.hexdigest()[:16]


def _text(part: object) -> str:
    """The hash of an object's content if it has parts, otherwise its `repr`."""
    if isinstance(part, nn.Module):
        options = {name: _options(module) for name, module in part.named_modules()}
        return _digest(type(part).__name__, options, part.state_dict())
    if is_dataclass(part) and not isinstance(part, type):
        return _digest(type(part).__name__, {each.name: getattr(part, each.name) for each in fields(part)})
    if isinstance(part, Mapping):
        return _digest(*(value for item in part.items() for value in item))
    if isinstance(part, tuple | list):
        return _digest(type(part).__name__, *part)
    return repr(part)


def _options(module: nn.Module) -> dict[str, object]:
    """Public attributes of a module that are numbers, text, or have fields, such as a network's options."""
    plain = (bool, int, float, str, tuple, type(None))
    known = {name: value for name, value in vars(module).items() if name[0] != "_"}
    return {name: value for name, value in known.items() if isinstance(value, plain) or is_dataclass(value)}

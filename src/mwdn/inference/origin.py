"""Hash of everything that a picture depends on, so that an interrupted batch resumes without repeating work.

The hash must not change between versions of the code, so it uses the names below instead of all attributes of an
object.
"""

import hashlib
from collections.abc import Mapping
from pathlib import Path

from torch import Tensor, nn

from mwdn.calibration import Calibration
from mwdn.inference.ensemble import Ensemble
from mwdn.inference.reconstructor import Reconstructor
from mwdn.solvers import Admm
from mwdn.version import __version__

_OPTIONS = {
    "WienerBank": ("channels", "fold", "regularisations", "finest", "align", "block", "levels", "rounds"),
    "LeAdmm": ("variation",),
    "Updn": ("channels", "width"),
    "FlatNet": ("regularisation", "boundary"),
    "SvDeconv": ("channels", "field", "boundary"),
    **dict.fromkeys(("Mmcn", "Ifin"), ("channels",)),
    **dict.fromkeys(("WienerNetwork", "UNet", "WienerUNet", "Mwdn", "MwdnCpsf", "LeAdmmU"), ()),
}
"""Attributes of each network that are hashed besides its weights; of other modules, all public attributes are."""


def settings_hash(reconstruct: Reconstructor, format: str, *, full_size: bool = False) -> str:
    """Hash of the method with its weights, the calibration, format and size of files and this package's version."""
    format += " at full size" if full_size and reconstruct.calibration.frames.bin > 1 else ""
    camera = _camera(reconstruct.calibration)
    if reconstruct.white_balance is not None:
        camera["white_balance"] = reconstruct.white_balance
        camera["light"] = reconstruct.calibration.light
    return _digest(__version__, format, camera, *_method(reconstruct))


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


def _camera(calibration: Calibration) -> dict[str, object]:
    """Everything a measurement depends on; fields that were added later are hashed only if they are set."""
    frames = calibration.frames
    later = {"gamma": frames.gamma, "ambient": None if calibration.ambient is None else calibration.offset}
    refinement = {"refinement": repr(calibration.refinement)} if calibration.refinement else {}
    later |= {"flat": calibration.corrections.flat, "hot_pixels": calibration.corrections.defects}
    return {
        "psf": calibration.psf,
        "bit_depth": frames.bit_depth,
        "dark": calibration.dark,
        "crop": frames.crop and tuple(length // frames.cell for length in frames.crop),
        "binning": frames.bin,
        "background": calibration.background,
        "upside_down": frames.upside_down,
        "bgr": frames.bgr,
        "pitch_um": calibration.pitch_um,
        "distance_mm": calibration.distance_mm,
        "mosaic": frames.mosaic,
        "grey": frames.grey,
        **refinement,
        **{name: value for name, value in later.items() if value is not None},
    }


def _method(reconstruct: Reconstructor) -> tuple[object, ...]:
    """The hashed attributes of the method. Alignment, first an option of some networks, is now one of every method."""
    method, aligned = reconstruct.method, ("aligned",) if reconstruct.align else ()
    lit = ("room light",) if reconstruct.room_light else ()
    if not isinstance(method, nn.Module):
        return (method, *aligned, *lit)
    kind = type(method).__name__
    names = _OPTIONS.get(kind, tuple(name for name in vars(method) if name[0] != "_" and name != "training"))
    options = {"training": method.training, **{name: getattr(method, name) for name in names}}
    if "align" in options:
        options["align"], aligned = reconstruct.align, ()
    averaged = ("ensemble",) if isinstance(reconstruct.engine, Ensemble) else ()
    precision = reconstruct.engine and reconstruct.engine.precision
    return kind, options, method.state_dict(), precision, *aligned, *averaged, *lit


def _digest(*parts: object) -> str:
    """First 16 hexadecimal digits of the SHA-256 of tensors' bytes and of other objects' text, also in mappings."""
    digest = hashlib.sha256()
    for part in parts:
        if isinstance(part, Mapping):
            digest.update(_digest(*(value for item in part.items() for value in item)).encode())
        elif isinstance(part, Tensor):
            digest.update(repr((part.shape, part.dtype)).encode() + part.cpu().contiguous().numpy().tobytes())
        else:
            digest.update(_text(part).encode() + b"\0")
    return digest.hexdigest()[:16]


def _text(part: object) -> str:
    """`repr`, with the fields that ADMM had when the first hashes were written."""
    text = repr(part)
    if isinstance(part, Admm):
        text = text.removesuffix(")") + ", tolerance=0.0, balance_every=0)"
    return text

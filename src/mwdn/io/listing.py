"""List the frames of a folder; files that are left out are reported, never skipped silently."""

import os
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

from mwdn.errors import ParameterError, one_line
from mwdn.io.images import READABLE
from mwdn.io.raw import RAW

FRAMES = READABLE | RAW
"""Suffixes, in lower case, of the files in a folder that are taken for frames."""

_PICTURES = frozenset({
    ".apng", ".avif", ".bay", ".crw", ".erf", ".exr", ".fff", ".fit", ".fits", ".gif", ".hdr", ".heic",
    ".heif", ".hif", ".iiq", ".jfif", ".jp2", ".jpe", ".jxl", ".kdc", ".mos", ".mrw", ".nrw", ".pbm",
    ".pfm", ".pnm", ".psd", ".raw", ".rwl", ".sr2", ".srf", ".srw", ".svg", ".x3f", ".xcf",
})  # fmt: skip
"""Suffixes of pictures that are not read."""

_COMPANIONS = frozenset({".json", ".toml", ".xmp", ".thm"})
"""Suffixes of files that describe others: this package's, and cameras'."""

_NAMED = 3
"""Number of files that a sentence names."""


def list_folder(folder: Path) -> tuple[list[str], list[str]]:
    """List the frames in a folder.

    Strings instead of paths save memory: a million of them take about 0.2 GB.

    Args:
        folder: not searched for subfolders. Hidden files are left out.

    Returns:
        The frames, in alphabetical order; and one sentence for each kind of entry that is left out.
    """
    with os.scandir(folder) as entries:
        # A pipe or a link to itself is listed as a frame; reading it reports the error.
        visible = [entry for entry in entries if not entry.name.startswith(".")]
        names = sorted(f"{entry.name}/" if _is_folder(entry) else entry.name for entry in visible)
    start = str(folder / "x").removesuffix("x")
    frames = [start + name for name in names if not name.endswith("/") and Path(name).suffix.lower() in FRAMES]
    return frames, _left_out(folder, names, FRAMES)


def _is_folder(entry: os.DirEntry[str]) -> bool:
    with suppress(OSError):  # a link to itself
        return entry.is_dir()
    return False


def pictures_in(folder: Path, suffixes: frozenset[str] = READABLE, *, subfolders: bool = True) -> list[Path]:
    """The files of a folder with these suffixes, in alphabetical order; hidden files and folders are left out."""
    return [path for path in _visible_files(folder, subfolders=subfolders) if path.suffix.lower() in suffixes]


def _visible_files(folder: Path, *, subfolders: bool = True) -> list[Path]:
    """Files of a folder in alphabetical order, except hidden ones and those in hidden subfolders."""
    paths = folder.rglob("*") if subfolders else folder.iterdir()
    return sorted(path for path in paths if not _is_hidden(path.relative_to(folder)) and path.is_file())


def _is_hidden(path: Path) -> bool:
    return any(part.startswith(".") for part in path.parts)


def lies_in(path: str | Path, folder: str | Path) -> bool:
    """Whether a path is a folder, or lies in it."""
    return Path(path).resolve().is_relative_to(Path(folder).resolve())


def refuse_within(inputs: str | Path, out: Path, *, of: str = "photographs") -> None:
    """Refuse an output folder in a folder of photographs or captures, where a run's pictures would become such.

    Raises:
        ParameterError: it lies there.
    """
    if Path(inputs).is_dir() and lies_in(out, inputs):
        raise ParameterError(
            f"`{out}` lies in the folder of {of} `{inputs}`, in which all pictures are {of}. Choose a folder beside "
            "it: `out`."
        )


def unused_files(folder: Path, suffixes: frozenset[str] = READABLE) -> list[str]:
    """One sentence for each kind of file in a folder, or its subfolders, that `pictures_in` does not list."""
    return _left_out(folder, [path.relative_to(folder).as_posix() for path in _visible_files(folder)], suffixes)


def _left_out(folder: Path, names: list[str], readable: frozenset[str]) -> list[str]:
    """One sentence for each kind of file that is not read; the names of folders end in ``/``."""
    kinds: dict[str, list[str]] = {
        "formats that are not read: export them as PNG or 16-bit TIFF": [],
        "subfolders are not searched: name them": [],
        "not pictures": [],
    }
    pictures, folders, others = kinds.values()
    for name in names:
        suffix = Path(name).suffix.lower()
        if name.endswith("/"):
            folders.append(name)
        elif suffix not in readable | _COMPANIONS:
            (pictures if suffix in _PICTURES | RAW else others).append(name)
    return [f"Skipped in {folder}: {enumerate_names(found)} ({kind})." for kind, found in kinds.items() if found]


def enumerate_names(names: Sequence[str]) -> str:
    """``a, b and c``; of more than three ``a, b and 5 more``; control characters of file names are escaped."""
    names = [one_line(name) for name in names[:_NAMED]] + list(names[_NAMED:])
    if len(names) <= _NAMED:
        return " and ".join(filter(None, [", ".join(names[:-1]), names[-1]]))
    return f"{', '.join(names[: _NAMED - 1])} and {len(names) - _NAMED + 1:,} more"

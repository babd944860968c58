"""Files of a batch: their names, and the check that nothing of the user's is overwritten."""

from collections.abc import Iterable, Mapping, Sequence, Set
from pathlib import Path
from typing import Literal

from mwdn.errors import ParameterError
from mwdn.io.contact_sheets import to_display
from mwdn.io.files import as_image_error, path_resolver
from mwdn.io.images import write_imagej, write_linear, write_picture
from mwdn.io.reading import read_json
from mwdn.types import Scene

Format = Literal["png", "png16", "tiff", "imagej", "npy"]
"""``png`` and ``png16`` are sRGB, for viewing; ``tiff``, ``imagej`` and ``npy`` hold the linear float32 values."""

_SUFFIX = {"png": ".png", "png16": ".png", "tiff": ".tif", "imagej": ".tif", "npy": ".npy"}
_SUPPORT = ".support.png"
SUMMARY = "summary.png"
"""File of the contact sheet."""


def output_name(capture: str | Path, format: Format) -> str:
    """File name of a capture's picture: the capture's name with the format's suffix."""
    return Path(capture).stem + _SUFFIX[format]


def support_name(output: Path) -> Path:
    """File of the map of a picture's support."""
    return output.with_name(output.stem + _SUPPORT)


def check_outputs(
    captures: Sequence[str | Path], out: Path, format: Format, *, protected: Iterable[Path | None] = ()
) -> None:
    """Check that every capture has its own file name in ``out`` and that nothing of the user's is overwritten.

    Raises:
        ParameterError: two captures have the same output, or one the name of another's support map; an output would
            overwrite an input, a ``.json`` that is not of this package, or a picture without one in a folder of
            captures, or in one that holds none of this package; an output is a symbolic link, or ``out`` is a file.
    """
    if out.exists() and not out.is_dir():
        raise ParameterError(f"`{out}` must be a folder, but is a file. Choose another one: `out`.")
    real = path_resolver()
    inputs = {real(str(path)) for path in (*captures, *protected) if path is not None}
    paths = list(out.iterdir()) if out.exists() else []
    existing = {path.name for path in paths}
    links = {str(path): path.readlink() for path in paths if path.is_symlink()}
    start = str(out / "x").removesuffix("x")  # text instead of paths: there may be a million captures
    folders = {str(Path(capture).parent) for capture in captures}
    holds_pictures = any(name.endswith(".json") and read_sidecar(out / name) for name in existing)
    is_foreign = real(str(out)) in map(real, folders) or not holds_pictures

    def check(output: str) -> None:
        if real(output) in inputs:
            raise ParameterError(f"`{output}` would overwrite an input. Choose another folder: `out`.")
        if output in links:
            raise ParameterError(f"`{output}` is a link to `{links[output]}`. Choose another folder: `out`.")

    def refuse(file: str) -> None:
        raise ParameterError(
            f"`{start}{file}` was not written by mwdn and would be lost. Choose another folder: `out`."
        )

    check(str(out / SUMMARY))
    if SUMMARY in existing and not holds_pictures:
        refuse(SUMMARY)
    sources: dict[str, str] = {}
    for capture in captures:
        name = output_name(capture, format)
        stem = name.removesuffix(_SUFFIX[format])
        sidecar, support = f"{stem}.json", stem + _SUPPORT
        for file in (name, sidecar, support):
            check(start + file)
        # Among other pictures of a run, one without its sidecar is of a run that was killed between the two.
        present = next((file for file in (sidecar, name, support) if file in existing), None)
        if present and (present == sidecar or is_foreign) and not read_sidecar(out / sidecar):
            refuse(present)
        if name == SUMMARY:
            raise ParameterError(f"`{capture}` has the name of the summary picture, `{SUMMARY}`. Rename it.")
        if name in sources:
            raise ParameterError(
                f"`{capture}` and {sources[name]} would both be written to `{start}{name}`. Name one of them, "
                f"such as `*{Path(capture).suffix}`, or reconstruct them into two folders: `out`."
            )
        sources[name] = f"`{capture}`"
    _check_maps(sources, existing, start, format)


def _check_maps(sources: Mapping[str, str], existing: Set[str], start: str, format: Format) -> None:
    """Check that no picture has the name of another one's support map, in this run or an earlier one.

    A new picture removes the map of an older one, so this holds for runs without maps, too.
    """
    for name, source in sources.items():
        stem = name.removesuffix(_SUFFIX[format])
        of = stem.removesuffix(".support")
        if name == of + _SUPPORT and (other := sources.get(of + _SUFFIX[format])):
            raise ParameterError(
                f"The picture of {source} and the support map of {other} would both be written to `{start}{name}`. "
                "Rename one of them, or reconstruct them into two folders: `out`."
            )
        is_map = name == of + _SUPPORT and f"{of}.json" in existing
        has_map = {stem + _SUPPORT, f"{stem}.support.json"} <= existing  # by its sidecar it is a picture
        if has_map or (is_map and name in existing):
            kind, lost = ("picture", stem + _SUPPORT) if has_map else ("support map", name)
            raise ParameterError(
                f"`{start}{lost}` is the {kind} of another capture, and {source} would replace or remove it. Choose "
                "another folder: `out`."
            )


def remove_other_format(
    output: Path, capture: Path, *, before: Mapping[str, object], now: Mapping[str, object]
) -> None:
    """Remove a capture's earlier picture in another format, unless it is by the same method through the same PSF.

    Args:
        output: the new picture.
        capture: stays, whatever its name.
        before: content of the sidecar that has been replaced; empty for none.
        now: content of the new one.

    Raises:
        ImageError: the picture cannot be removed.
    """
    names = {output.stem + suffix for suffix in _SUFFIX.values()} - {output.name}
    if before.get("file") not in names or all(before.get(key) == now[key] for key in ("method", "psf_hash")):
        return
    picture = output.with_name(str(before["file"]))
    if picture.resolve() != capture.resolve():
        with as_image_error(picture):
            picture.unlink(missing_ok=True)


def write_output(path: Path, scene: Scene, format: Format, pixel_um: float | None) -> None:
    """Write a picture.

    Args:
        path: with the format's suffix.
        scene: (1, C, H, W).
        format: see `Format`.
        pixel_um: distance between the picture's pixels on the sensor, if it is known.

    Raises:
        ImageError: it cannot be written.
    """
    if format == "imagej":
        write_imagej(path, scene, pixel_um=pixel_um)
    elif format in ("tiff", "npy"):
        write_linear(path, scene)
    else:
        write_picture(path, to_display(scene), bits=16 if format == "png16" else 8)


def read_sidecar(path: Path) -> dict[str, object]:
    """Content of a sidecar file; empty if it is missing or not of this package."""
    try:
        content = read_json(path)
    except ParameterError:
        return {}
    return content if isinstance(content, dict) and "origin" in content else {}

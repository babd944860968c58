"""Convert a public data set, in its own layout, to a file of pairs."""

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from itertools import chain
from pathlib import Path
from typing import cast

from mwdn.calibration import Calibration, FrameFormat
from mwdn.calibration.frame_format import changed_fields
from mwdn.data.authors_file import AuthorsWriter
from mwdn.data.conversion import check_like_first, convert_pair
from mwdn.data.kinds import KINDS, Kind, Layout
from mwdn.data.pair_checks import DISPLAY_WHITE, REFINED
from mwdn.data.pair_writer import Attribute, PairWriter, PixelType, Shape, check_path
from mwdn.data.pairs import PairFile
from mwdn.data.sources import Listing, Source
from mwdn.errors import ImageError, MwdnError, ParameterError, UnknownNameError
from mwdn.io.files import refuse_overwrite
from mwdn.types import Frame, Psf

Pair = tuple[str, Frame, Frame]
"""A name, a measurement and a scene, both (H, W, C), RGB, row 0 at the top, integers or floats in [0, 1]."""


@dataclass
class Imported:
    """Result of an import: the number of pairs written, and the name of each skipped pair with the reason."""

    count: int = 0
    skipped: dict[str, str] = field(default_factory=dict)


def import_pairs(  # noqa: PLR0913
    kind: str,
    path: str | Path,
    output: str | Path,
    *,
    layout: Layout = Layout(),
    frames: FrameFormat = FrameFormat(),
    camera: Calibration | None = None,
    skip_damaged: bool = False,
    authors: bool = False,
    track: Callable[[list[Source]], Iterable[Source]] = iter,
) -> Imported:
    """Convert a data set to a file of pairs, which appears when all of it is written.

    Pictures of 8 bits are stored as such, deeper or binned ones as 16 bits, floats as floats. If the camera has a frame
    to subtract or to divide by, all are floats, because numbers go below 0 or above 1.

    Args:
        kind: of `KINDS`.
        path: of the data set.
        output: the new file, ending in .h5 or .hdf5; an existing one is replaced.
        layout: what differs from the usual layout of the kind.
        frames: what differs from the usual format of the captures.
        camera: corrects the captures, see `read_pairs`.
        skip_damaged: leave out pairs that are damaged or incomplete, and name them in the result.
        authors: write the file of the MWDN authors' code: 8 bits, `mwdn.data.authors_file`.
        track: wraps the list of pairs to read, for a progress bar.

    Raises:
        UnknownNameError: no such kind.
        ParameterError: ``output`` has another suffix, or is the data set itself; or as for `read_pairs`.
        ImageError: nothing to import; a pair is damaged and not to be skipped; ``output`` cannot be written.
    """
    check_path(Path(output))
    refuse_overwrite(Path(output), Path(path))
    result = Imported()
    skipped = result.skipped if skip_damaged else None
    pairs = read_pairs(kind, path, layout=layout, frames=frames, camera=camera, skipped=skipped, track=track)
    attributes, psf = _of_pairs(PairFile(path), frames) if kind == "pairs" else ({}, None)
    result.count = write_pairs(Path(output), pairs, {**attributes, "source": kind}, psf, authors=authors)
    if not result.count:
        reason = f" {len(skipped):,} were skipped; {next(iter(skipped.values()))}" if skipped else ""
        raise ImageError(f"`{path}` has no pair to import.{reason} For the layouts: `mwdn import --help`.")
    return result


def _of_pairs(file: PairFile, frames: FrameFormat) -> tuple[dict[str, Attribute], Psf | None]:
    """Attributes and PSF of a file of pairs that hold in its copy; only the `REFINED` marks if its captures change."""
    if frames == FrameFormat():
        return file.attributes, file.psf
    return {name: value for name, value in file.attributes.items() if name in (REFINED, DISPLAY_WHITE)}, None


def write_pairs(
    output: Path,
    pairs: Iterable[Pair],
    attributes: Mapping[str, Attribute],
    psf: Psf | None = None,
    *,
    authors: bool = False,
) -> int:
    """Write pairs to a file; returns how many. Without pairs there is no file.

    Args:
        output: the new file.
        pairs: all of one shape and type.
        attributes: of the file.
        psf: of the camera, as in `PairFile.create`.
        authors: write the file of the MWDN authors' code, see `mwdn.data.authors_file`, which has neither attributes
            nor a PSF.

    Raises:
        ImageError: the file cannot be written.
    """
    pairs = iter(pairs)
    first = next(pairs, None)
    if first is None:
        return 0
    shapes: tuple[Shape, Shape] = first[1].shape, first[2].shape
    writer = (
        AuthorsWriter(output, *shapes)
        if authors
        else PairWriter(output, shapes, cast(PixelType, first[1].dtype.name), dict(attributes), psf)
    )
    with writer as file:
        for _, measurement, scene in chain([first], pairs):
            file.append(measurement, scene)
        return len(file)


def read_pairs(
    kind: str,
    path: str | Path,
    *,
    layout: Layout = Layout(),
    frames: FrameFormat = FrameFormat(),
    camera: Calibration | None = None,
    skipped: dict[str, str] | None = None,
    track: Callable[[list[Source]], Iterable[Source]] = iter,
) -> Iterator[Pair]:
    """Read the pairs of a data set one by one, in its order.

    Measurement and scene are as stored, turned to RGB and upright; a gamma is decoded only if it is given. The scene
    gets the channels of the measurement: the mean of its colours for a grey camera, equal colours if it is grey.

    Args:
        kind: of `KINDS`.
        path: of the data set: a file for ``"mwdn"`` and ``"pairs"``, a folder for the others; or a folder with the
            pictures of ``"mwdn"``.
        layout: what differs from the usual layout of the kind.
        frames: what differs from the usual format of the captures; its channel order and orientation are also those
            of the scenes.
        camera: corrects the captures as `mwdn.Calibration.correct` does, except the refinement: by its dark or ambient
            frame, flat field and hot pixels. Its own ``frames`` are those of these files, not of the captures.
        skipped: receives the name of each damaged or incomplete pair and the reason; without it, the first one raises.
        track: wraps the list of pairs to read, for a progress bar.

    Raises:
        UnknownNameError: no such kind.
        ParameterError: ``camera`` corrects, but the pairs are corrected already, see `refuse_corrections`.
        ImageError: nothing there; or, without ``skipped``, a pair is damaged, incomplete, or unlike the first.
    """
    if kind not in KINDS:
        raise UnknownNameError("kind of data set", kind, KINDS)
    if kind == "pairs":
        refuse_corrections(kind, camera)
        camera = None
    of_folder = KINDS[kind].of_folder
    chosen = of_folder if of_folder and Path(path).is_dir() else KINDS[kind]
    layout = replace(chosen.layout, **changed_fields(layout))
    listing = chosen.list_pairs(Path(path), layout.captures or "", layout.scenes or "")
    return read_listing(listing, chosen, layout, frames, camera=camera, skipped=skipped, track=track)


def refuse_corrections(kind: str, camera: Calibration | None) -> None:
    """Raise a `ParameterError` if the camera has frames to correct captures by, for a kind whose captures are done."""
    if camera is not None and any(
        part is not None for part in (camera.offset, camera.corrections.flat, camera.corrections.defects)
    ):
        raise ParameterError(
            f"Captures of the kind {kind} are corrected already, but the camera has a dark frame, an ambient frame, a "
            "flat field or a map of hot pixels. Use a camera file without them."
        )


def read_listing(
    listing: Listing,
    kind: Kind,
    layout: Layout,
    frames: FrameFormat,
    *,
    camera: Calibration | None = None,
    skipped: dict[str, str] | None = None,
    track: Callable[[list[Source]], Iterable[Source]] = iter,
) -> Iterator[Pair]:
    """Read the pairs of a listing one by one, in its order, see `read_pairs`."""
    if listing.refused and skipped is None:
        reason = next(iter(listing.refused.values()))
        more = f" (and {len(listing.refused) - 1:,} more like it)" if len(listing.refused) > 1 else ""
        raise ImageError(f"{reason}{more} To import the others: `--skip-damaged`.")
    if skipped is not None:
        skipped.update(listing.refused)
    first: tuple[Frame, Frame] | None = None
    for source in track(listing.sources):
        try:
            pair = convert_pair(source, kind, layout, frames, camera)
            first = first or pair
            check_like_first(first, pair, source.name)
        except MwdnError as error:
            reason = str(error) if isinstance(error, ImageError) else f"`{source.name}`: {error}"
            if skipped is None:
                raise ImageError(f"{reason} To import the others: `--skip-damaged`.") from error
            skipped[source.name] = reason
            continue
        yield source.name, *pair

"""Import data sets of DigiCam and its relatives: a display as the mask, one or several patterns, room light.

The data sets of LenslessPiCam on the Hugging Face hub have the columns ``lensless`` and ``lensed``, encoded pictures;
``mask_label``, a number, where the pattern changes from pair to pair; the patterns in ``masks/mask_NUMBER.npy``, or one
in ``mask_pattern.npy``; and, where captures were taken in the light of a room, a picture of that light alone.

A file of pairs has one PSF, so each pattern gets its own file, with the PSF that `mwdn.optics` computes for it.

References:
    E. Bezzam et al., "Towards Robust and Generalizable Lensless Imaging with Modular Learned Reconstruction" (2025).
"""

import csv
import io
import re
from collections.abc import Callable, Container, Iterable
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import chain
from pathlib import Path

import numpy as np
import torch

from mwdn.calibration import FrameFormat
from mwdn.data.importers import read_listing, write_pairs
from mwdn.data.kinds import Kind, Layout
from mwdn.data.pair_writer import Attribute, check_path
from mwdn.data.shards import Shard, find_shards
from mwdn.data.sources import Listing, Source, Stored, files_by_stem, list_folders
from mwdn.errors import ImageError, ParameterError
from mwdn.io.files import refuse_overwrite
from mwdn.io.headers import COPY_AGAIN
from mwdn.io.images import read_frame, write_linear
from mwdn.io.npy import read_array
from mwdn.io.reading import read_text
from mwdn.optics.lcd_mask import Lcd, lcd_psf
from mwdn.optics.orientation import Orientation, turn
from mwdn.optics.setup import Setup
from mwdn.types import Frame, Psf, Size

PATTERN = "mask_pattern.npy"
CAPTURES, SCENES, LABEL = "lensless", "lensed", "mask_label"
DOWNLOADED = ("*.parquet", "masks/*.npy", "mask_pattern.npy")

KIND = Kind(list_folders, Layout(CAPTURES, SCENES))


@dataclass(frozen=True)
class DigiCam:
    """The optics of a camera with a display as its mask; the defaults are those of DigiCam.

    Args:
        mask_distance_mm: from the mask, a liquid-crystal display, to the sensor.
        source_mm: from the scene to the mask.
        sensor_mm: width of the captures on the sensor; the Raspberry Pi HQ camera's 4056 pixels of 1.55 um.
        psf_turn: how the computed PSF must be turned to fit the captures; `mwdn reconstruct` says if it is.
        background: column or folder of frames of the room's light alone, subtracted from the captures, which are then
            stored as floats; "none" keeps it in them.

    Raises:
        ParameterError: a length is not positive.
    """

    mask_distance_mm: float = 2.0
    source_mm: float = 300.0
    sensor_mm: float = 6.2868
    psf_turn: Orientation | None = None
    background: str = "background"

    def __post_init__(self) -> None:
        for name in ("mask_distance_mm", "source_mm", "sensor_mm"):
            if not 0 < getattr(self, name) < float("inf"):
                raise ParameterError(f"`{name}` ({getattr(self, name)}) must be positive.")

    def psf(self, pattern: Path, size: Size) -> Psf:
        """PSF (1, 3, H, W) of a pattern's file for captures of a size, each colour of unit sum.

        Raises:
            ImageError: the file cannot be read.
            MwdnError: it holds no transmissions of cells.
        """
        values = torch.from_numpy(np.asarray(read_array(pattern), np.float32))
        setup = Setup(
            distance_mm=self.mask_distance_mm,
            source_mm=self.source_mm,
            pixels=size,
            pixel_um=1e3 * self.sensor_mm / size[1],
            bin=1,
        )
        psf = lcd_psf(values, setup, Lcd())
        return psf if self.psf_turn is None else turn(psf, self.psf_turn)


@dataclass
class ImportedMasks:
    """Result: for each file written, its pattern's label and the number of its pairs; and the skipped pairs."""

    files: dict[Path, tuple[str, int]] = field(default_factory=dict)
    psfs: list[Path] = field(default_factory=list)
    skipped: dict[str, str] = field(default_factory=dict)


def import_digicam(
    path: Path,
    output: Path,
    camera: DigiCam = DigiCam(),
    *,
    layout: Layout = Layout(),
    frames: FrameFormat = FrameFormat(),
    skip_damaged: bool = False,
    track: Callable[[list[Source]], Iterable[Source]] = iter,
) -> ImportedMasks:
    """Convert a data set to a file of pairs for each pattern, with its computed PSF, also beside it as a TIFF.

    Args:
        path: folder of the data set, or its name on the hub.
        output: the new file, ``pairs.h5``; with several patterns ``pairs-mask-0.h5`` and so on.
        camera: its optics.
        layout: other names of columns or folders, and the size of scenes.
        frames: format of the captures.
        skip_damaged: leave out pairs that are damaged, and name them in the result.
        track: wraps the pairs of each file, for a progress bar.

    Raises:
        ImageError: nothing to import, a pattern is missing, or a pair is damaged and not to be skipped.
        MwdnError: as for `mwdn.data.importers.import_pairs`.
    """
    check_path(output)
    refuse_overwrite(output, path)
    names = layout.captures or CAPTURES, layout.scenes or SCENES
    levels = frames.encoding
    listing, folder, is_subtracted = list_digicam(path, *names, background=camera.background, levels=levels)
    if is_subtracted:  # the captures are linear floats then
        frames = replace(frames, bit_depth=None, gamma=None)
    patterns = find_patterns(folder)
    if skip_damaged and patterns:
        listing = _with_patterns(listing, patterns)
    labels = sorted({source.mask for source in listing.sources}, key=lambda label: (len(label), label))
    for label in labels:
        if label not in patterns:
            if not label:
                unlabelled = next(source.name for source in listing.sources if not source.mask)
                raise ImageError(
                    f"`{folder}` must have one pattern, `{PATTERN}` or `masks/mask_0.npy`, or a label for each pair: "
                    f"the column `{LABEL}`, or metadata.csv with file_name and {LABEL}. `{unlabelled}` has none."
                )
            raise ImageError(f"`{folder}` has no pattern `masks/mask_{label}.npy`, but pairs of it. {COPY_AGAIN}")
    result = ImportedMasks()
    for number, label in enumerate(labels):
        part = Listing(
            [source for source in listing.sources if source.mask == label], listing.refused if number == 0 else {}
        )
        skipped = result.skipped if skip_damaged else None
        pairs = read_listing(part, KIND, layout, frames, skipped=skipped, track=track)
        file = output if len(labels) == 1 else output.with_name(f"{output.stem}-mask-{label}{output.suffix}")
        first = next(pairs, None)
        if first is None:
            continue
        attributes: dict[str, Attribute] = {"source": "digicam", "mask_label": label}
        psf = _cropped(camera, frames, part, first[0]).psf(patterns[label], (first[1].shape[0], first[1].shape[1]))
        result.files[file] = label, write_pairs(file, chain([first], pairs), attributes, psf)
        result.psfs.append(file.with_name(f"{file.stem}-psf.tif"))
        write_linear(result.psfs[-1], psf / psf.max())
    if not result.files:
        raise ImageError(f"`{path}` has no pair to import. For the layouts: `mwdn import --help`.")
    return result


def _cropped(camera: DigiCam, frames: FrameFormat, listing: Listing, readable: str) -> DigiCam:
    """The camera with the part of the sensor that the captures keep; ``readable`` is the name of one of them."""
    if frames.crop is None:
        return camera
    width = next(source for source in listing.sources if source.name == readable).load().capture.shape[1]
    return replace(camera, sensor_mm=camera.sensor_mm * min(frames.crop[1], width) / width)


def list_digicam(
    path: Path, captures: str, scenes: str, *, background: str, levels: FrameFormat
) -> tuple[Listing, Path, bool]:
    """The pairs of a data set with the label of each pattern, its folder, and whether the room's light is subtracted.

    Args:
        path: folder with parquet shards, or with the folders of pictures ``captures`` and ``scenes``; or a name on the
            hub. In folders, ``metadata.csv`` says the pattern of each picture: file_name, mask_label.
        captures: column or folder.
        scenes: column or folder.
        background: column or folder of the room's light, subtracted if it is there; "none" for no such.
        levels: bit depth and gamma of captures and background.

    Raises:
        ImageError: nothing there, a label is missing, or a background that was named.
    """
    if (path / captures).is_dir():
        listing, is_subtracted = _list_pictures(path, captures, scenes, background, levels)
        return listing, path, _check_background(is_subtracted, background, path)
    sources, refused, folder, is_subtracted = [], {}, path, False
    for file in find_shards(path, DOWNLOADED):
        try:
            shard = Shard(file, (captures, scenes))
            if is_subtracted or background in shard.names:
                shard, is_subtracted = Shard(file, (captures, scenes, background)), True
            labels = shard.numbers(LABEL) if LABEL in shard.names else [""] * shard.count
        except ImageError as error:
            refused[file.name] = str(error)
            continue
        folder = file.parent if path.is_file() else folder
        rows = range(shard.count)
        load = partial(_read_row, shard, levels)
        sources += [Source(f"{file.name} row {n}", partial(load, n), _label(labels[n])) for n in rows]
    if not path.exists():  # downloaded: the patterns are beside the folder of the shards
        folder = next((p for p in file.parents if (p / "masks").is_dir() or (p / PATTERN).is_file()), file.parent)
    return Listing(sources, refused), folder, _check_background(is_subtracted, background, path)


def _check_background(is_subtracted: bool, background: str, path: Path) -> bool:
    if not is_subtracted and background not in ("none", DigiCam.background):
        raise ImageError(f"`background` ({background}) must be a column or a folder of `{path}`, or none.")
    return is_subtracted


def _label(value: object) -> str:
    """A label as text; where one is missing, tables hold the others as floats."""
    if isinstance(value, float) and value.is_integer():
        value = int(value)
    return "" if value is None else str(value)


def _with_patterns(listing: Listing, patterns: Container[str]) -> Listing:
    """The pairs of known patterns; the others are refused."""
    kept, refused = [], {**listing.refused}
    for source in listing.sources:
        if source.mask in patterns:
            kept.append(source)
        else:
            missing = f"the pattern `masks/mask_{source.mask}.npy`" if source.mask else f"a {LABEL}"
            refused[source.name] = f"`{source.name}` lacks {missing}."
    return Listing(kept, refused)


def _read_row(shard: Shard, levels: FrameFormat, row: int) -> Stored:
    capture, scene, *ambient = shard.load(row)
    return Stored(_without(capture, ambient[0], f"row {row}", levels) if ambient else capture, scene)


def _without(capture: Frame, ambient: Frame, name: str, levels: FrameFormat) -> Frame:
    """The capture less the room's light, as linear floats of either sign; 1 is saturation."""
    if capture.shape != ambient.shape or capture.dtype != ambient.dtype:
        raise ImageError(f"The background of {name} {ambient.shape} must be like its capture {capture.shape}.")
    for frame in (capture, ambient):
        levels.check_bits(frame, f"{name} or its background")
    light = levels.normalise(capture) - levels.normalise(ambient)
    return light[0].movedim(0, -1).contiguous().numpy()


def _list_pictures(
    path: Path, captures: str, scenes: str, background: str, levels: FrameFormat
) -> tuple[Listing, bool]:
    listing, labels = list_folders(path, captures, scenes), _read_labels(path)
    rooms = files_by_stem(path / background) if (path / background).is_dir() else {}
    if len(rooms) > 1:  # one for each capture
        missing = [one.name for one in listing.sources if one.name not in rooms]
        listing.refused.update({name: f"`{name}` has no frame in `{path / background}`." for name in missing})
    sources = []
    for one in listing.sources:
        if one.name in listing.refused:
            continue
        room = next(iter(rooms.values())) if len(rooms) == 1 else rooms.get(one.name)
        load = one.load if room is None else partial(_read_room, one, room, levels)
        names = f"{captures}/{one.name}", one.name, Path(one.name).name  # metadata.csv may have any of these
        sources.append(Source(one.name, load, next((labels[name] for name in names if name in labels), "")))
    return Listing(sources, listing.refused), bool(rooms)


def _read_room(source: Source, room: Path, levels: FrameFormat) -> Stored:
    stored = source.load()
    return stored._replace(capture=_without(stored.capture, read_frame(room), source.name, levels))


def _read_labels(path: Path) -> dict[str, str]:
    """Label of each picture by its path without suffix, from metadata.csv."""
    file = path / "metadata.csv"
    if not file.is_file():
        return {}
    rows = csv.DictReader(io.StringIO(read_text(file, most=2**26, error=ImageError)))
    if not {"file_name", LABEL} <= set(rows.fieldnames or ()):
        raise ImageError(f"`{file}` must have the columns file_name and {LABEL}.")
    return {Path(row["file_name"]).with_suffix("").as_posix(): row[LABEL] or "" for row in rows if row["file_name"]}


def find_patterns(folder: Path) -> dict[str, Path]:
    """Files of the patterns by their labels; a single one, under whatever name, is also that of pairs without label."""
    named = {re.sub(r"^mask_", "", path.stem): path for path in sorted((folder / "masks").glob("*.npy"))}
    if (folder / PATTERN).is_file():
        named[""] = folder / PATTERN
    elif len(named) == 1:
        named[""] = next(iter(named.values()))
    return named

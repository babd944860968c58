"""`mwdn import`: convert a data set to one file of pairs."""

from functools import partial
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter
from rich.markup import escape

from mwdn.calibration import Calibration, FrameFormat
from mwdn.cli.folders import no_empty_folder
from mwdn.cli.progress import track
from mwdn.cli.terminal import all_or_nothing, counted, if_interrupted, note, notes, say, warn
from mwdn.data.digicam import DigiCam, ImportedMasks, import_digicam
from mwdn.data.importers import import_pairs, refuse_corrections
from mwdn.data.kinds import KINDS, Layout
from mwdn.data.pair_checks import other_scene_size
from mwdn.data.pairs import PairFile
from mwdn.errors import ParameterError, UnknownNameError
from mwdn.io.images import READABLE
from mwdn.io.listing import FRAMES, unused_files


@no_empty_folder
def import_(  # noqa: PLR0913
    kind: str,
    path: Path,
    *,
    out: Annotated[Path, Parameter(name=["--out", "-o"])] = Path("pairs.h5"),
    skip_damaged: bool = False,
    authors: Annotated[bool, Parameter(negative=())] = False,
    layout: Annotated[Layout, Parameter(name="*")] = Layout(),
    frames: Annotated[FrameFormat, Parameter(name="*")] = FrameFormat(),
    digicam: Annotated[DigiCam, Parameter(name="*")] = DigiCam(),
    camera: Path | None = None,  # its format is in `frames`, see `from_camera_file`
) -> None:
    """Convert a public data set, or two folders of pictures, to one file of pairs.

    Args:
        kind: mwdn (the authors' HDF5, or their folder with blur/ and gt/), diffusercam, phlatcam, folders (captures/
            and scenes/), parquet, pairs (a file of this package), or digicam (lensless, lensed and the patterns of its
            mask in masks/).
        path: of the data set; for parquet a shard, a folder of shards, or owner/name on the Hugging Face hub.
        out: file of pairs to write, ending in .h5 or .hdf5; an existing file is replaced only on success.
        skip_damaged: skip pairs with a damaged or missing picture, and list them.
        authors: write the HDF5 of the MWDN authors' code (blur, gt; 8 bits, BGR) instead, for their training.
        layout: where this copy of the data set differs from the usual layout.
        frames: format of the captures, where it differs from the usual one.
        digicam: optics of a camera of the kind digicam.
        camera: camera file with this format; its dark or ambient frame, flat field and hot pixels correct the
            captures.
    """
    progress = partial(track, title="Importing")
    if kind not in (*KINDS, "digicam"):
        raise UnknownNameError("kind of data set", kind, [*KINDS, "digicam"])
    if kind != "digicam" and digicam != DigiCam():
        options = "`mask_distance_mm`, `source_mm`, `sensor_mm`, `psf_turn`, `background`"
        raise ParameterError(f"Only the kind digicam has {options}. Leave them out.")
    if kind == "digicam" and authors:
        raise ParameterError("`authors` is for one camera, but digicam has one for each mask. Leave it out.")
    calibration = None if camera is None else Calibration.load(camera, **vars(frames))
    note(*_unused(kind, path, layout))
    if kind == "digicam":
        refuse_corrections(kind, calibration)
        with if_interrupted(lambda: f"Interrupted. Files that are complete are kept: {out.parent}."):
            masks = import_digicam(
                path, out, digicam, layout=layout, frames=frames, skip_damaged=skip_damaged, track=progress
            )
        _report_masks(masks)
        return
    with all_or_nothing(out):
        result = import_pairs(
            kind,
            path,
            out,
            layout=layout,
            frames=frames,
            camera=calibration,
            skip_damaged=skip_damaged,
            authors=authors,
            track=progress,
        )
    _name_skipped(result.skipped)
    names = f": {', '.join(result.skipped)}" if result.skipped else ""
    say(f"{counted(result.count, 'pair')} written to {out}, {len(result.skipped):,} skipped{names}")
    if not authors:
        warn(other_scene_size(PairFile(out)))


def _report_masks(masks: ImportedMasks) -> None:
    _name_skipped(masks.skipped)
    for (file, (label, count)), psf in zip(masks.files.items(), masks.psfs, strict=True):
        mask = f" of mask {label}" if label else ""
        say(f"{counted(count, 'pair')}{mask} written to {file}, its PSF to {psf}")


def _unused(kind: str, path: Path, layout: Layout) -> list[str]:
    """One sentence for each kind of file in the folders of a data set that is not read."""
    usual = KINDS[kind].layout if kind in KINDS else layout
    folders = (layout.captures or usual.captures, FRAMES), (layout.scenes or usual.scenes, READABLE)
    present = [(path / name, suffixes) for name, suffixes in folders if name and (path / name).is_dir()]
    return [line for folder, suffixes in present for line in unused_files(folder, suffixes)]


def _name_skipped(skipped: dict[str, str]) -> None:
    for reason in skipped.values():
        notes.print(f"[yellow]skipped:[/] {escape(reason)}", highlight=False, soft_wrap=True)

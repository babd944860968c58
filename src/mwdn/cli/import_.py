"""`mwdn import`: convert a data set to one file of pairs."""

from functools import partial
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter
from rich.markup import escape
from rich.progress import track

from mwdn.calibration import FrameFormat
from mwdn.cli.camera import console, errors
from mwdn.data.importers import Layout, import_pairs


def import_(
    kind: str,
    path: Path,
    *,
    out: Annotated[Path, Parameter(name=["--out", "-o"])] = Path("pairs.h5"),
    skip_damaged: bool = False,
    layout: Annotated[Layout, Parameter(name="*")] = Layout(),
    frames: Annotated[FrameFormat, Parameter(name="*")] = FrameFormat(),
) -> None:
    """Convert a public data set, or two folders of pictures, to one file of pairs.

    Args:
        kind: mwdn (the authors' HDF5), diffusercam, phlatcam, folders (captures/ and scenes/), or parquet.
        path: of the data set; for parquet a shard, a folder of shards, or owner/name on the Hugging Face hub.
        out: file of pairs to write, ending in .h5 or .hdf5; an existing file is replaced only on success.
        skip_damaged: skip pairs with a damaged or missing picture, and list them.
        layout: where this copy of the data set differs from the usual layout.
        frames: format of the captures, where it differs from the usual one.
    """
    progress = partial(track, description="Importing")
    result = import_pairs(kind, path, out, layout=layout, frames=frames, skip_damaged=skip_damaged, track=progress)
    for reason in result.skipped.values():
        errors.print(f"[yellow]skipped:[/] {escape(reason)}", highlight=False, soft_wrap=True)
    names = f": {', '.join(result.skipped)}" if result.skipped else ""
    summary = f"{result.count:,} pairs written to {out}, {len(result.skipped):,} skipped{names}"
    console.print(summary, markup=False, highlight=False, soft_wrap=True)

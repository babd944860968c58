"""`mwdn benchmark`: train and score every method of a recipe under one protocol."""

import os
import shlex
import sys
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter
from rich.progress import Progress, ProgressColumn

from mwdn.cli.camera import console, errors


def benchmark(
    recipe: Path,
    *,
    out: Annotated[Path, Parameter(name=["--out", "-o"])] = Path("runs/benchmark"),
    device: str | None = None,
) -> None:
    """Train and score every method of a recipe under one protocol, and write one page.

    The same command resumes an interrupted benchmark: finished networks and scores are kept. Several processes with one
    folder, started by hand or by torchrun, share the networks.

    Args:
        recipe: TOML file, see recipes/benchmark-*.toml. A method or a data set is one line of it.
        out: folder; index.html is the page, benchmark.md, .json and .csv hold the same results.
        device: cpu, cuda, cuda:1 ...; a GPU if there is one unless given.
    """
    from mwdn.benchmark import Watch, read_benchmark, run
    from mwdn.benchmark.run import PAGE

    contents = read_benchmark(recipe)
    columns: list[str | ProgressColumn] = [*Progress.get_default_columns(), "{task.fields[note]}"]
    with Progress(*columns, console=errors, disable=os.environ.get("RANK", "0") != "0") as bars:
        bar = bars.add_task("Starting", total=None, note="")

        def stage(title: str, parts: int) -> None:
            bars.print(title, markup=False, highlight=False)
            bars.reset(bar, description=title, total=parts or None, note="")

        watch = Watch(stage, lambda parts, note: bars.update(bar, completed=parts, note=note))
        run(contents, out, device=device, command=shlex.join(["mwdn", *sys.argv[1:]]), watch=watch)
    console.print(f"Look at {out / PAGE}", highlight=False, markup=False, soft_wrap=True)

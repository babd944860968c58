"""`mwdn benchmark`: every method of a recipe, trained and scored alike, on one page."""

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
    """Train every method of a recipe alike, score all under one protocol, and write one page.

    Run again, it goes on where it stopped: finished networks and scores stay, an interrupted training goes on. Run
    several times at once with one folder, or by torchrun, each process trains other networks.

    Args:
        recipe: TOML file, see recipes/benchmark-*.toml. A method or a data set is one line of it.
        out: folder; index.html is the page, benchmark.md, .json and .csv hold the same.
        device: cpu, cuda, cuda:1 ...; a GPU if there is one unless given.
    """
    from mwdn.benchmark import Watch, read_benchmark, run
    from mwdn.benchmark.run import PAGE

    chosen = read_benchmark(recipe)
    columns: list[str | ProgressColumn] = [*Progress.get_default_columns(), "{task.fields[note]}"]
    with Progress(*columns, console=errors, disable=os.environ.get("RANK", "0") != "0") as bars:
        bar = bars.add_task("Beginning", total=None, note="")

        def stage(title: str, parts: int) -> None:
            bars.print(title, markup=False, highlight=False)
            bars.reset(bar, description=title, total=parts or None, note="")

        watch = Watch(stage, lambda parts, note: bars.update(bar, completed=parts, note=note))
        run(chosen, out, device=device, command=shlex.join(["mwdn", *sys.argv[1:]]), watch=watch)
    console.print(f"Look at {out / PAGE}", highlight=False, markup=False, soft_wrap=True)

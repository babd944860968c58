"""`mwdn benchmark`: train and score every method of a recipe under one protocol."""

import os
import shlex
import sys
from dataclasses import replace
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from mwdn.cli.folders import no_empty_folder
from mwdn.cli.progress import show_progress
from mwdn.cli.terminal import say
from mwdn.cli.weights import ask_for_lpips


@no_empty_folder
def benchmark(
    recipe: Path,
    *,
    out: Annotated[Path, Parameter(name=["--out", "-o"])] = Path("runs/benchmark"),
    device: str | None = None,
    lpips: bool | None = None,
    seed: int | None = None,
) -> None:
    """Train and score every method of a recipe under one protocol, and write one page.

    The same command resumes an interrupted benchmark: finished networks and scores are kept. Several processes with one
    folder, started by hand or by torchrun, share the networks.

    Args:
        recipe: benchmark-small, benchmark-ablation, benchmark-quarter, benchmark-half, benchmark-paper, or a TOML file
            like those (`mwdn recipes`). A method or a data set is one line of it.
        out: folder; index.html is the page, benchmark.md, .json and .csv hold the same results.
        device: cpu, cuda, cuda:1 ...; a GPU if there is one unless given.
        lpips: LPIPS and feature MSE: download their public weights (234 MiB, once) if they are missing, or leave both
            metrics out. By default they are used if they are there; a terminal asks before a download.
        seed: of the initial weights; that of the recipe unless given. The pairs and their order have the seed of the
            data set.
    """
    from mwdn.benchmark import Watch, read_benchmark, run
    from mwdn.benchmark.run import PAGE

    contents = read_benchmark(recipe)
    if seed is not None:
        contents = replace(contents, schedule=replace(contents.schedule, seed=seed))
    lpips = ask_for_lpips(lpips, contents.alexnet, contents.heads)
    is_first = os.environ.get("RANK", "0") == "0"
    with show_progress(enabled=is_first, titles=True) as progress:
        watch = Watch(lambda title, parts: progress.start(title, parts or None, first=None), progress.update)
        run(contents, out, device=device, lpips=lpips, command=shlex.join(["mwdn", *sys.argv[1:]]), watch=watch)
    say(f"Look at {out / PAGE}")

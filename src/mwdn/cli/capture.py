"""`mwdn capture`: show pictures on a display, and record a pair of each."""

import sys
from contextlib import ExitStack
from pathlib import Path
from typing import Annotated, Any

from cyclopts import Parameter

from mwdn.cli.progress import show_progress
from mwdn.cli.recipe_keys import RecipeKeys, recipe_changes
from mwdn.cli.terminal import counted, if_interrupted, note, quoted, say
from mwdn.errors import ParameterError


def capture(
    recipe: Path,
    *,
    out: Annotated[Path, Parameter(name=["--out", "-o"])] = Path("captured.h5"),
    **changes: RecipeKeys,
) -> None:
    """Show pictures on a display in front of a camera, and record a pair of each: the picture and the raw frame.

    The same command continues an interrupted session. Options override keys of the recipe:
    --pictures.count 500, --camera.exposure-s 0.02, --session.settle-s 0.5.

    Args:
        recipe: capture-rig (the simulated rig), capture (a browser page), or a TOML file like those (`mwdn recipes`).
        out: file of pairs, ending in .h5; it can be read while it grows.
        **changes: of the recipe.
    """
    from mwdn.capture.recipe import read_capture_recipe
    from mwdn.capture.session import Session
    from mwdn.capture.set_up import open_camera, open_display, open_lamp

    contents = read_capture_recipe(recipe, **recipe_changes(changes))
    with ExitStack() as stack:
        stack.enter_context(if_interrupted(lambda: _interrupted(out)))
        camera = stack.enter_context(open_camera(contents))
        display = stack.enter_context(open_display(contents, camera, note))
        progress = stack.enter_context(show_progress())
        lamp = open_lamp(camera, _ask)
        session = Session(contents, camera, display, out, progress=_shown_in(progress), lamp=lamp)
        count = session.run()
    if contents.point.frames:
        say(f"Point, dark and white frames are there, too: mwdn calibrate {quoted(out)} -o camera.toml")
    say(f"{counted(count, 'pair')} in {out}", f"Next: mwdn align {quoted(out)} --camera camera.toml")


def _interrupted(out: Path) -> str:
    kept = f"All pairs so far are in {out}" if out.exists() else "Nothing is recorded yet"
    return f"Interrupted. {kept}. The same command continues."


def _ask(task: str) -> None:
    """Have a person do something before the session goes on.

    Raises:
        ParameterError: nobody is there to do it.
    """
    note(f"{task}, then press Enter.")
    if not sys.stdin.readline():
        raise ParameterError(f"{task}: nobody can press Enter, because this is no terminal. Start it in one.")


def _shown_in(progress: Any) -> Any:  # noqa: ANN401
    """A function that shows how many pairs are done; those of earlier runs say nothing about the speed."""

    def update(done: int, total: int, name: str) -> None:
        if progress.phase is None:
            progress.start("Capturing", total, first=done)
        progress.update(done, name)

    return update

"""Values of a camera file as options of a command; imported with the command line, so without torch."""

from typing import Any

from cyclopts import App
from cyclopts.config import Dict
from cyclopts.token import Token

from mwdn.errors import ParameterError


def from_camera_file(app: App, commands: tuple[str, ...], arguments: Any) -> None:  # noqa: ANN401
    """Read the options that the command line does not set from the file of ``--camera``.

    A ``.toml`` as the PSF or of ``--web`` is such a file, too.
    """
    by_name = {argument.name: argument for argument in arguments}
    given, psf, web = (by_name.get(name) for name in ("--camera", "--psf", "--web"))
    if web is not None and web.tokens and psf is not None:  # the camera of a page
        if psf.tokens or (given is not None and given.tokens):
            raise ParameterError("`--web` names the camera: leave out `--psf` and `--camera`.")
        psf.tokens[:] = [web.tokens[0].evolve(keyword="--psf")]
    if given is not None and not given.tokens and psf is not None and is_camera_file(psf.tokens):
        given.tokens[:], psf.tokens[:] = [psf.tokens[0].evolve(keyword="--camera")], []
    if given is None or not given.tokens:
        return
    from mwdn.calibration.camera_file import read_camera, with_changes

    path = given.tokens[0].value
    camera, bin = read_camera(path), by_name.get("--bin")
    if bin is not None and bin.tokens and bin.tokens[-1].value.isdecimal():
        camera = with_changes(camera, {"bin": int(bin.tokens[-1].value)})
    options = {key.replace("_", "-"): value for key, value in camera.items()}
    if commands[-1:] == ("import",):
        options.pop("background", None)  # of the PSF; the option of `import` is the room's light of a data set
    # Not every command has all of them, and some take unknown options for those of a method or a recipe.
    values = {name: _plain(value) for name, value in options.items() if f"--{name}" in by_name}
    Dict(values, source=path, use_commands_as_keys=False)(app, commands, arguments)


def is_camera_file(tokens: list[Token]) -> bool:
    """Whether the PSF was given as a camera file."""
    return len(tokens) == 1 and tokens[0].value.lower().endswith(".toml")


def _plain(value: Any) -> Any:  # noqa: ANN401
    """A value as in a TOML file: paths are text."""
    if isinstance(value, tuple):
        return [_plain(each) for each in value]
    return value if isinstance(value, int | float) else str(value)

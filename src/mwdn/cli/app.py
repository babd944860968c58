"""The command line, assembled from one file per command."""

import sys
import time
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib import import_module
from typing import NoReturn

import cyclopts
from cyclopts import App, Group, Parameter

from mwdn.cli import terminal
from mwdn.cli.as_typed import as_typed
from mwdn.cli.camera_values import from_camera_file
from mwdn.cli.given_options import note_given
from mwdn.cli.global_options import GLOBAL, add_global_options
from mwdn.cli.help_texts import HelpTexts
from mwdn.cli.signals import ended_by_signals, is_full
from mwdn.cli.wrong_calls import wrong_call
from mwdn.errors import MwdnError
from mwdn.runtime.memory import keep_memory
from mwdn.version import __version__

COMMANDS = {
    "reconstruct": ("reconstruct:reconstruct", "Reconstruct captures: files, or folders of them."),
    "calibrate": (
        "calibrate:calibrate",
        "Write a camera file: the PSF, and everything else that other commands need to know about the camera.",
    ),
    "capture": (
        "capture:capture",
        "Show pictures on a display in front of a camera, and record a pair of each: the picture and the raw frame.",
    ),
    "methods": ("methods:methods", "List the reconstruction methods, or the options of one."),
    "design": ("design:design", "Design a mask and compute the PSF of a camera with it."),
    "inspect": (
        "inspect:inspect",
        "Report the quality of a PSF: exposure, background, sharpness, spectrum, noise gain, resolution.",
    ),
    "interpret": (
        "interpret:interpret",
        "Draw what a network did with a capture: PSFs, w and lambda, estimates at each scale, what each filter adds.",
    ),
    "align": (
        "align:align",
        "Find where displayed pictures are in the camera's frame, and write aligned pairs of a session.",
    ),
    "simulate": ("train:simulate", "Write a file of pairs: photographs as scenes, and simulated captures of them."),
    "train": (
        "train:train",
        "Train a network for one camera, on simulated captures, on recorded pairs, or on captures without scenes.",
    ),
    "recipes": (
        "recipes:recipes",
        "List the recipes of the package, or print one: `mwdn recipes quick-cpu > mine.toml`.",
    ),
    "export": (
        "export:export",
        "Write a method for one camera as a file (ONNX, torch's .pt2, bioimage.io) or as a page (--web).",
    ),
    "benchmark": (
        "benchmark:benchmark",
        "Train and score every method of a recipe under one protocol, and write one page.",
    ),
    "evaluate": ("evaluate:evaluate", "Compare methods on pairs of measurements and scenes: quality, time, memory."),
    "demo": (
        "demo:demo",
        "Simulate a small lensless camera and reconstruct its captures with five methods that need no training.",
    ),
    "preview": (
        "preview:preview",
        "Serve a page that reconstructs captures, and an HTTP interface: drop a PSF and a capture, or try the samples.",
    ),
    "explain": ("explain:explain", "Explain a doubt of another command: what it means, its cause, and what to do."),
    "doctor": ("doctor:doctor", "Print versions, devices, supported precisions and threads."),
    "import": (
        "import_:import_",
        "Convert a public data set, or two folders of pictures, to one file of pairs.",
    ),
}
"""Module in `mwdn.cli` and function of each command, and the first line of its docstring."""

COMMAND_GROUPS = (
    (Group("Get pictures", sort_key=0), ("reconstruct", "methods", "explain", "export")),
    (Group("Try it", sort_key=1), ("demo", "preview", "doctor")),
    (Group("Describe a camera", sort_key=2), ("calibrate", "inspect", "design")),
    (Group("Record pairs", sort_key=3), ("capture", "align", "import", "simulate")),
    (Group("Train and compare", sort_key=4), ("train", "recipes", "evaluate", "benchmark", "interpret")),
)
"""Commands in the order of the help."""


def make_app(command: str | None = None) -> App:
    """The command line. Only the one command that runs is imported: most import torch, which takes two seconds."""
    app = App(
        name="mwdn",
        version=__version__,
        config=(from_camera_file, note_given),
        help="Lensless imaging: reconstruct the scene from the pattern that a thin mask casts on a sensor.",
        help_formatter=HelpTexts(command) if command else None,
        group_commands=None if command else Group("Others", sort_key=len(COMMAND_GROUPS)),
        help_format=None if command else "plaintext",  # Markdown takes 0.1 s to import
        suppress_keyboard_interrupt=False,  # `main` says how to go on
        default_parameter=Parameter(negative_iterable=()),  # no `--empty-crop`
    )
    groups = {name: group for group, names in COMMAND_GROUPS for name in names}
    for name, (place, summary) in COMMANDS.items():
        module, _, function = place.partition(":")
        if name == command:
            app.command(getattr(import_module(f"mwdn.cli.{module}"), function), name=name)
        else:
            app.command(f"mwdn.cli.{place}", name=name, help=summary, group=groups[name])
    add_global_options(app)
    app.register_install_completion_command(
        help="Let the shell (bash, zsh, fish, PowerShell) complete commands and options."
    )
    return app


def main(arguments: list[str] | None = None) -> NoReturn:
    """Run the command line and exit: 0 on success, 1 if some captures or methods failed, 2 for a wrong call.

    The other exit codes are those of `mwdn.cli.signals`.
    """
    arguments = sys.argv[1:] if arguments is None else arguments
    with ended_by_signals(arguments) as received:
        sys.exit(_run(arguments, received))


def _run(arguments: list[str], received: Sequence[int]) -> int:
    """Run a command until it ends or a signal is received; returns the exit code."""
    chosen = {name: not {name, short}.isdisjoint(arguments) for name, short in GLOBAL.items()}
    arguments = [argument for argument in arguments if argument not in {*GLOBAL, *GLOBAL.values()}]
    command = next((argument for argument in arguments if argument in COMMANDS), None)
    arguments = _complete_design(arguments) if command == "design" else arguments
    keep_memory()
    app = make_app(command)
    terminal.set_up(
        quiet=chosen["--quiet"],
        verbose=chosen["--verbose"],
        json="--json" in arguments,
        spell=lambda message: as_typed(message, _options(app, arguments), arguments),
    )
    try:
        with warnings.catch_warnings(), _timed(verbose=chosen["--verbose"]):
            warnings.showwarning = lambda message, *_, **__: terminal.warn(str(message))
            if command == "design":
                import_module("mwdn.cli.design").add_plugins(arguments)
            result = app(arguments, console=terminal.results, exit_on_error=False, print_error=False)
    except (MwdnError, cyclopts.CycloptsError) as error:
        if received:  # torch.export turns Ctrl-C into an error of its own
            raise
        if chosen["--debug"]:
            terminal.errors.print_exception()
        if isinstance(error, cyclopts.CycloptsError):
            error = wrong_call(error, COMMANDS)
        terminal.complain("[bold red]Error:[/]", error)
        return 2
    except OSError as error:  # such as a path that is too long, or lies in a folder that may not be searched
        if received or chosen["--debug"] or isinstance(error, BrokenPipeError) or is_full(error):
            raise
        where = f"`{error.filename}`: " if error.filename else ""
        terminal.complain("[bold red]Error:[/]", MwdnError(f"{where}{error.strerror or error}."))
        return 2
    return result if isinstance(result, int) else 0


def _complete_design(arguments: list[str]) -> list[str]:
    """`mwdn design` alone prints its help; `mwdn design --mask FILE` is short for `mwdn design array --mask FILE`."""
    first = arguments.index("design") + 1
    if first == len(arguments):
        return [*arguments, "--help"]
    has_mask = any(argument.partition("=")[0] == "--mask" for argument in arguments)
    is_short = has_mask and arguments[first].startswith("-")
    return [*arguments[:first], "array", *arguments[first:]] if is_short else arguments


def _options(app: App, arguments: list[str]) -> set[str]:
    """Options of the command that runs, or whose help is printed."""
    _, apps, _ = app.parse_commands([word for word in arguments if word not in {*app.help_flags, *app.version_flags}])
    if apps[-1].default_command is None:
        return set()
    return {name for argument in apps[-1].assemble_argument_collection() for name in argument.names}


@contextmanager
def _timed(*, verbose: bool) -> Iterator[None]:
    """Print the versions before a command and its time after it, if they are wanted."""
    if not verbose:
        yield
        return
    from mwdn.runtime.environment import describe_environment

    terminal.detail(", ".join(f"{name} {value}" for name, value in describe_environment().items()))
    start = time.perf_counter()
    try:
        yield
    finally:
        terminal.detail(f"{time.perf_counter() - start:.1f} s")

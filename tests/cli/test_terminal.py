"""What is printed where, and in which words."""

import pytest

from mwdn.cli import terminal
from mwdn.cli.as_typed import as_typed
from mwdn.errors import ParameterError

OWN = {"--photos", "--bin", "--psf-bin", "--crop", "--grey", "--mosaic", "-o"}
TYPED = [
    "train",
    "r.toml",
    "--photos",
    "photos",
    "--bin",
    "2",
    "--steps",
    "0",
    "--schedule.crop=3",
    "--mismatch.blur-px",
    "-1",
]


@pytest.mark.parametrize(
    ("message", "expected"),
    [
        ("`bin` (0) must be at least 1.", "`--bin` (0) must be at least 1."),
        ("`psf_bin` or `bin`, not `o`", "`--psf-bin` or `--bin`, not `o`"),
        ("`steps` (0) must be positive.", "`--steps` (0) must be positive."),
        ("`blur_px` (-1) is negative.", "`--mismatch.blur-px` (-1) is negative."),
        ("`--bin` and `bin.png` stay, `count` and `crop` of [schedule], too.", None),
        ("[schedule]: `crop` (3) needs `pool`.", "[schedule]: `--schedule.crop` (3) needs `pool`."),
        ("[schedule]: `steps` (0) must be positive.", "[schedule]: `--steps` (0) must be positive."),
        ("The folder `photos` is a word of its own.", None),
        ("[data.own]: `bin` (0) must be at least 1.", None),
        ("bin it: `bin=8, psf_bin=4`, or `crop=(8, 9)`.", "bin it: `--bin 8 --psf-bin 4`, or `--crop 8 9`."),
        ("`grey=True` or `mosaic='rggb'`.", "`--grey` or `--mosaic rggb`."),
        ("`bin=4, levels=3`, `bin=N` and `f(bin=4)` stay, `name == bin`, too.", None),
    ],
)
def test_words_of_the_library_as_the_user_types_them(message, expected):
    assert as_typed(message, OWN, TYPED) == (expected or message)


@pytest.fixture
def printed(capsys):
    """Print one of each kind after `set_up`; gives standard output and standard error."""

    def call(**options):
        terminal.set_up(**options)
        try:
            terminal.results.print("result")
            terminal.say("done")
            terminal.note("remark")
            terminal.warn(None, "first\n   line")
            terminal.detail("version")
            terminal.complain("Error:", ParameterError("`bin`"))
        finally:
            terminal.set_up()
        out, err = capsys.readouterr()
        return out.splitlines(), err.splitlines()

    return call


@pytest.mark.parametrize("say", [terminal.say, terminal.note, terminal.warn])
def test_any_file_name_is_printed_on_one_line(capsys, say):
    """A name that is no UTF-8 ended the command with a UnicodeEncodeError, and [red] is no colour."""
    say("[red]a[/red] \n\udcff.png")
    (line,) = "".join(capsys.readouterr()).splitlines()
    assert "[red]a[/red]" in line
    assert line.endswith(r"\udcff.png")


def test_a_warning_beside_the_help(run, capsys):
    """Its words are compared with the command's options: those of cyclopts' own --help ended in a NameError."""
    run("recipes --help")
    terminal.warn("`name`")
    assert capsys.readouterr().err == "Warning: `name`\n"


def test_levels_of_output(printed):
    told = ["remark", "Warning: first line"]
    assert printed() == (["result", "done"], [*told, "Error: `bin`"])
    assert printed(quiet=True) == (["result"], ["Error: `bin`"])
    assert printed(verbose=True) == (["result", "done"], [*told, "version", "Error: `bin`"])
    assert printed(json=True) == (["result"], ["done", *told, "Error: `bin`"])
    assert printed(quiet=True, spell=str.upper) == (["result"], ["Error: `BIN`"])

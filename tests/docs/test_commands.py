"""The commands of README and docs have the command line's names: each is parsed, none is run."""

import re
import shlex
from pathlib import Path

import pytest

from mwdn.cli.app import COMMANDS, make_app

ROOT = Path(__file__).resolve().parents[2]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
BLOCK = re.compile(r"^```sh\n(.*?)^```$", re.MULTILINE | re.DOTALL)
END = re.compile(r"\s+(?:#|\||>|2>|\|\||&|;).*")
LEFT_OUT = re.compile(r"\$|\.\.\.|--help|--version|--install|\[|<|camera=")


def commands(page):
    """Each `mwdn ...` of the blocks of a page, and of the tables of docs/reproduce.md, without comments and pipes."""
    text = page.read_text(encoding="utf-8")
    lines = [line for block in BLOCK.findall(text) for line in block.replace("\\\n", " ").splitlines()]
    lines += re.findall(r"`(mwdn [^`]*)`", text) if page.name == "reproduce.md" else []
    right = [line.strip() for line in lines if "|| echo" not in line]  # the others show an error
    return [END.sub("", line) for line in right if line.startswith("mwdn ")]


def test_commands_are_found():
    assert len(commands(ROOT / "docs" / "reproduce.md")) > 15
    assert sum(len(commands(page)) for page in PAGES) > 100


@pytest.mark.acceptance
@pytest.mark.parametrize("name", COMMANDS)
def test_commands_of_the_docs_can_be_parsed(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    app = make_app(name)
    for page in PAGES:
        for command in commands(page):
            words = [word for word in shlex.split(command)[1:] if word not in ("--quiet", "-q", "--verbose", "--debug")]
            if words[:1] == [name] and not LEFT_OUT.search(command):
                joined = re.sub(r"--camera \S+", "", shlex.join(words))  # a camera file is read here already
                words = shlex.split(re.sub(r"\S*camera\.toml", "psf.png", joined))
                app.parse_args(words, exit_on_error=False, print_error=False)

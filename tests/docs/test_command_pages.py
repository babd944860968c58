"""Every command has its page: what it does, a walked example, files, errors, and the options that the help has."""

import importlib.util
import re
from pathlib import Path

import pytest

pytest.importorskip("mkdocs", reason="the extra `docs` is not installed")

from mwdn.cli.app import COMMANDS, make_app

ROOT = Path(__file__).resolve().parents[2]
PAGES = ROOT / "docs" / "commands"
TRANSCRIPT = re.compile(r"^```sh\n.*?^```\n\n```text\n.+?^```$", re.MULTILINE | re.DOTALL)


@pytest.fixture(scope="module")
def hook():
    spec = importlib.util.spec_from_file_location("site_commands", ROOT / "docs" / "site" / "commands.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_every_command_has_a_page_and_every_page_a_command():
    assert {path.stem for path in PAGES.glob("*.md")} == {"index", *COMMANDS}
    listed = re.findall(r"\((\w+)\.md\)", (PAGES / "index.md").read_text(encoding="utf-8"))
    assert sorted(listed) == sorted(COMMANDS)


@pytest.mark.parametrize("name", COMMANDS)
def test_a_page_says_what_the_help_says_and_shows_what_comes_out(name):
    text = (PAGES / f"{name}.md").read_text(encoding="utf-8")
    assert text.startswith(f"# mwdn {name}\n\n{COMMANDS[name][1]}\n")
    assert re.findall(r"^## (.*)", text, re.MULTILINE) == ["Example", "Files", "Exit status and errors", "Options"]
    assert f"<!-- options of mwdn {name} -->" in text
    assert TRANSCRIPT.search(text)
    assert all((PAGES / picture).is_file() for picture in re.findall(r"\(([\w-]+\.webp) ", text))


@pytest.mark.parametrize("words", [["evaluate"], ["design", "coded"]])
def test_the_tables_have_every_option_of_the_help(hook, words):
    page = hook.on_page_markdown(f"before\n\n<!-- options of mwdn {words[0]} -->\n")
    arguments = make_app(words[0])
    for word in words:
        arguments = arguments[word]
    names = {name for each in arguments.assemble_argument_collection() if each.show for name in each.names}
    names = {name for name in names if name.startswith("--") and not name.startswith("--empty-")}  # the app has none
    assert len(names) > 10
    assert all(f"`{name}" in page for name in names)
    assert "<!--" not in page
    assert "--quiet" not in page

"""Tutorials have their transcripts and pictures; walking them and the commands' pages is an acceptance test."""

import importlib.util
import re
from pathlib import Path

import pytest

from mwdn.cli.app import COMMANDS

ROOT = Path(__file__).resolve().parents[2]
PAGES = sorted((ROOT / "docs" / "tutorials").glob("*.md"))


@pytest.fixture(scope="module")
def tutorials():
    spec = importlib.util.spec_from_file_location("walk", ROOT / "docs" / "walk.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def page(name):
    return (ROOT / "docs" / "tutorials" / f"{name}.md").read_text(encoding="utf-8")


@pytest.mark.parametrize("name", [path.stem for path in PAGES if path.stem != "index"])
def test_a_tutorial_shows_what_comes_out(tutorials, name):
    text = page(name)
    transcripts = [match[2] for match in tutorials.COMMANDS.finditer(text)]
    assert len(transcripts) >= 3
    assert any(transcripts)
    pictures = tutorials.PICTURE.findall(text)
    assert pictures
    assert all((ROOT / "docs" / "tutorials" / picture).stat().st_size < 200_000 for picture, _ in pictures)
    assert set(re.findall(r"^\s*mwdn (\w+)", text, re.MULTILINE)) <= set(COMMANDS)
    assert f"({name}.md)" in page("index")


def test_transcripts_are_filled_in_and_compared_without_their_numbers(tutorials, tmp_path):
    text = 'A\n\n```sh\necho "1.5 s, 0f3b9b19e85efa4c"\n```\n\n```text\n9\n```\n\nB\n\n```sh\ntrue\n```\n'
    printed = tutorials.run(text, tmp_path)
    assert printed == ["1.5 s, 0f3b9b19e85efa4c", ""]
    walked = tutorials.filled(text, printed)
    assert walked == text.replace("\n9\n", "\n1.5 s, 0f3b9b19e85efa4c\n")
    other = walked.replace("1.5", "27").replace("0f3b9b19e85efa4c", "ffffffffffffffff")
    assert tutorials.structure(other) == tutorials.structure(walked) != tutorials.structure(text)
    with pytest.raises(RuntimeError, match="block 2 ended with 3"):
        tutorials.run(text.replace("true", "exit 3"), tmp_path)


def test_commands_of_another_page_come_first_and_are_not_shown(tutorials, tmp_path):
    assert tutorials.run("```sh\ncat file\n```\n", tmp_path, "```sh\necho before\necho text > file\n```\n") == ["text"]


WALKED = [*(f"tutorials/{path.stem}" for path in PAGES if path.stem != "index"), *(f"commands/{n}" for n in COMMANDS)]


@pytest.mark.acceptance
@pytest.mark.parametrize("name", WALKED)
def test_walked_again_a_page_differs_in_numbers_only(tutorials, name):
    if name == "commands/doctor":
        pytest.skip("its output describes the machine")
    assert tutorials.walk(name, check=True) == []

"""docs/reliability.md: each row of its tables names tests that exist and run, each cell of the stages one."""

import ast
import re
from functools import cache
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
TEXT = (ROOT / "docs" / "reliability.md").read_text(encoding="utf-8")
TEST = re.compile(r"`(tests/[\w/]+/test_\w+\.py|tests/test_\w+\.py)::(test_\w+)`")


def rows(title):
    section = TEXT.partition(f"## {title}\n")[2].partition("\n## ")[0]
    return [
        [cell.strip() for cell in line.strip("|").split(" | ")] for line in section.splitlines() if line[:2] == "| "
    ][2:]


@cache
def functions_of(path):
    """Functions that pytest collects from a file, with their decorators as text."""
    tree = ast.parse((ROOT / path).read_text(encoding="utf-8"))
    functions = [node for node in tree.body if isinstance(node, ast.FunctionDef)]
    return {node.name: [ast.unparse(decorator) for decorator in node.decorator_list] for node in functions}


def test_each_input_and_each_cell_of_a_stage_names_its_test():
    inputs, stages = rows("Every input"), rows("Every stage")
    assert (len(inputs) >= 20, len(stages) >= 7) == (True, True)
    assert [row for row in inputs if len(row) != 3 or not TEST.search(row[2])] == []
    unnamed = [(row[0], cell) for row in stages for cell in row[1:] if not TEST.search(cell) and cell != "as `train`"]
    assert unnamed == []


def test_a_file_is_never_named_without_its_test():
    """A file can lose the one test that a row is about, and still exist."""
    tables = "\n".join(line for line in TEXT.splitlines() if line.startswith("| "))
    assert re.findall(r"`tests/[\w/]*test_\w+\.py`", tables) == []


def test_the_tests_exist_and_run():
    named = set(TEST.findall(TEXT))
    assert len(named) > 50
    for path, name in sorted(named):
        assert (ROOT / path).is_file(), path
        assert name in functions_of(path), (path, name)
        off = [mark for mark in functions_of(path)[name] if re.match(r"pytest\.mark\.(skip\b|xfail)", mark)]
        assert off == [], name
    scripts = set(re.findall(r"(tests/[\w/]+\.py)", TEXT))
    assert [path for path in scripts if not (ROOT / path).is_file()] == []

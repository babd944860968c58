"""docs/reliability.md names tests that exist, in each row of its first two tables."""

import ast
import re
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
TEXT = (ROOT / "docs" / "reliability.md").read_text(encoding="utf-8")


def rows(title):
    section = TEXT.partition(f"## {title}\n")[2].partition("\n## ")[0]
    return [line for line in section.splitlines() if line.startswith("| ")][2:]


def test_each_input_and_stage_names_its_test():
    for title, least in (("Every input", 20), ("Every stage", 7)):
        assert len(rows(title)) >= least
        assert [row for row in rows(title) if "`tests/" not in row] == []


def test_the_tests_exist():
    named = set(re.findall(r"`[^`]*?(tests/[\w/]+\.py)(?:::(\w+))?", TEXT))
    assert len(named) > 40
    for path, name in named:
        assert (ROOT / path).is_file(), path
        tree = ast.parse((ROOT / path).read_text(encoding="utf-8"))
        assert not name or name in {node.name for node in tree.body if isinstance(node, ast.FunctionDef)}, (path, name)

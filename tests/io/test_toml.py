"""Recipes by name or path."""

from pathlib import Path

import pytest

from mwdn.errors import ParameterError, UnknownNameError
from mwdn.io.toml import find_recipe, packaged_recipes, read_toml


def test_name_of_the_package_or_path(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert find_recipe("quick-cpu") == find_recipe(Path("quick-cpu"))
    assert find_recipe("quick-cpu").parent.name == "recipes"
    for name in ("mine.toml", "quick-cpu"):  # a file of one's own comes first
        Path(name).touch()
        assert find_recipe(name) == Path(name)


def test_an_unknown_name_has_a_nearest():
    with pytest.raises(UnknownNameError, match="'quick-cpu'"):
        find_recipe("quick-cpo")


@pytest.mark.parametrize("path", ["recipes/quick-cpu.toml", "quick-cpu.toml"])
def test_path_of_a_recipe_of_the_package(path, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ParameterError, match=f"`{path}` .* `quick-cpu`"):
        find_recipe(path)


@pytest.mark.parametrize("name", packaged_recipes())
def test_each_recipe_says_on_one_line_what_it_is_for_and_then_how_to_use_it(name):
    first, _, rest = find_recipe(name).read_text(encoding="utf-8").partition("\n")
    assert first.startswith("# ")
    assert first.endswith(".")
    assert f" {name} " in rest


def test_only_the_parts_of_a_key_are_counted(tmp_path):
    """Dots of texts and comments were taken for parts."""
    path, dots = tmp_path / "a.toml", 120 * "."
    path.write_text(f"a = 1 # {dots}\nb = \"{dots}\"\nc = '{dots}'\n", encoding="utf-8")
    assert read_toml(path) == {"a": 1, "b": dots, "c": dots}
    for text in (".".join(120 * "a") + " = 1", f"[{'.'.join(120 * 'a')}]", "a = { " + ".".join(120 * '"a"') + " = 1 }"):
        path.write_text(text, encoding="utf-8")
        with pytest.raises(ParameterError, match="100 parts"):
            read_toml(path)

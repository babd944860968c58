"""`mwdn recipes`: the recipes that come with the package."""

from rich.table import Table

from mwdn.cli.terminal import results
from mwdn.io.toml import find_recipe, packaged_recipes


def recipes(name: str | None = None, /) -> None:
    """List the recipes of the package, or print one: `mwdn recipes quick-cpu > mine.toml`.

    Args:
        name: of a recipe; all are listed unless given.
    """
    if name is not None:
        results.out(find_recipe(name).read_text(encoding="utf-8"), end="", highlight=False)
        return
    table = Table("name", "description")
    for recipe in packaged_recipes():
        table.add_row(recipe, find_recipe(recipe).read_text(encoding="utf-8").partition("\n")[0].removeprefix("# "))
    results.print(table, markup=False)

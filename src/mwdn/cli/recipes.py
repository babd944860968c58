"""`mwdn recipes`: the recipes that come with the package."""

from rich.table import Table

from mwdn.cli.terminal import results
from mwdn.io.reading import read_text
from mwdn.io.toml import find_recipe, packaged_recipes


def recipes(name: str | None = None, /) -> None:
    """List the recipes of the package, or print one: `mwdn recipes quick-cpu > mine.toml`.

    Args:
        name: of a recipe; all are listed unless given.
    """
    if name is not None:
        results.out(read_text(find_recipe(name)), end="", highlight=False)
        return
    table = Table("name", "description")
    for recipe in packaged_recipes():
        table.add_row(recipe, read_text(find_recipe(recipe)).partition("\n")[0].removeprefix("# "))
    results.print(table, markup=False)

"""Keys of a recipe as options: ``--pictures.count 500`` is `count` of [pictures]."""

from typing import Annotated, Any

from cyclopts import Parameter

from mwdn.io.toml import parse_value


def recipe_changes(tokens: Any) -> Any:  # noqa: ANN401
    """Changes of a recipe, from the tokens of ``--key value`` and ``--table.key value``."""
    if isinstance(tokens, dict):
        return {key.replace("-", "_"): recipe_changes(value) for key, value in tokens.items()}
    return parse_value(tokens[-1].value)


RecipeKeys = Annotated[Any, Parameter(converter=lambda _, tokens: tokens, show=False)]

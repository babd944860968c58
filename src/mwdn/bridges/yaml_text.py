"""Tables as YAML text, for the metadata that other programs read."""

import json
from collections.abc import Iterator, Mapping
from typing import Any


def to_yaml(content: Mapping[str, Any]) -> str:
    """A table of texts, numbers, truth values, tables and lists as YAML, texts in quotation marks as in JSON."""
    return "\n".join(_lines(content)) + "\n"


def _lines(value: Any) -> Iterator[str]:  # noqa: ANN401
    if isinstance(value, Mapping) and value:
        for key, item in value.items():
            if isinstance(item, Mapping | list) and item:
                yield f"{key}:"
                yield from (f"  {line}" for line in _lines(item))
            else:
                yield f"{key}: {json.dumps(item, ensure_ascii=False)}"
    elif isinstance(value, list) and value:
        for item in value:
            first, *others = _lines(item)
            yield f"- {first}"
            yield from (f"  {line}" for line in others)
    else:
        yield json.dumps(value, ensure_ascii=False)

"""Recipes: one experiment a TOML file, read into frozen dataclasses."""

import dataclasses
import json
import tomllib
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import torch

from mwdn.data.simulated import Mismatch, Placement
from mwdn.errors import MwdnError, ParameterError, UnknownNameError
from mwdn.learning.losses import checked_weights
from mwdn.networks import build
from mwdn.optics.sensor import Sensor

T = TypeVar("T")


@dataclass(frozen=True)
class Schedule:
    """How long and how fast to learn.

    Args:
        steps: optimiser steps.
        batch: samples a step, over all processes together.
        learning_rate: at its highest, after the warm-up; it then falls to 1 % as half a cosine.
        warmup: steps of linear rise.
        weight_decay: of AdamW, on convolution weights alone.
        ema: the checkpoint holds a running mean of the weights, with this decay a step; 0 for the last weights.
        bfloat16: compute convolutions in bfloat16 where the hardware has it.
        validate_every: steps between validations, checkpoints and contact sheets.
        validation: samples in a validation.
        seed: of initial weights and data.
    """

    steps: int = 2000
    batch: int = 4
    learning_rate: float = 1e-3
    warmup: int = 50
    weight_decay: float = 1e-4
    ema: float = 0.99
    bfloat16: bool = True
    validate_every: int = 250
    validation: int = 16
    seed: int = 0

    def __post_init__(self) -> None:
        for name in ("steps", "batch", "learning_rate", "validate_every", "validation"):
            if not getattr(self, name) > 0:
                raise ParameterError(f"`{name}` ({getattr(self, name)}) must be positive.")
        for name in ("warmup", "weight_decay"):
            if not getattr(self, name) >= 0:
                raise ParameterError(f"`{name}` ({getattr(self, name)}) must not be negative.")
        if not 0 <= self.ema < 1:
            raise ParameterError(f"`ema` ({self.ema}) must be in [0, 1).")


@dataclass(frozen=True)
class Recipe:
    """One experiment.

    Args:
        network: its name, and options under their own names; empty only where nothing is trained.
        schedule: see `Schedule`.
        loss: weights of its parts, see `mwdn.learning.losses.Loss`.
        placement: see `mwdn.data.simulated.Placement`.
        mismatch: see `mwdn.data.simulated.Mismatch`.
        sensor: see `mwdn.optics.sensor.Sensor`.
    """

    network: dict[str, Any] = field(default_factory=dict)
    schedule: Schedule = Schedule()
    loss: dict[str, float] = field(default_factory=lambda: {"mse": 1.0})
    placement: Placement = Placement()
    mismatch: Mismatch = Mismatch()
    sensor: Sensor = Sensor()

    def as_dict(self) -> dict[str, Any]:
        """Plain values that JSON can hold."""
        return dataclasses.asdict(self)


def read_recipe(path: str | Path, **schedule: Any) -> Recipe:  # noqa: ANN401
    """Read a recipe.

    Args:
        path: TOML with the tables of `Recipe`.
        **schedule: values that replace those of the recipe's schedule; ``None`` leaves one as it is.

    Raises:
        ParameterError: the file cannot be read, names no network, or a value is outside its range.
        UnknownNameError: a table, a key, a network or an option of it that does not exist.
    """
    try:
        content = tomllib.loads(Path(path).read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise ParameterError(f"`{path}` cannot be read as a recipe: {error}") from error
    fields = {f.name: f for f in dataclasses.fields(Recipe)}
    for table in content:
        if table not in fields:
            raise UnknownNameError("table of a recipe", table, fields)
        if not isinstance(content[table], dict):
            raise ParameterError(f"`{table}` of `{path}` ({content[table]!r}) must be a table: [{table}].")
    if not isinstance(content.get("network", {}).get("name"), str):
        raise ParameterError(f'`{path}` must name a network: [network] name = "mwdn".')
    _try(content["network"])
    if "loss" in content:
        content["loss"] = checked_weights(content["loss"])
    changes = {name: value for name, value in schedule.items() if value is not None}
    content["schedule"] = content.get("schedule", {}) | changes
    kinds = {"schedule": Schedule, "placement": Placement, "mismatch": Mismatch, "sensor": Sensor}
    return Recipe(**{name: _fill(kinds[name], table) if name in kinds else table for name, table in content.items()})


def _fill(kind: type[T], table: dict[str, Any]) -> T:
    known = {f.name: f.default for f in dataclasses.fields(kind)}  # type: ignore[arg-type]
    name = kind.__name__.lower()
    for key, value in table.items():
        if key not in known:
            raise UnknownNameError(f"key of [{name}]", key, known)
        if not _alike(_listless(value), known[key]):
            example = json.dumps(known[key])
            raise ParameterError(f"`{key}` of [{name}] ({value!r}) must be of the same kind as its default, {example}.")
    return kind(**{key: _as_float(_listless(value), known[key]) for key, value in table.items()})


def _listless(value: Any) -> Any:  # noqa: ANN401
    return tuple(value) if isinstance(value, list) else value


def _alike(value: object, example: object) -> bool:
    if isinstance(value, tuple) and isinstance(example, tuple):
        return len(value) == len(example) and all(map(_alike, value, example))
    return type(value) is type(example) or (type(value) is int and type(example) is float)


def _as_float(value: Any, example: object) -> Any:  # noqa: ANN401
    """TOML's 12 where 12.0 is meant."""
    if isinstance(value, tuple) and isinstance(example, tuple):
        return tuple(map(_as_float, value, example))
    return float(value) if isinstance(example, float) else value


def _try(network: dict[str, Any]) -> None:
    """Build it without memory: a mistake is found before a thousand photographs have been read."""
    try:
        with torch.device("meta"):
            build(**network)
    except (TypeError, ValueError, RuntimeError) as error:
        if isinstance(error, MwdnError):
            raise
        raise ParameterError(f"[network] {network} cannot be built: {error}") from error

"""The recipe of a benchmark: methods, data sets, and the one budget for all."""

import json
import os
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, is_dataclass, replace
from inspect import signature
from pathlib import Path
from typing import Any

from mwdn.benchmark.sets import PRESETS, DataSet
from mwdn.errors import ParameterError, UnknownNameError, check_options
from mwdn.io.toml import fill, read_toml
from mwdn.networks import NETWORKS
from mwdn.optics import Deviation
from mwdn.solvers import SOLVERS
from mwdn.training.losses import checked_weights
from mwdn.training.recipe import Schedule

AXES = {"noise": 1.0, **{part.name: 0.0 for part in fields(Deviation)}}
"""What a robustness sweep varies, and its value in the camera that networks were trained for: noise as a multiple."""


@dataclass(frozen=True)
class Method:
    """One line of the table.

    Args:
        label: its name there.
        name: of a network or a solver.
        options: it is built with.
        learned: a network.
    """

    label: str
    name: str
    options: dict[str, Any]
    learned: bool


@dataclass(frozen=True)
class Robustness:
    """What happens where the camera differs more from its calibration than it did in training.

    Args:
        data: a simulated data set; empty for none.
        count: test pictures for each size.
        sizes: of each of `AXES` that is swept.
    """

    data: str = ""
    count: int = 8
    sizes: dict[str, tuple[float, ...]] = field(default_factory=dict)


@dataclass(frozen=True)
class Benchmark:
    """Every method, one budget, one protocol a data set.

    Args:
        title: of the page.
        methods: in the order of the tables.
        data: data sets by their names.
        schedule: of every network; see `published`.
        loss: likewise.
        published: take optimiser, learning rate and weight decay of each network from its own source, if that says.
        rate_factor: multiplies these learning rates, alike for all: sources that train for days start slower.
        ablation: labels of the paper's ablation, in its order.
        compared: label that all others are compared with, picture by picture.
        shown: test pictures to show of each data set.
        width_factor: every network's own width times this, the same for all; a line of the recipe may say otherwise.
        robustness: see `Robustness`.
        alexnet: file of AlexNet's weights; found or downloaded unless given.
        heads: file of LPIPS's heads; likewise.
        path: of the recipe.
    """

    title: str = "Benchmark"
    methods: tuple[Method, ...] = ()
    data: dict[str, DataSet] = field(default_factory=dict)
    schedule: Schedule = Schedule()
    loss: dict[str, float] = field(default_factory=lambda: {"mse": 1.0})
    published: bool = True
    rate_factor: float = 1.0
    ablation: tuple[str, ...] = ()
    compared: str = ""
    shown: int = 4
    width_factor: float = 1.0
    robustness: Robustness = Robustness()
    alexnet: str = ""
    heads: str = ""
    path: str = ""


def read_benchmark(path: str | Path) -> Benchmark:
    """Read a recipe.

    Args:
        path: TOML with the tables [networks], [solvers], [data], [schedule], [loss], [shared.network],
            [shared.data], [robustness], and the other fields of `Benchmark`. Paths begin at its folder, or with the
            name of an environment variable, as in ``$MWDN_DATA/photos``.

    Raises:
        ParameterError: the file cannot be read, nothing is to be compared, or a value is outside its range.
        UnknownNameError: a name, a table or a key that does not exist.
    """
    content = read_toml(path)
    known = {f.name for f in fields(Benchmark)} - {"methods", "path"} | {"networks", "solvers", "shared"}
    for key in content:
        if key not in known:
            raise UnknownNameError("key of a benchmark's recipe", key, known)
    shared = content.pop("shared", {})
    learned = _methods("networks", content.pop("networks", {}), NETWORKS, shared.get("network", {}))
    methods = *_methods("solvers", content.pop("solvers", {}), SOLVERS, {}), *learned
    folder = Path(path).parent
    data = {n: _data_set(n, {**shared.get("data", {}), **t}, folder) for n, t in content.pop("data", {}).items()}
    schedule = fill(Schedule, "schedule", content.pop("schedule", {}))
    loss = checked_weights(content.pop("loss", {"mse": 1.0}))
    robustness = _robustness(content.pop("robustness", {}))
    for name in ("alexnet", "heads"):
        content[name] = _place(content.get(name, ""), folder)
    plain = fill(_Plain, "the recipe", content)
    values = {f.name: getattr(plain, f.name) for f in fields(_Plain)}
    methods = tuple(_narrowed(method, plain.width_factor) for method in methods)
    found = Benchmark(
        methods=methods, data=data, schedule=schedule, loss=loss, robustness=robustness, path=str(path), **values
    )
    _check(found)
    return found


@dataclass(frozen=True)
class _Plain:
    """The fields of `Benchmark` that are no tables."""

    title: str = "Benchmark"
    published: bool = True
    rate_factor: float = 1.0
    ablation: tuple[str, ...] = ()
    compared: str = ""
    shown: int = 4
    width_factor: float = 1.0
    alexnet: str = ""
    heads: str = ""


def _methods(table: str, content: dict[str, Any], registry: Mapping[str, Any], shared: dict[str, Any]) -> list[Method]:
    """Of lines such as ``mwdn = {}`` and ``mwdn-average = { name = "mwdn", psf_pooling = "average" }``."""
    found = []
    for label, options in content.items():
        if not isinstance(options, dict):
            raise ParameterError(f"`{label}` of [{table}] ({options!r}) must be a table of options: `{label} = {{}}`.")
        name = options.get("name", label)
        if name not in registry:
            raise UnknownNameError(table.removesuffix("s"), name, registry)
        has = signature(registry[name]).parameters
        own = {key: value for key, value in options.items() if key != "name"}
        check_options(registry[name], f"'{name}'", own)
        common = {key: value for key, value in shared.items() if key in has}
        found.append(Method(label, name, {**common, **own}, table == "networks"))
    return found


def _narrowed(method: Method, factor: float) -> Method:
    """With its own width times a factor, where it has one and nobody said another."""
    if not factor > 0:
        raise ParameterError(f"`width_factor` ({factor}) must be positive.")
    width = signature(NETWORKS[method.name]).parameters.get("width") if method.learned else None
    if factor == 1 or width is None or "width" in method.options:
        return method
    return replace(method, options={**method.options, "width": max(1, round(factor * width.default))})


def _data_set(name: str, table: dict[str, Any], folder: Path) -> DataSet:
    preset = PRESETS.get(table.pop("preset", name), DataSet())
    changes: dict[str, Any] = {}
    nested = {f.name: getattr(preset, f.name) for f in fields(DataSet) if is_dataclass(f.default)}
    for key in nested.keys() & table.keys():
        given = fill(type(nested[key]), f"data.{name}.{key}", table[key])
        changes[key] = replace(nested[key], **{part: getattr(given, part) for part in table[key]})
    plain = fill(DataSet, f"data.{name}", {key: value for key, value in table.items() if key not in changes})
    changes |= {key: getattr(plain, key) for key in table if key not in changes}
    for key in ("psf", "photos", "test_photos", "pairs"):
        if key in changes:
            changes[key] = _place(changes[key], folder)
    if "captures" in changes:
        changes["captures"] = tuple(_place(capture, folder) for capture in changes["captures"])
    found = replace(preset, **changes)
    if found.pairs:  # photographs of [shared.data] are not for it
        found = replace(found, photos="", test_photos="")
    return found


def _place(text: str, folder: Path) -> str:
    expanded = os.path.expandvars(text)
    if expanded.startswith("$"):
        name = expanded[1:].partition("/")[0]
        raise ParameterError(f"The environment variable `{name}` of `{text}` is not set: `export {name}=/the/folder`.")
    return str((folder / expanded).resolve()) if text else ""  # the same from whatever folder it is read


def _robustness(table: dict[str, Any]) -> Robustness:
    sizes = {}
    for axis in table.keys() & AXES.keys():
        values = table[axis]
        if not (isinstance(values, list) and values and all(isinstance(v, int | float) for v in values)):
            raise ParameterError(f"`{axis}` of [robustness] ({json.dumps(values)}) must be a list of numbers.")
        sizes[axis] = tuple(sorted(float(value) for value in {AXES[axis], *values}))
    rest = {key: value for key, value in table.items() if key not in sizes}
    for key in rest:
        if key not in ("data", "count"):
            raise UnknownNameError("key of [robustness]", key, ["data", "count", *AXES])
    ordered = {axis: sizes[axis] for axis in AXES if axis in sizes}
    return replace(fill(Robustness, "robustness", rest), sizes=ordered)


def _check(found: Benchmark) -> None:
    labels = [method.label for method in found.methods]
    if not labels or not found.data:
        raise ParameterError(
            "A benchmark needs methods and data: `[networks]`, `mwdn = {}`; `[data]`, `mwdn-sim = {...}`."
        )
    for label in labels:
        if labels.count(label) > 1:
            raise ParameterError(
                f"`{label}` stands in [networks] and in [solvers]. Call one otherwise: "
                f'`{label}-solver = {{ name = "{label}" }}`.'
            )
    for label in (*found.ablation, *([found.compared] if found.compared else [])):
        if label not in labels:
            raise UnknownNameError("method of this recipe", label, labels)
    if found.schedule.epochs:
        raise ParameterError("A benchmark counts in steps, the same for all data sets: `steps` of [schedule].")
    if not found.rate_factor > 0:
        raise ParameterError(f"`rate_factor` ({found.rate_factor}) must be positive.")
    for name, data in found.data.items():
        _check_data(name, data, found.data)
    swept = found.robustness.data
    if swept and (swept not in found.data or found.data[swept].pairs):
        simulated = [name for name, data in found.data.items() if not data.pairs]
        raise UnknownNameError("simulated data set of this recipe", swept, simulated)


def _check_data(name: str, data: DataSet, known: dict[str, DataSet]) -> None:
    if not data.psf:
        raise ParameterError(f'`{name}` of [data] must name a PSF: `psf = "psf.png"`.')
    if not data.pairs and not (data.photos and data.test_photos):
        raise ParameterError(f"`{name}` of [data] must name `photos` and `test_photos`, or recorded `pairs`.")
    if data.trained_on and data.trained_on not in known:
        raise UnknownNameError("data set of this recipe", data.trained_on, known)
    if data.pairs and not (data.trained_on or data.split):
        raise ParameterError(
            f"`{name}` of [data] must say which pairs are for what, `split`, or be `trained_on` another."
        )
    if min(data.bin, data.validation) < 1 or min(data.train, data.test) < 0 or not (data.pairs or data.test):
        raise ParameterError(f"`bin`, `validation` and `test` of [data.{name}] must be at least 1, `train` at least 0.")

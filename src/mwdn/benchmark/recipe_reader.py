"""Read and check the recipe of a benchmark."""

import os
from collections.abc import Iterable
from dataclasses import fields, is_dataclass, replace
from itertools import permutations
from pathlib import Path
from typing import Any

from mwdn.benchmark.dataset_recipe import PRESETS, DatasetRecipe
from mwdn.benchmark.methods import MEAN, Method, check_name, read_methods, scale_width
from mwdn.benchmark.recipe import SWEPT, Benchmark, Robustness
from mwdn.calibration.camera_file import read_camera
from mwdn.errors import ParameterError, UnknownNameError, shown
from mwdn.io.listing import lies_in
from mwdn.io.toml import check_numbers, check_table, current_names, find_recipe, read_toml, to_dataclass
from mwdn.networks import NETWORKS
from mwdn.optics import Deviation
from mwdn.solvers import SOLVERS
from mwdn.training.losses import checked_weights
from mwdn.training.recipe import Recipe, Schedule
from mwdn.training.tables import Plateau
from mwdn.weights.bundled import BUNDLED


def _no_options() -> None:
    """The options of a bundled network."""


UNTRAINED: dict[str, Any] = {**SOLVERS, **dict.fromkeys(BUNDLED, _no_options)}
"""Methods of [solvers], which are not trained here, each with a function or class that takes its options."""


_TABLES = frozenset(
    {"networks", "solvers", "shared", "data", "schedule", "loss", "plateau", "later_loss", "robustness"}
)
"""Tables of a recipe."""


def read_benchmark(path: str | Path) -> Benchmark:
    """Read a recipe.

    Args:
        path: name of a recipe of the package, or TOML file with the tables [networks], [solvers], [data], [schedule],
            [loss], [shared.network], [shared.data], [robustness], and the other fields of `Benchmark`. Paths in it are
            relative to its folder or start with an environment variable, as in ``$MWDN_DATA/photos``.

    Raises:
        ParameterError: the file cannot be read, has no methods or data, or a value is outside its range.
        UnknownNameError: an unknown name, table or key.
    """
    path = find_recipe(path)
    content = read_toml(path)
    keys = {f.name for f in fields(Benchmark)} - {"methods", "path"} | {"networks", "solvers", "shared"}
    for key in content:
        if key not in keys:
            raise UnknownNameError("key of a benchmark's recipe", key, keys)
        if key in _TABLES:
            check_table(content[key], key)
    folder, shared = Path(path).parent, content.pop("shared", {})
    for key, table in shared.items():
        if key not in ("network", "data"):
            raise UnknownNameError("table of [shared]", key, ["network", "data"])
        check_table(table, f"shared.{key}")
    networks = read_methods("networks", content.pop("networks", {}), NETWORKS, shared.get("network", {}))
    methods = [*read_methods("solvers", content.pop("solvers", {}), UNTRAINED, {}), *networks]
    tables: dict[str, Any] = {
        "data": {
            name: _dataset_recipe(name, {**shared.get("data", {}), **check_table(table, f"data.{name}")}, folder)
            for name, table in content.pop("data", {}).items()
        },
        "schedule": to_dataclass(Schedule, "schedule", content.pop("schedule", {})),
        "loss": checked_weights(content.pop("loss", {"mse": 1.0})),
        "rates": _rates(content.pop("rates", [])),
        "plateau": to_dataclass(Plateau, "plateau", content.pop("plateau", {})),
        "later_loss": checked_weights(content.pop("later_loss")) if "later_loss" in content else {},
        "robustness": _robustness(content.pop("robustness", {})),
    }
    benchmark = to_dataclass(Benchmark, "the recipe", content)
    tables |= {name: _absolute(getattr(benchmark, name), folder) for name in ("alexnet", "heads")}
    methods = [scale_width(method, benchmark.width_factor) for method in methods]
    methods = [Method(MEAN, MEAN, {}, learned=False), *methods] if benchmark.mean_picture else methods
    benchmark = replace(benchmark, **tables, methods=tuple(methods), path=str(path))
    _check(benchmark)
    return benchmark


def _dataset_recipe(name: str, table: dict[str, Any], folder: Path) -> DatasetRecipe:
    """A preset with the changes of a camera file and of a table; its nested tables change single fields, too."""
    if table.get("preset", name) not in [*PRESETS, name]:
        raise UnknownNameError(f"`preset` of [data] {name}", str(table["preset"]), PRESETS)
    preset = PRESETS.get(table.pop("preset", name), DatasetRecipe())
    nested = {f.name: getattr(preset, f.name) for f in fields(DatasetRecipe) if is_dataclass(f.default)}
    changes: dict[str, Any] = {}
    for key in nested.keys() & table.keys():
        content = check_table(table[key], f"data.{name}.{key}")
        given = current_names(type(nested[key]), f"data.{name}.{key}", content)
        filled = to_dataclass(type(nested[key]), f"data.{name}.{key}", given)
        changes[key] = replace(nested[key], **{part: getattr(filled, part) for part in given})
    plain = to_dataclass(
        DatasetRecipe, f"data.{name}", {key: value for key, value in table.items() if key not in changes}
    )
    changes |= {key: getattr(plain, key) for key in table if key not in changes}
    for key in ("camera", "psf", "photos", "test_photos", "pairs"):
        if key in changes:
            changes[key] = _absolute(changes[key], folder)
    if "captures" in changes:
        changes["captures"] = tuple(_absolute(capture, folder) for capture in changes["captures"])
    if changes.get("camera"):
        changes = {**_of_camera(changes["camera"]), **changes}
    recipe = replace(preset, **changes)
    if recipe.pairs:  # the photographs of [shared.data] are for simulated data sets only
        recipe = replace(recipe, photos="", test_photos="")
    return recipe


def _of_camera(path: str) -> dict[str, Any]:
    """The keys of a data set that are in a camera file; its other keys are read with the PSF."""
    camera = read_camera(path)
    background = camera.get("background", "estimate")
    keys = {"psf": str(camera["psf"]), "psf_bin": 0, "background": -1.0 if background == "estimate" else background}
    return keys | {key: camera[key] for key in ("bin", "bgr", "upside_down") if key in camera}


def _absolute(text: str, folder: Path) -> str:
    """Absolute form of a recipe's path, so that it does not depend on the current folder; empty stays empty."""
    expanded = os.path.expandvars(text)
    if expanded.startswith("$"):
        name = expanded[1:].partition("/")[0]
        raise ParameterError(f"The environment variable `{name}` of `{text}` is not set: `export {name}=/the/folder`.")
    return str((folder / expanded).resolve()) if text else ""


def _robustness(table: dict[str, Any]) -> Robustness:
    table = current_names(Deviation, "robustness", table)
    sizes = {}
    for axis in table.keys() & SWEPT.keys():
        values = table[axis]
        if not (isinstance(values, list) and values and all(type(value) in (int, float) for value in values)):
            raise ParameterError(f"`{axis}` of [robustness] ({shown(values)}) must be a list of numbers.")
        check_numbers(values, axis)
        sizes[axis] = tuple(sorted(float(value) for value in {SWEPT[axis], *values}))
    others = {key: value for key, value in table.items() if key not in sizes}
    for key in others:
        if key not in ("data", "count"):
            raise UnknownNameError("key of [robustness]", key, ["data", "count", *SWEPT])
    ordered = {axis: sizes[axis] for axis in SWEPT if axis in sizes}
    return replace(to_dataclass(Robustness, "robustness", others), sizes=ordered)


def _rates(rates: object) -> tuple[float, ...]:
    if not (isinstance(rates, list) and all(isinstance(rate, int | float) and 0 < rate < 1 for rate in rates)):
        raise ParameterError(f"`rates` ({shown(rates)}) must be a list of learning rates between 0 and 1.")
    return tuple(map(float, rates))


def _check(benchmark: Benchmark) -> None:
    labels = [method.label for method in benchmark.methods]
    if not labels or not benchmark.data:
        raise ParameterError(
            "A benchmark needs methods and data: `[networks]`, `mwdn = {}`; `[data]`, `mwdn-sim = {...}`."
        )
    for name in (*labels, *benchmark.data):
        check_name(name)
    for label in labels:
        if labels.count(label) > 1:
            raise ParameterError(
                f"`{label}` must not be in [networks] and in [solvers]. Use another label for one of them: "
                f'`{label}-solver = {{ name = "{label}" }}`.'
            )
    for label in (*benchmark.ablation, *([benchmark.compared] if benchmark.compared else [])):
        if label not in labels:
            raise UnknownNameError("method of this recipe", label, labels)
    _check_training(benchmark)
    for name, recipe in benchmark.data.items():
        _check_dataset(name, recipe, benchmark.data)
    simulated = [name for name, recipe in benchmark.data.items() if not recipe.pairs]
    if benchmark.robustness.sizes and not benchmark.robustness.data:
        raise ParameterError(
            f"[robustness] ({', '.join(benchmark.robustness.sizes)}) must name the simulated data set to test: "
            f'`data = "{(simulated or ["mwdn-sim"])[0]}"`.'
        )
    if benchmark.robustness.data not in ("", *simulated):
        raise UnknownNameError("simulated data set of this recipe", benchmark.robustness.data, simulated)


def _check_training(benchmark: Benchmark) -> None:
    # Raises the errors of the schedule, the plateau and the losses.
    Recipe({}, benchmark.schedule, benchmark.loss, benchmark.plateau, benchmark.later_loss)
    endless = [name for name, recipe in benchmark.data.items() if not recipe.pairs and not recipe.train]
    if benchmark.schedule.epochs and endless:
        raise ParameterError(
            f"`epochs` of [schedule] needs a number of training pairs, but those of `{endless[0]}` are without end "
            "(`train` is 0). Give `train` or `steps`."
        )
    without = endless + [name for name, recipe in benchmark.data.items() if recipe.trained_on]
    if benchmark.mean_picture and without:
        raise ParameterError(
            f"`mean_picture` needs a number of training pairs in each data set, but `{without[0]}` has none of "
            "its own. Give it `train` in place of 0 or `trained_on`, or leave `mean_picture` out."
        )
    if not 0 < benchmark.trial <= 1:
        raise ParameterError(f"`trial` ({benchmark.trial}) must be a part of the steps, such as 0.1.")
    if not benchmark.rate_factor > 0:
        raise ParameterError(f"`rate_factor` ({benchmark.rate_factor}) must be positive.")


def _check_dataset(name: str, recipe: DatasetRecipe, names: Iterable[str]) -> None:
    if not recipe.psf:
        raise ParameterError(f'`{name}` of [data] must name a PSF, `psf = "psf.png"`, or `camera = "camera.toml"`.')
    if not recipe.pairs and not (recipe.photos and recipe.test_photos):
        raise ParameterError(f"`{name}` of [data] must name `photos` and `test_photos`, or recorded `pairs`.")
    if recipe.photos and any(lies_in(*pair) for pair in permutations((recipe.photos, recipe.test_photos))):
        raise ParameterError(
            f"`photos` ({recipe.photos}) and `test_photos` ({recipe.test_photos}) of [data.{name}] must be two folders "
            "that share no photograph, and neither may lie in the other: the test must be new to the networks."
        )
    if recipe.trained_on and recipe.trained_on not in names:
        raise UnknownNameError("data set of this recipe", recipe.trained_on, names)
    if recipe.pairs and not (recipe.trained_on or recipe.split):
        raise ParameterError(
            f"`{name}` of [data] must divide its pairs by `split`, or be `trained_on` another data set."
        )
    smallest = 0 if recipe.pairs else 1
    if min(recipe.bin, recipe.validation) < 1 or recipe.train < 0 or recipe.test < smallest:
        raise ParameterError(
            f"`bin` ({recipe.bin}), `validation` ({recipe.validation}) and `test` ({recipe.test}) of [data.{name}] "
            f"must be at least 1, `train` ({recipe.train}) at least 0."
        )

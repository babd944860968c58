"""Training recipes: one experiment per TOML file, read into frozen dataclasses."""

import dataclasses
import math
from dataclasses import dataclass, field, is_dataclass
from pathlib import Path
from typing import Any, ClassVar

from mwdn.arguments import check_not_negative, checked
from mwdn.data.cameras import Cameras
from mwdn.data.mismatch import REAL_OPTIONS, Mismatch
from mwdn.data.noisy import Denoising
from mwdn.data.recorded import Division
from mwdn.data.simulated import Placement
from mwdn.data.unpaired import SelfSupervised
from mwdn.errors import ParameterError, UnknownNameError
from mwdn.io.toml import check_table, current_names, find_recipe, named_table, read_toml, to_dataclass
from mwdn.networks import DENOISERS
from mwdn.networks.empty import build_empty
from mwdn.optics.sensor import Sensor
from mwdn.training.losses import checked_weights
from mwdn.training.tables import Plateau, Sheet

LR_SCHEDULES = ("cosine", "constant", "plateau")
BEST_BY = ("psnr", "loss")
OPTIMISERS = ("adam", "adamw")
LATER = {
    "mismatch": REAL_OPTIONS,
    "pairs": ("folds", "fold", "aligned", "best_gain"),
    "schedule": ("anchor", "start_share", "filter_rate", "best_by"),
}
"""Keys of tables that the first recipes did not have."""


@checked
@dataclass(frozen=True)
class Schedule:
    """The [schedule] of a recipe: length, batch, optimiser and learning rate.

    Args:
        steps: largest number of optimiser steps.
        epochs: passes over the training pairs, or over as many samples as there are training photographs. If positive,
            it sets `steps` and `validate_every`: one validation after each epoch.
        batch: samples per step, over all processes together.
        lr_schedule: "cosine", "constant", or the paper's "plateau", see `Plateau`.
        learning_rate: highest learning rate, reached after the warm-up; "cosine" then lowers it to 1 % in half a
            period.
        warmup: steps of linear rise; not for "plateau".
        optimiser: "adamw", or the paper's "adam"; see `mwdn.training.schedule.make_optimiser`.
        weight_decay: of the optimiser.
        clip: largest norm of the gradient over all parameters; longer gradients are scaled down, 0 disables this.
        ema: decay per step of the exponential moving average of the weights, which is what checkpoints hold; 0 for the
            latest weights.
        bfloat16: compute convolutions in bfloat16 where the hardware supports it.
        checkpointing: activation checkpointing: keep only the input of each scale of the U-Nets and compute the rest
            again for the gradient. Less memory, more time, the same result; for large frames.
        validate_every: steps between validations, checkpoints and contact sheets.
        validation: samples of a validation.
        seed: of the initial weights and the data.
        pool: number of samples to cache together with what the network computes of them before its learned part; they
            are reused, mirrored and turned. 0 makes every sample new. Only for `wiener-bank`.
        crop: side of the random square of a cached sample to train on; 0 for the whole sample.
        start: weights to start from: a bundled network such as "universal", or the path of a checkpoint of the same
            network.
        denoiser: path of a checkpoint of the network's denoiser, which is trained on its own; see `mwdn.data.noisy`.
        fixed_norms: keep the BatchNorm statistics of `start`, for samples that are too few or too similar to estimate
            them from.
        anchor: decay towards the weights of `start`, times the learning rate. The start is validated, too, and kept as
            the best if no step improves on it.
        start_share: share of the weights of `start` in those that are validated and saved; the rest is the moving
            average of what was learned. It forgets less of `start` (Wortsman et al., "Robust fine-tuning of zero-shot
            models", CVPR 2022).
        filter_rate: learning rate of the logarithms of the filters' w and lambda over that of the other parameters. At
            1 they hardly move: Adam changes a number by about the learning rate a step, and 4 may be needed.
        best_by: which validation has the best weights: that of the highest "psnr", or of the lowest "loss" (with the
            weights of [loss]), as in the authors' code.
    """

    steps: int = 2000
    epochs: int = 0
    batch: int = 4
    lr_schedule: str = "cosine"
    learning_rate: float = 1e-3
    warmup: int = 50
    optimiser: str = "adamw"
    weight_decay: float = 1e-4
    clip: float = 1.0
    ema: float = 0.99
    bfloat16: bool = True
    checkpointing: bool = False
    validate_every: int = 250
    validation: int = 16
    seed: int = 0
    pool: int = 0
    crop: int = 0
    start: str = ""
    denoiser: str = ""
    fixed_norms: bool = False
    anchor: float = 0.0
    start_share: float = 0.0
    filter_rate: float = 1.0
    best_by: str = "psnr"

    RENAMED: ClassVar[dict[str, str]] = {"course": "lr_schedule"}
    """Former names of keys, which recipes, command lines and saved runs may still use."""

    def __post_init__(self) -> None:
        for name in ("steps", "batch", "learning_rate", "validate_every", "validation", "filter_rate"):
            if not getattr(self, name) > 0:
                raise ParameterError(f"`{name}` ({getattr(self, name)}) must be positive.")
        check_not_negative(epochs=self.epochs, warmup=self.warmup, weight_decay=self.weight_decay)
        check_not_negative(clip=self.clip, pool=self.pool, crop=self.crop, anchor=self.anchor)
        if not abs(self.seed) < 2**63:
            raise ParameterError(f"`seed` ({self.seed}) must have 63 bits at most.")
        if self.learning_rate == math.inf:
            raise ParameterError("`learning_rate` (inf) must be finite.")
        if self.crop and not self.pool:
            raise ParameterError(f"`crop` ({self.crop}) applies to cached samples: set `pool`, or `crop = 0`.")
        for name in ("anchor", "start_share"):
            if getattr(self, name) and not self.start:
                raise ParameterError(
                    f"`{name}` ({getattr(self, name)}) needs the weights of `start`, which is missing."
                )
        for name in ("ema", "start_share"):
            if not 0 <= getattr(self, name) < 1:
                raise ParameterError(f"`{name}` ({getattr(self, name)}) must be in [0, 1).")
        for kind, names in (("lr_schedule", LR_SCHEDULES), ("optimiser", OPTIMISERS), ("best_by", BEST_BY)):
            if getattr(self, kind) not in names:
                raise UnknownNameError(kind, getattr(self, kind), names)


@checked
@dataclass(frozen=True)
class Recipe:
    """One experiment.

    Args:
        network: its ``name``, and its options by name; may be empty only where nothing is trained.
        schedule: see `Schedule`.
        loss: weights of its parts, see `mwdn.training.losses.Loss`.
        plateau: see `Plateau`; only with ``lr_schedule = "plateau"``.
        later_loss: weights that replace those of ``loss`` in the second phase of that schedule; empty to keep them.
        pairs: split of recorded pairs, see `mwdn.data.recorded.Division`.
        sheet: see `Sheet`.
        selfsupervised: learn from captures without scenes, see `mwdn.data.unpaired.SelfSupervised`.
        cameras: learn from random cameras instead of the calibrated one, see `mwdn.data.cameras.Cameras`.
        denoising: learn to denoise scenes, see `mwdn.data.noisy.Denoising`; only for `mwdn.networks.DENOISERS`.
        placement: see `mwdn.data.simulated.Placement`.
        mismatch: see `mwdn.data.mismatch.Mismatch`.
        sensor: see `mwdn.optics.sensor.Sensor`.
    """

    network: dict[str, Any] = field(default_factory=dict)
    schedule: Schedule = Schedule()
    loss: dict[str, float] = field(default_factory=lambda: {"mse": 1.0})
    plateau: Plateau = Plateau()
    later_loss: dict[str, float] = field(default_factory=dict)
    pairs: Division = Division()
    sheet: Sheet = Sheet()
    selfsupervised: SelfSupervised = SelfSupervised()
    cameras: Cameras = Cameras()
    denoising: Denoising = Denoising()
    placement: Placement = Placement()
    mismatch: Mismatch = Mismatch()
    sensor: Sensor = Sensor()

    def __post_init__(self) -> None:
        self._check_schedule()
        self._check_task()

    def _check_schedule(self) -> None:
        for name, is_given in (("plateau", self.plateau != Plateau()), ("later_loss", self.later_loss != {})):
            if is_given and self.schedule.lr_schedule != "plateau":
                raise ParameterError(
                    f"[{name}] needs `lr_schedule` ({self.schedule.lr_schedule}) to be plateau. "
                    f'Set `lr_schedule = "plateau"` in [schedule], or leave [{name}] out.'
                )
        if self.schedule.lr_schedule == "plateau" and self.schedule.learning_rate < self.plateau.stop:
            raise ParameterError(
                f"`learning_rate` ({self.schedule.learning_rate:g}) must be at least `stop` ({self.plateau.stop:g}) of "
                "[plateau], below which the training ends."
            )
        if self.later_loss and self.later_loss.keys() != self.loss.keys():
            raise ParameterError(
                f"[later_loss] ({', '.join(self.later_loss)}) must have the parts of [loss] ({', '.join(self.loss)}). "
                "Give a part that must not count the weight 0."
            )

    def _check_task(self) -> None:
        if self.schedule.pool and not self.schedule.crop and len(set(self.cameras.sizes)) > 1:
            raise ParameterError(
                "Cached samples of several sizes, [cameras], cannot form a batch. Set `crop` of [schedule] to the "
                "shortest side."
            )
        if self.selfsupervised.consistency and (self.schedule.pool or self.cameras.sizes):
            raise ParameterError(
                "[selfsupervised] learns from one camera's captures and cannot cache samples: "
                "leave `pool` of [schedule] and [cameras] out."
            )
        is_denoiser = self.network.get("name") in DENOISERS
        if is_denoiser != (self.denoising != Denoising()):
            raise ParameterError(
                f"[denoising] and a denoising network ({', '.join(DENOISERS)}) require each other; the other networks "
                "reconstruct."
            )
        if is_denoiser and (self.sheet.captures or self.cameras.sizes or self.selfsupervised.consistency):
            raise ParameterError("[denoising] has no camera: leave [sheet], [cameras] and [selfsupervised] out.")

    def as_dict(self) -> dict[str, Any]:
        """Plain values that JSON can hold.

        The options of `LATER` are left out at their defaults: runs begun before them have none.
        """
        tables = dataclasses.asdict(self)
        for table, names in LATER.items():
            off = dataclasses.asdict(FIELDS[table].default)  # type: ignore[arg-type]
            tables[table] = {k: v for k, v in tables[table].items() if k not in names or v != off[k]}
        return tables


FIELDS = {f.name: f for f in dataclasses.fields(Recipe)}
TABLES: dict[str, Any] = {name: type(f.default) for name, f in FIELDS.items() if is_dataclass(f.default)}
"""Dataclasses of a recipe's tables; [network], [loss] and [later_loss] have free keys instead."""


def read_recipe(path: str | Path | None, **changes: Any) -> Recipe:  # noqa: ANN401
    """Read a recipe.

    Args:
        path: TOML file with the tables of `Recipe`, or the name of a recipe of the package; ``None`` for all defaults,
            where nothing is trained. Another ``name`` of [network] in ``changes`` drops the recipe's options of its own
            network.
        **changes: replace values of the recipe: ``learning_rate=1e-4`` of [schedule], ``mismatch={"blur_px": 0.5}`` of
            any other table; ``None`` changes nothing.

    Raises:
        ParameterError: the file cannot be read, names no network, or a value is out of range.
        UnknownNameError: no such table, key, network, or option of the network.
    """
    path = None if path is None else find_recipe(path)
    content = {} if path is None else read_toml(path)
    replaced = _by_table(changes)
    for table in content | replaced:
        if table not in FIELDS:
            raise UnknownNameError("table of a recipe", table, FIELDS)
        check_table(content.setdefault(table, {}), table)
        if table == "network" and replaced.get(table, {}).get("name") not in (None, content[table].get("name")):
            content[table] = {}  # the options are those of another network
        content[table] = _named(table, content[table]) | _named(table, replaced.get(table, {}))
    if path is not None:
        if not isinstance(content.get("network", {}).get("name"), str):
            raise ParameterError(f'`{path}` must name a network: [network] name = "mwdn".')
        _check_network(content["network"])
    for table in {"loss", "later_loss"} & content.keys():
        with named_table(table):
            content[table] = checked_weights(content[table])
    tables = {name: to_dataclass(TABLES[name], name, table) for name, table in content.items() if name in TABLES}
    recipe = Recipe(**(content | tables))
    folder = Path() if "captures" in replaced.get("sheet", {}) else Path(path or "").parent
    captures = tuple(str(folder / capture) for capture in recipe.sheet.captures)
    return dataclasses.replace(recipe, sheet=Sheet(captures))


def _named(table: str, values: dict[str, Any], *, warn: bool = True) -> dict[str, Any]:
    return current_names(TABLES[table], table, values, warn=warn) if table in TABLES else values


def with_current_names(saved: dict[str, Any]) -> dict[str, Any]:
    """`Recipe.as_dict` of a saved run with renamed keys under their new names."""
    return {table: _named(table, values, warn=False) for table, values in saved.items()}


def _by_table(changes: dict[str, Any]) -> dict[str, dict[str, Any]]:
    """Changes of a recipe as its tables: those outside a table belong to [schedule]."""
    tables: dict[str, dict[str, Any]] = {name: value for name, value in changes.items() if isinstance(value, dict)}
    loose = {name: value for name, value in changes.items() if name not in tables and value is not None}
    schedule = tables.get("schedule", {}) | loose
    if schedule.get("steps") and schedule.get("epochs"):
        raise ParameterError(
            f"`steps` ({schedule['steps']}) and `epochs` ({schedule['epochs']}) exclude each other. Leave one out."
        )
    if "steps" in schedule:  # replaces the recipe's length, in whichever unit it is given
        schedule["epochs"] = 0
    return tables | {"schedule": schedule}


def _check_network(network: dict[str, Any]) -> None:
    """Build the network without memory, to find a mistake before a thousand photographs are read."""
    with named_table("network"):
        channels = getattr(build_empty(**network), "channels", 3)
        if channels not in (0, 1, 3):  # 0: any, `wiener`
            raise ParameterError(f"`channels` ({channels}) must be 1 (grey) or 3 (RGB), as captures have.")

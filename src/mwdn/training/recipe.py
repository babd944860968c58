"""Recipes: one experiment a TOML file, read into frozen dataclasses."""

import dataclasses
import math
import warnings
from dataclasses import dataclass, field, is_dataclass
from pathlib import Path
from typing import Any

import torch

from mwdn.data.cameras import Cameras
from mwdn.data.mismatch import Mismatch
from mwdn.data.noisy import Denoising
from mwdn.data.recorded import Division
from mwdn.data.simulated import Placement
from mwdn.data.unpaired import SelfSupervised
from mwdn.errors import MwdnError, ParameterError, UnknownNameError
from mwdn.io.toml import fill, read_toml
from mwdn.networks import DENOISERS, build
from mwdn.optics.sensor import Sensor
from mwdn.training.losses import checked_weights

COURSES = ("cosine", "plateau")
OPTIMISERS = ("adam", "adamw")


@dataclass(frozen=True)
class Schedule:
    """How long and how fast to learn.

    Args:
        steps: optimiser steps, at most.
        epochs: passes over the training pairs, or as many samples as there are training photographs. If positive,
            `steps` and `validate_every` follow from it: a validation after each.
        batch: samples a step, over all processes together.
        course: of the learning rate: "cosine", or the paper's "plateau", see `Plateau`.
        learning_rate: at its highest, after the warm-up; the cosine then falls to 1 % of it in half a period.
        warmup: steps of linear rise, before the cosine alone.
        optimiser: "adamw", or the paper's "adam"; see `mwdn.training.schedule.optimiser`.
        weight_decay: of the optimiser.
        clip: longer gradients, over all parameters, are shortened to this norm; 0 leaves them as they are.
        ema: the checkpoint holds a running mean of the weights, with this decay a step; 0 for the last weights.
        bfloat16: compute convolutions in bfloat16 where the hardware has it.
        checkpointing: keep of each scale of the U-Nets what goes into it alone, and compute the rest again for the
            gradient: for large frames, less memory for more time. The result is the same.
        validate_every: steps between validations, checkpoints and contact sheets.
        validation: samples in a validation.
        seed: of initial weights and data.
        pool: keep so many samples and what the network computes of them before its learned part, and use them again,
            mirrored; 0 makes every sample a new one. For `wiener-bank`.
        crop: side of the square of a kept sample that is learned from at a time; 0 for all of it.
        start: weights to begin with instead: those that come with the package, "universal", or the path of a
            checkpoint; of the same network.
        denoiser: path of a checkpoint of the part of the network that is trained alone, see `mwdn.data.noisy`.
        fixed_norms: BatchNorm normalises by the statistics that `start` brings, and they stay: where the samples are
            too few or too much alike to tell what others will be.
    """

    steps: int = 2000
    epochs: int = 0
    batch: int = 4
    course: str = "cosine"
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

    def __post_init__(self) -> None:
        for name in ("steps", "batch", "learning_rate", "validate_every", "validation"):
            if not getattr(self, name) > 0:
                raise ParameterError(f"`{name}` ({getattr(self, name)}) must be positive.")
        for name in ("epochs", "warmup", "weight_decay", "clip", "pool", "crop"):
            if not getattr(self, name) >= 0:
                raise ParameterError(f"`{name}` ({getattr(self, name)}) must not be negative.")
        if not abs(self.seed) < 2**63:
            raise ParameterError(f"`seed` ({self.seed}) must have 63 bits at most.")
        if self.learning_rate == math.inf:
            raise ParameterError("`learning_rate` (inf) must be finite.")
        if self.crop and not self.pool:
            raise ParameterError(f"`crop` ({self.crop}) is of kept samples: set `pool`, or leave it out.")
        if not 0 <= self.ema < 1:
            raise ParameterError(f"`ema` ({self.ema}) must be in [0, 1).")
        for kind, name, known in (("course", self.course, COURSES), ("optimiser", self.optimiser, OPTIMISERS)):
            if name not in known:
                raise UnknownNameError(kind, name, known)


@dataclass(frozen=True)
class Plateau:
    """The paper's course of the learning rate: it falls when the validation loss does not. Defaults are the paper's.

    The loss that is watched has the weights of [loss] throughout.

    Args:
        factor: by which the learning rate is multiplied.
        patience: validations without a new lowest loss that are borne; the next such one lowers the learning rate.
        later: from this learning rate on, the loss has the weights of [later_loss].
        stop: below this learning rate the run ends.
    """

    factor: float = 0.1
    patience: int = 5
    later: float = 1e-6
    stop: float = 2e-8

    def __post_init__(self) -> None:
        if not 0 < self.factor < 1:
            raise ParameterError(f"`factor` ({self.factor}) must be in (0, 1): the learning rate falls.")
        for name in ("patience", "later", "stop"):
            if not getattr(self, name) >= 0:
                raise ParameterError(f"`{name}` ({getattr(self, name)}) must not be negative.")


@dataclass(frozen=True)
class Sheet:
    """What the contact sheet of a validation shows besides simulated or recorded pairs.

    Args:
        captures: files and folders of real captures, which have no scene to compare with; the first six are shown.
            Their paths begin at the recipe's folder. They change nothing of what is learned.
    """

    captures: tuple[str, ...] = ()


@dataclass(frozen=True)
class Recipe:
    """One experiment.

    Args:
        network: its name, and options under their own names; empty only where nothing is trained.
        schedule: see `Schedule`.
        loss: weights of its parts, see `mwdn.training.losses.Loss`.
        plateau: see `Plateau`; of that course only.
        later_loss: weights that replace those of ``loss`` at the end of that course; none to leave them.
        pairs: which of recorded pairs are for what, see `mwdn.data.recorded.Division`.
        sheet: see `Sheet`.
        selfsupervised: learn from captures alone, see `mwdn.data.unpaired.SelfSupervised`.
        cameras: random ones to learn from in place of the one that is given, see `mwdn.data.cameras.Cameras`.
        denoising: learn to denoise scenes, see `mwdn.data.noisy.Denoising`; of a network of `mwdn.networks.DENOISERS`.
        placement: see `mwdn.data.simulated.Placement`.
        mismatch: see `mwdn.data.simulated.Mismatch`.
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
        of_plateau = {"plateau": self.plateau != Plateau(), "later_loss": bool(self.later_loss)}
        if self.schedule.course != "plateau" and any(of_plateau.values()):
            name = next(name for name, given in of_plateau.items() if given)
            raise ParameterError(
                f"[{name}] belongs to another course than '{self.schedule.course}'. "
                'Leave it out, or set `course = "plateau"` in [schedule].'
            )
        if self.schedule.pool and not self.schedule.crop and len(set(self.cameras.sizes)) > 1:
            raise ParameterError(
                "Kept samples of several sizes, [cameras], make no batch. Set `crop` of [schedule] to the least side."
            )
        if self.selfsupervised.consistency and (self.schedule.pool or self.cameras.sizes):
            raise ParameterError(
                "[selfsupervised] learns from one camera's captures, none of which is ever the same: "
                "leave `pool` of [schedule] and [cameras] out."
            )
        learned_alone = self.network.get("name") in DENOISERS
        if learned_alone != (self.denoising != Denoising()):
            raise ParameterError(
                f"[denoising] and a network of {', '.join(DENOISERS)} go together: other networks reconstruct."
            )
        if learned_alone and (self.sheet.captures or self.cameras.sizes or self.selfsupervised.consistency):
            raise ParameterError("[denoising] has no camera: leave [sheet], [cameras] and [selfsupervised] out.")
        if self.later_loss and self.later_loss.keys() != self.loss.keys():
            raise ParameterError(
                f"[later_loss] ({', '.join(self.later_loss)}) must have the parts of [loss] ({', '.join(self.loss)}). "
                "Give a part that shall not count the weight 0."
            )

    def as_dict(self) -> dict[str, Any]:
        """Plain values that JSON can hold."""
        return dataclasses.asdict(self)


def read_recipe(path: str | Path | None, **changes: Any) -> Recipe:  # noqa: ANN401
    """Read a recipe.

    Args:
        path: TOML with the tables of `Recipe`; ``None`` for all defaults, where nothing is trained.
        **changes: values in place of the recipe's, ``learning_rate=1e-4`` of [schedule] and
            ``mismatch={"blur_px": 0.5}`` of any other table; ``None`` leaves one as it is.

    Raises:
        ParameterError: the file cannot be read, names no network, or a value is outside its range.
        UnknownNameError: a table, a key, a network or an option of it that does not exist.
    """
    content = {} if path is None else read_toml(path)
    replaced = _by_table(changes)
    fields = {f.name: f for f in dataclasses.fields(Recipe)}
    for table in content | replaced:
        if table not in fields:
            raise UnknownNameError("table of a recipe", table, fields)
        if not isinstance(content.setdefault(table, {}), dict):
            raise ParameterError(f"`{table}` of `{path}` ({content[table]!r}) must be a table: [{table}].")
        content[table] |= replaced.get(table, {})
    if path is not None:
        if not isinstance(content.get("network", {}).get("name"), str):
            raise ParameterError(f'`{path}` must name a network: [network] name = "mwdn".')
        _try(content["network"])
    for table in {"loss", "later_loss"} & content.keys():
        content[table] = checked_weights(content[table])
    kinds: dict[str, Any] = {name: type(f.default) for name, f in fields.items() if is_dataclass(f.default)}
    tables = {name: fill(kinds[name], name, table) for name, table in content.items() if name in kinds}
    recipe = Recipe(**(content | tables))
    captures = tuple(str(Path(path or "").parent / capture) for capture in recipe.sheet.captures)
    return dataclasses.replace(recipe, sheet=Sheet(captures))


def _by_table(changes: dict[str, Any]) -> dict[str, dict[str, Any]]:
    """Changes of a recipe as its tables: those that are in none are of [schedule]."""
    tables: dict[str, dict[str, Any]] = {name: value for name, value in changes.items() if isinstance(value, dict)}
    loose = {name: value for name, value in changes.items() if name not in tables and value is not None}
    schedule = tables.get("schedule", {}) | loose
    if "steps" in schedule:  # instead of the recipe's, in whatever unit it counts
        schedule["epochs"] = 0
    return tables | {"schedule": schedule}


def _try(network: dict[str, Any]) -> None:
    """Build it without memory: a mistake is found before a thousand photographs have been read."""
    try:
        with torch.device("meta"), warnings.catch_warnings(action="ignore"):  # of layers that are empty
            built = build(**network)
    except (TypeError, ValueError, RuntimeError) as error:
        if isinstance(error, MwdnError):
            raise
        raise ParameterError(f"[network] {network} cannot be built: {error}") from error
    empty = [name for name, parameter in built.named_parameters() if parameter.numel() == 0]
    if empty:
        raise ParameterError(f"[network] {network} has layers without channels, `{empty[0]}` first.")

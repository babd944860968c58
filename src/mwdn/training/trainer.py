"""The training loop: pairs in, checkpoint out."""

import json
import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from mwdn.calibration import Calibration
from mwdn.data.recorded import ReadAhead, RecordedPairs
from mwdn.data.simulated import Samples
from mwdn.data.unpaired import UnpairedCaptures
from mwdn.errors import CheckpointError, DivergenceError, MwdnError, ParameterError
from mwdn.io.files import as_parameter_error
from mwdn.io.images import write_picture
from mwdn.networks import build
from mwdn.networks.recomputed import norms, recompute
from mwdn.runtime import distributed
from mwdn.runtime.devices import has_bfloat16
from mwdn.training.batch_norm import freeze_cancelled, synchronise
from mwdn.training.losses import Loss
from mwdn.training.recipe import Recipe
from mwdn.training.run_folder import MAKE_ROOM, RunFolder
from mwdn.training.sample_cache import Pool
from mwdn.training.schedule import make_lr_schedule, make_optimiser
from mwdn.training.selfsupervised import BlindValidator, judge
from mwdn.training.training_state import damaged, restore, write_state
from mwdn.training.validation import Validation, Validator
from mwdn.types import Measurement
from mwdn.weights.bundled import find_weights
from mwdn.weights.checkpoint import first_difference, load_network, save_network


@dataclass(frozen=True)
class Report:
    """What a callback is told after a step."""

    step: int
    loss: float
    parts: dict[str, float]
    learning_rate: float
    pictures_per_s: float
    validation: Validation | None = None

    def line(self) -> dict[str, float | int | None]:
        """What the log says of the step."""
        line = {"step": self.step, "loss": self.loss, **self.parts, "learning_rate": self.learning_rate}
        psnr, loss = (None, None) if self.validation is None else (self.validation.psnr, self.validation.loss)
        return {**line, "psnr": psnr, "validation_loss": loss}


class Trainer:
    """One run in one folder. Made again on the same folder it goes on where the last one was stopped.

    In a group of processes, `mwdn.runtime.distributed`, each makes one and calls it alike; the first alone reads
    and writes the folder.

    Args:
        recipe: the experiment.
        calibration: of the camera to learn.
        pairs: what to learn from.
        out: folder of the run: ``best.safetensors``, ``last.safetensors``, ``state.safetensors``, ``log.jsonl``.
        validation: source of other pairs, for the validation; ``pairs`` unless given.
        captures: (B, C, H, W), real ones, to be shown on the contact sheets.
        device: where to compute.
        alexnet: file of AlexNet's weights, where the loss needs them.

    Raises:
        CheckpointError: the folder holds the state of another recipe, PSF or source of pairs, or a damaged one.
        ParameterError: the folder cannot be written to, the batch is smaller than the number of processes, or these
            were given different recipes or PSFs; found before training starts.
    """

    def __init__(  # noqa: PLR0913
        self,
        recipe: Recipe,
        calibration: Calibration,
        pairs: Samples,
        out: Path,
        *,
        validation: Samples | None = None,
        captures: Measurement | None = None,
        device: torch.device | str = "cpu",
        alexnet: Path | None = None,
    ) -> None:
        self.recipe, self.schedule, self.out = recipe, recipe.schedule, out
        self.device, self.pairs, self.calibration = torch.device(device), pairs, calibration
        self.psf = calibration.psf.to(self.device)
        real = None if captures is None else captures.to(self.device)
        kind = BlindValidator if isinstance(pairs, UnpairedCaptures) else Validator
        self.validator = kind(recipe, validation or pairs, self.psf, real)
        torch.manual_seed(self.schedule.seed)
        self.options = {key: value for key, value in recipe.network.items() if key != "name"}
        self.network = build(recipe.network["name"], **self.options).to(self.device)
        self._begin()
        self.network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        self.average = build(recipe.network["name"], **self.options).to(self.device).eval()
        self.average.load_state_dict(self.network.state_dict())
        freeze_cancelled(self.network)
        synchronise(self.network, self.device)
        if self.schedule.checkpointing:
            recompute(self.network)
        self.pool = self._pool() if self.schedule.pool else None
        self.ahead = ReadAhead(pairs, self.schedule.batch) if isinstance(pairs, RecordedPairs) else None
        self.loss = Loss(recipe.loss, alexnet=alexnet).to(self.device)
        self.optimiser = make_optimiser(self.network, self.schedule)
        self.lr_schedule = make_lr_schedule(recipe)
        self.bfloat16 = self.schedule.bfloat16 and has_bfloat16(self.device)
        self.step, self.best = 0, -math.inf
        # What a checkpoint must agree with to be gone on from.
        everything = recipe.as_dict()
        del everything["schedule"]["checkpointing"]  # changes nothing but memory and time
        without = {"sheet"} if recipe.selfsupervised.consistency else {"sheet", "selfsupervised"}
        learned = {name: values for name, values in everything.items() if name not in without}
        one = None if recipe.cameras.sizes else calibration.psf_hash  # of many, the given one is for the validation
        self.identity = {"recipe": learned, "psf_hash": one, "pairs": pairs.name}
        distributed.check_same(self.identity)
        distributed.shard(range(self.schedule.batch))  # refuses a batch that is too small
        self.folder = RunFolder(out, self.identity)
        self._resume()
        if distributed.rank() == 0:
            self.folder.claim(self.step)

    def run(self, callback: Callable[[Report], None] = lambda report: None) -> float:
        """Train to the end of the schedule; returns the best validation PSNR in dB.

        Args:
            callback: told of each step, on the first process.

        Raises:
            DivergenceError: as for `advance`.
            ParameterError: another run is at work in the folder, or the disk is full, or refuses otherwise; the last
                saved state stays as it was.
            ProcessError: another process has ended.
        """
        with self.folder.alone():
            self._run(callback)
        return self.best

    def _run(self, callback: Callable[[Report], None]) -> None:
        last = time.perf_counter()
        while self.step < self.schedule.steps and not self.lr_schedule.finished:
            rate = self.lr_schedule.rate(self.step)
            loss, parts = self.advance()
            now = time.perf_counter()
            speed, last = self.schedule.batch / (now - last), now
            due = self.step % self.schedule.validate_every == 0 or self.step == self.schedule.steps
            found = self.validate() if due else None
            report = Report(self.step, loss, parts, rate, speed, found)
            if distributed.rank() == 0:
                # Before the state: a run killed between the two repeats the step, and its line.
                self.folder.log(report.line())
            if found is not None:
                self.save(found)
                last = time.perf_counter()
            if distributed.rank() == 0:
                callback(report)

    def advance(self) -> tuple[float, dict[str, float]]:
        """One optimiser step; returns the loss and its parts, over the batches of all processes.

        Raises:
            DivergenceError: the loss is not finite; the last saved state stays as it was.
        """
        first = self.step * self.schedule.batch
        numbers = range(first, first + self.schedule.batch)
        own = distributed.shard(numbers)
        for group in self.optimiser.param_groups:
            group["lr"] = self.lr_schedule.rate(self.step)
        self.loss.weights = self.lr_schedule.loss_weights
        self.network.train()
        if self.schedule.fixed_norms:
            for norm in norms(self.network):
                norm.eval()
        try:
            with torch.autocast(self.device.type, torch.bfloat16, enabled=self.bfloat16):
                loss, parts = self._judge(own)
        except (RuntimeError, ValueError) as error:
            if self.step or isinstance(error, MwdnError):
                raise
            raise ParameterError(
                f"[network] {self.recipe.network} cannot learn from a batch of {len(own)} of these samples: "
                f"{str(error).splitlines()[0]}"
            ) from error
        weight = len(own) / len(numbers)  # losses are means over samples
        self.optimiser.zero_grad(set_to_none=True)
        torch.autograd.backward(weight * loss)  # before the loss is read, for which a GPU would have to wait
        total, *totals = distributed.all_reduce_sum(
            weight * torch.stack([loss.detach(), *parts.values()]).double()
        ).tolist()
        if not math.isfinite(total):
            raise self._diverged(f"step {self.step} ({self._names(numbers)})")
        distributed.all_reduce_gradients(self.network)
        if self.schedule.clip > 0:
            torch.nn.utils.clip_grad_norm_(self.network.parameters(), self.schedule.clip)
        self.optimiser.step()
        self.step += 1
        self._average()
        return total, dict(zip(parts, totals, strict=True))

    def _names(self, numbers: range) -> str:
        rows = [self.pairs.row(number) for number in numbers] if isinstance(self.pairs, RecordedPairs) else []
        return f"samples {numbers.start} to {numbers.stop - 1}" + (f", rows {rows} of the file" if rows else "")

    def _diverged(self, where: str) -> DivergenceError:
        last = self.folder.weights("last")
        kept = f' The weights of the last validation are kept: `start = "{last}"`.' if last.exists() else ""
        return DivergenceError(
            f"The loss of {where} is not finite. Lower the learning rate and choose another folder, `--out`.{kept}"
        )

    def _judge(self, numbers: range) -> tuple[Tensor, dict[str, Tensor]]:
        """Loss of the samples of these numbers, and its parts."""
        if isinstance(self.pairs, UnpairedCaptures):
            blind = judge(self.pairs, self.network, self.loss, numbers)
            return blind.loss, blind.parts
        found, scene = self._reconstruct(numbers)
        return self.loss(found.float(), scene)

    def _reconstruct(self, numbers: range) -> tuple[Tensor, Tensor]:
        """Reconstructions of the samples of these numbers, and their scenes."""
        if self.pool is not None:
            estimates, unit, scene = self.pool.batch(numbers)
            return self.network.correct(estimates, unit), scene  # type: ignore[operator]
        measurement, scene, psf = (self.ahead or self.pairs).batch(numbers)
        seen = measurement.contiguous(memory_format=torch.channels_last)
        return self.network(seen, self.psf if psf is None else psf), scene

    @torch.no_grad()
    def _average(self) -> None:
        # A young average would remember the initial weights: its decay grows from 0 to the schedule's.
        decay = min(self.schedule.ema, self.step / (self.step + 10))
        for mean, value in zip(self.average.state_dict().values(), self.network.state_dict().values(), strict=True):
            if value.is_floating_point():
                mean.lerp_(value, 1 - decay)
            else:
                mean.copy_(value)

    def validate(self) -> Validation:
        """Measure the averaged weights, write the contact sheet, and let the course see the loss.

        The first process does it, and all go on with its numbers.

        Raises:
            DivergenceError: the loss is not finite; the last saved state stays as it was.
        """
        found = Validation(math.nan, math.nan)
        if distributed.rank() == 0:
            found = self.validator(self.average, self.loss, f"step {self.step}")
        psnr, loss = distributed.broadcast_floats([found.psnr, found.loss])
        if not math.isfinite(loss):
            raise self._diverged(f"the validation after step {self.step}")
        if found.sheet is not None:
            write_picture(self.out / "validation.png", found.sheet)
        self.lr_schedule = self.lr_schedule.after(loss)
        return Validation(psnr, loss, found.sheet)

    def save(self, found: Validation) -> None:
        """Write last and, if it is, best weights, and the whole state, each atomically.

        Raises:
            ParameterError: the disk is full, or refuses otherwise; the last saved state stays as it was.
        """
        self.best = max(self.best, found.psnr)
        if distributed.rank() > 0:
            return
        metadata = {**self.identity, "step": self.step, "psnr": found.psnr}
        header = {"identity": json.dumps(self.identity), "step": str(self.step), "best": repr(self.best)}
        header["lr_schedule"] = json.dumps(self.lr_schedule.state())
        with as_parameter_error(self.out, MAKE_ROOM):
            for name in ("last", *(["best"] if found.psnr == self.best else [])):
                network = self.recipe.network["name"]
                save_network(self.folder.weights(name), self.average, network, self.options, **metadata)
            path = self.folder.state
            write_state(path, header, network=self.network, average=self.average, optimiser=self.optimiser)

    def _pool(self) -> Pool:
        s = self.schedule
        return Pool(self.pairs, self.network, self.psf, size=s.pool, batch=s.batch, crop=s.crop, seed=s.seed)

    def _begin(self) -> None:
        """Take the weights that the schedule names."""
        start, alone = self.schedule.start, self.schedule.denoiser
        known = (load_network(find_weights(start) or start) if start else self.network).state_dict()
        if alone:
            known |= {f"denoiser.{key}": value for key, value in load_network(alone).state_dict().items()}
        try:
            self.network.load_state_dict(known)
        except RuntimeError as error:
            raise CheckpointError(
                f"`start` ('{start}') must hold the network of the recipe, {self.recipe.network}, and `denoiser` "
                f"('{alone}') its denoiser, if it has one: {first_difference(error)}."
            ) from error

    def _resume(self) -> None:
        saved = self.folder.saved()
        if saved is None:
            return
        state, header = saved
        try:
            restore(state, network=self.network, average=self.average, optimiser=self.optimiser)
        except (KeyError, RuntimeError) as error:
            raise damaged(self.folder.state, "a part is missing") from error
        self.step, self.best = int(header["step"]), float(header["best"])
        saved_schedule = header.get("lr_schedule") or header["course"]  # the second is its former name
        self.lr_schedule = make_lr_schedule(self.recipe, **json.loads(saved_schedule))

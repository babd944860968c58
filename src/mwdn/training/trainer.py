"""The training loop: samples in, checkpoint out."""

import json
import math
import time
from collections.abc import Callable
from pathlib import Path

import torch
from torch import Tensor

from mwdn.calibration import Calibration
from mwdn.calibration.psf_identity import psf_identity
from mwdn.errors import DivergenceError, MwdnError, ParameterError
from mwdn.io.files import as_parameter_error
from mwdn.io.images import write_picture
from mwdn.networks import build
from mwdn.networks.activation_checkpointing import checkpoint_activations
from mwdn.runtime import distributed
from mwdn.runtime.interrupts import deferred_interrupt
from mwdn.training.batch_norm import freeze_cancelled, synchronise
from mwdn.training.gradient import Gradient
from mwdn.training.losses import Loss
from mwdn.training.network import MEASURED_BUFFERS, build_network, measure_scenes, update_average
from mwdn.training.recipe import Recipe
from mwdn.training.report import Report
from mwdn.training.run_folder import MAKE_ROOM, RunFolder, run_identity
from mwdn.training.sample_cache import Progress
from mwdn.training.schedule import make_lr_schedule, make_optimiser, set_rate
from mwdn.training.tasks import Task
from mwdn.training.training_state import damaged, restore, write_state
from mwdn.training.validation import Validation, Validator
from mwdn.weights.checkpoint import save_network


class Trainer:
    """One run in one folder. A new trainer on the same folder resumes the run from its last saved state.

    In a group of processes (`mwdn.runtime.distributed`) each makes a trainer and calls it alike; only the first reads
    and writes the folder.

    Args:
        recipe: the experiment.
        task: what to learn, and from which samples.
        out: folder of the run: ``best.safetensors``, ``last.safetensors``, ``state.safetensors``, ``log.jsonl``.
        calibration: of the camera.
        validator: validates on the samples of ``task`` by default.
        device: where to compute; the task's samples must be there.
        alexnet: file of AlexNet's weights, if the loss needs them.

    Raises:
        CheckpointError: the folder holds the state of another recipe, PSF or source of samples, or a damaged one.
        ParameterError: the folder cannot be written to, the batch is smaller than the number of processes, or the
            processes have different recipes or PSFs.
    """

    def __init__(
        self,
        recipe: Recipe,
        task: Task,
        *,
        out: Path,
        calibration: Calibration,
        validator: Validator | None = None,
        device: torch.device | str = "cpu",
        alexnet: Path | None = None,
    ) -> None:
        self.recipe, self.schedule, self.task, self.out = recipe, recipe.schedule, task, out
        self.device = torch.device(device)
        self.validator = validator or Validator(recipe, task, calibration.psf.to(self.device))

        # 1. Build the network, the average of its weights, the loss and the optimiser.
        self.network = build_network(recipe).to(self.device).to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        self.average = build(**recipe.network).to(self.device).eval()
        self.average.load_state_dict(self.network.state_dict())
        task.check(self.average)
        freeze_cancelled(self.network)
        synchronise(self.network, self.device)
        if self.schedule.checkpointing:
            checkpoint_activations(self.network)
        self.distance = Loss(recipe.loss, alexnet=alexnet).to(self.device)
        self.optimiser = make_optimiser(self.network, self.schedule)
        self.lr_schedule = make_lr_schedule(recipe)
        # Copied before a saved run resumes: these are the weights of `start`.
        needs_start = self.schedule.anchor > 0 or self.schedule.start_share > 0
        weights = self.network.state_dict().items() if needs_start else ()
        self.start = {name: value.clone() for name, value in weights if name not in MEASURED_BUFFERS}
        self.gradient = Gradient(self.network, task, self.distance, self.schedule, self.device)
        self.step, self.best, self.fingerprint = 0, -math.inf, ""

        # 2. Resume a run that was stopped.
        self.identity = run_identity(recipe, calibration.psf_hash, task.samples.name)
        self.psf_identity = psf_identity(calibration) if self.identity["psf_hash"] else {}
        distributed.check_same(self.identity)
        distributed.shard(range(self.schedule.batch))  # raises if the batch is too small
        self.folder = RunFolder(out, self.identity)
        self._resume()

        # 3. Claim the folder, unless a capture does not fit the network.
        self.validator.reconstruct_captures(self.average)
        if distributed.rank() == 0:
            self.folder.claim(self.step)

    def compare_samples(self) -> bool:
        """Whether a resumed run had the same samples. Their hash, which takes time, is also kept for saved states."""
        saved, self.fingerprint = self.fingerprint, self.task.samples.fingerprint
        return saved in ("", self.fingerprint)

    @property
    def finished(self) -> bool:
        """Whether the schedule has come to its end."""
        return self.step >= self.schedule.steps or self.lr_schedule.finished

    def run(
        self, callback: Callable[[Report], None] = lambda report: None, *, samples: Progress = lambda done, total: None
    ) -> float:
        """Compute the cached samples, if the task has some, then train to the end of the schedule.

        Ctrl-C ends the run with a saved state: after the sample in progress, or after the step in progress.

        Args:
            callback: called after each step, on the first process.
            samples: called after each cached sample, with those of this process that are done and their total.

        Returns:
            The best validation: its PSNR in dB, or minus its loss, see `best_by` of [schedule].

        Raises:
            KeyboardInterrupt: Ctrl-C; its message says how to go on.
            DivergenceError: as for `advance`.
            ParameterError: another run is using the folder, or it cannot be written to (a full disk, for example); the
                last saved state stays as it was.
            ProcessError: another process has ended.
        """
        with self.folder.lock():
            try:
                self._fill_cache(samples)
                if self.step == 0:
                    measure_scenes(self.task.cache, self.network, self.average)
                    if self.schedule.anchor:
                        self.save(self.validate())
                self._train(callback)
            except DivergenceError:
                self.folder.remove_samples()
                raise
            self.folder.remove_samples()
        return self.best

    def _fill_cache(self, progress: Progress) -> None:
        """Compute this process's cached samples that the rest of the run needs."""
        cache, batch = self.task.cache, self.schedule.batch
        if cache is None or self.step >= self.schedule.steps:
            return
        # Twice the size of the cache contains a whole epoch.
        steps = range(self.step, self.schedule.steps)[: 2 * cache.size // batch]
        files = self.folder.samples(cache.pairs.content)
        if distributed.rank() == 0:
            files.remove_others()
        numbers = (n for step in steps for n in distributed.shard(range(step * batch, (step + 1) * batch)))
        cache.fill(self.network.train(), numbers, files, progress)

    def _train(self, callback: Callable[[Report], None]) -> None:
        with deferred_interrupt() as interrupted:
            while not self.finished:
                self._step(callback)
                if distributed.all_reduce_sum(torch.tensor(int(interrupted()))):
                    self._save_state()
                    raise KeyboardInterrupt(f"Interrupted after step {self.step:,}. The same command resumes.")

    def _step(self, callback: Callable[[Report], None]) -> None:
        """One step with its line in the log, and the validation and saved state that are due after it."""
        start, learning_rate = time.perf_counter(), self.lr_schedule.rate(self.step)
        loss, parts = self.advance()
        speed = self.schedule.batch / (time.perf_counter() - start)
        due = self.step % self.schedule.validate_every == 0 or self.step == self.schedule.steps
        validation = self.validate() if due else None
        report = Report(self.step, loss, parts, learning_rate, speed, validation)
        if distributed.rank() == 0:
            # Before the state is saved: a run killed in between repeats the step and its line.
            self.folder.log(report.line())
        if validation is not None:
            self.save(validation)
        if distributed.rank() == 0:
            callback(report)

    def advance(self) -> tuple[float, dict[str, float]]:
        """One optimiser step; returns the loss and its parts, over the batches of all processes.

        Raises:
            DivergenceError: the loss is not finite; the last saved state stays as it was.
        """
        first = self.step * self.schedule.batch
        batch = range(first, first + self.schedule.batch)
        share = distributed.shard(batch)
        weight = len(share) / len(batch)  # losses are means over samples
        set_rate(self.optimiser, self.lr_schedule.rate(self.step))
        values = self._gradient(share, weight)
        terms = weight * torch.stack(list(values.values())).double()
        total, *totals = distributed.all_reduce_sum(terms).tolist()
        if not math.isfinite(total):
            raise self._diverged(f"step {self.step} ({self.task.samples.describe(batch)})")
        distributed.all_reduce_gradients(self.network)
        if self.schedule.clip > 0:
            torch.nn.utils.clip_grad_norm_(self.network.parameters(), self.schedule.clip)
        self.optimiser.step()
        self._pull_to_start()
        self.step += 1
        # The decay grows from 0 to the schedule's, so that the average does not keep the initial weights.
        decay = min(self.schedule.ema, self.step / (self.step + 10))
        update_average(self.average, self.network, decay=decay, start=self.start, share=self.schedule.start_share)
        return total, dict(zip(list(values)[1:], totals, strict=True))

    @torch.no_grad()
    def _pull_to_start(self) -> None:
        """Decay towards the start weights, apart from the gradient as AdamW's decay towards 0."""
        amount = min(1.0, self.schedule.anchor * self.lr_schedule.rate(self.step))
        for name, parameter in self.network.named_parameters() if amount else ():
            if parameter.requires_grad:
                parameter.lerp_(self.start[name], amount)

    def _gradient(self, numbers: range, weight: float) -> dict[str, Tensor]:
        """`Gradient` of the samples of these numbers."""
        self.distance.weights = self.lr_schedule.loss_weights
        try:
            return self.gradient(numbers, weight)
        except (RuntimeError, ValueError) as error:
            if self.step or isinstance(error, MwdnError):
                raise
            raise ParameterError(
                f"[network] {self.recipe.network} cannot learn from a batch of {len(numbers)} of these samples: "
                f"{str(error).splitlines()[0]}"
            ) from error

    def _diverged(self, where: str) -> DivergenceError:
        last = self.folder.weights("last")
        kept = f' The weights of the last validation are kept: `start = "{last}"`.' if last.exists() else ""
        return DivergenceError(
            f"The loss of {where} is not finite. Lower the learning rate and choose another folder, `out`.{kept}"
        )

    def validate(self) -> Validation:
        """Validate the averaged weights, write the contact sheet, and pass the loss to the learning rate schedule.

        The first process validates; all use its numbers.

        Raises:
            DivergenceError: the loss is not finite; the last saved state stays as it was.
        """
        result = Validation(math.nan, math.nan)
        if distributed.rank() == 0:
            result = self.validator(self.average, self.distance, f"step {self.step}")
        psnr, loss = distributed.broadcast_json(lambda: (result.psnr, result.loss))
        if not math.isfinite(loss):
            raise self._diverged(f"the validation after step {self.step}")
        if result.sheet is not None:
            write_picture(self.out / "validation.png", result.sheet)
        self.lr_schedule = self.lr_schedule.after(loss)
        return Validation(psnr, loss, result.sheet)

    def save(self, validation: Validation) -> None:
        """Write the last weights, the best ones if these are, and the whole state, each atomically.

        Raises:
            ParameterError: the folder cannot be written to, for example because the disk is full; the last saved state
                stays as it was.
        """
        score = -validation.loss if self.schedule.best_by == "loss" else validation.psnr
        self.best = max(self.best, score)
        if distributed.rank() > 0:
            return
        metadata = {**self.psf_identity, **self.identity, "step": self.step, "psnr": validation.psnr}
        options = dict(self.recipe.network)
        name = options.pop("name")
        with as_parameter_error(self.out, MAKE_ROOM):
            for file in ("last", "best") if score == self.best else ("last",):
                save_network(self.folder.weights(file), self.average, name, options, **metadata)
        self._save_state()

    def _save_state(self) -> None:
        """Write everything from which the run resumes, on the first process."""
        if distributed.rank() > 0:
            return
        header = {"identity": json.dumps(self.identity), "step": str(self.step), "best": repr(self.best)}
        header |= {"lr_schedule": json.dumps(self.lr_schedule.state()), "samples": self.fingerprint}
        with as_parameter_error(self.out, MAKE_ROOM):
            write_state(self.folder.state, header, network=self.network, average=self.average, optimiser=self.optimiser)

    def _resume(self) -> None:
        saved = self.folder.read()
        if saved is None:
            return
        state, header = saved
        try:
            restore(state, network=self.network, average=self.average, optimiser=self.optimiser)
            self.step, self.best = int(header["step"]), float(header["best"])
            saved_schedule = header.get("lr_schedule") or header["course"]  # the second is its former name
            self.lr_schedule = make_lr_schedule(self.recipe, **json.loads(saved_schedule))
        except (KeyError, ValueError, TypeError, RuntimeError) as error:
            raise damaged(self.folder.state, "a part is missing") from error
        self.fingerprint = header.get("samples", "")

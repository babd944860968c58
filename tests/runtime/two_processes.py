"""Run by two processes, which `test_distributed.py` starts by torchrun; it checks the files they write.

They begin with the `mwdn` command of their arguments.
"""

import json
import os
import sys
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path

import torch
from safetensors.torch import save_file
from torch import nn

from mwdn import cli
from mwdn.calibration import Calibration
from mwdn.data.simulated import SimulatedPairs
from mwdn.errors import MwdnError
from mwdn.runtime import distributed
from mwdn.training.batch_norm import synchronise
from mwdn.training.experiment import prepare
from mwdn.training.recipe import read_recipe
from mwdn.training.tasks import SupervisedTask


def batch_norm():
    """Normalise features (5, 3, 4, 6) with means of 0, 10 and 1000, in shares of 2 and 3."""
    for dtype in (torch.float64, torch.float32):
        whole = nn.BatchNorm2d(3).to(dtype)
        layer = nn.Sequential(nn.BatchNorm2d(3)).to(dtype)
        drawn = torch.Generator().manual_seed(0)
        x = torch.randn(5, 3, 4, 6, generator=drawn, dtype=torch.float64)
        x = (x + torch.tensor([0.0, 10.0, 1000.0])[:, None, None]).to(dtype)
        gradient = torch.randn(5, 3, 4, 6, generator=drawn, dtype=torch.float64).to(dtype)
        weights = torch.randn(2, 3, generator=drawn, dtype=torch.float64).to(dtype)
        for one in (whole, layer[0]):
            one.load_state_dict(one.state_dict() | {"weight": weights[0], "bias": weights[1]})
        synchronise(layer, torch.device("cpu"))
        results = {}
        for name, one, mine in (("one", whole, range(5)), ("two", layer, distributed.shard(range(5)))):
            mine = slice(mine.start, mine.stop)
            part = x[mine].clone().requires_grad_()
            for _ in range(2):
                y = one(part)
            y.backward(gradient[mine])
            outputs, inputs = torch.zeros(2, *x.shape, dtype=dtype)
            outputs[mine], inputs[mine] = y.detach(), part.grad
            if name == "two":
                distributed.all_reduce_gradients(layer)
                outputs, inputs = distributed.all_reduce_sum(outputs), distributed.all_reduce_sum(inputs)
            norm = layer[0] if name == "two" else whole
            parts = {"y": outputs, "x.grad": inputs, "w.grad": norm.weight.grad, "b.grad": norm.bias.grad}
            parts |= {"mean": norm.running_mean, "var": norm.running_var, "count": norm.num_batches_tracked}
            parts |= {"eval": norm.eval()(x).detach()}
            results |= {f"{name}.{key}": value for key, value in parts.items()}
        save_file(results, f"{dtype}-{distributed.rank()}.safetensors".removeprefix("torch."))


class NotFinite(SimulatedPairs):
    """Pairs whose scenes are not finite on the second process."""

    def batch(self, numbers):
        pair = super().batch(numbers)
        return pair._replace(scene=pair.scene / (1 - distributed.rank()))


@contextmanager
def double_precision():
    """Compute everything in float64, also after `Tensor.float`."""
    single = torch.Tensor.float
    torch.Tensor.float = torch.Tensor.double
    torch.set_default_dtype(torch.float64)
    yield
    torch.set_default_dtype(torch.float32)
    torch.Tensor.float = single


def train_precisely(folder):
    """The training of cpsf.toml with a PSF in float64."""
    psf = Calibration.from_file("psf.npy", background=0.0).psf.double()
    recipe = read_recipe("cpsf.toml")
    return prepare(recipe, Calibration(psf), photos=Path("photos"), out=Path(folder), device="cpu")


def main():
    with suppress(SystemExit):
        cli.main(sys.argv[1:])  # `mwdn train`, in a group of its own
    os.environ["TORCHELASTIC_RESTART_COUNT"] = "again"  # the store still has the addresses of that group
    calibration = Calibration.from_file("psf.npy", background=0.0)
    recipe, number = read_recipe("r.toml"), os.environ["RANK"]

    def start(folder, recipe=recipe):
        return prepare(recipe, calibration, photos=Path("photos"), out=Path(folder), device="cpu")

    def attempt(action):
        with Path(f"said-{number}.txt").open("a") as file:
            try:
                action()
            except MwdnError as error:
                file.write(f"{type(error).__name__}: {error}\n")

    with distributed.process_group():
        assert distributed.gather_json([distributed.rank()]) == [[0], [1]]
        batch_norm()
        with double_precision():
            run = train_precisely("double/two")
            run.run()
        Path(f"lr_schedule-{number}.json").write_text(json.dumps(run.lr_schedule.state()))
        start("mixed").run()  # started by one process
        attempt(lambda: start("small", replace(recipe, schedule=replace(recipe.schedule, batch=1))))
        attempt(lambda: distributed.local_device("cuda:0"))
        trainer = start("not-finite")
        trainer.gradient.task = SupervisedTask(NotFinite(**vars(trainer.task.samples)))
        attempt(trainer.run)
        # The second has another recipe and ends; the first loses its connection.
        odd = replace(recipe, schedule=replace(recipe.schedule, seed=int(number)))
        attempt(lambda: start("odd", odd).run())
        os._exit(0)


if __name__ == "__main__":
    main()

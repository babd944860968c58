"""Training throughput of the paper-size MWDN: as in `mwdn train`, against the plain way, in the same run.

    python benchmarks/train.py [--batch 2] [--steps 3] [--width 64] [--size 320x320]

Plain: float32, contiguous tensors, no autocast, no CUDA graph. Both use the same pairs and the same optimiser.
"""

import argparse
import json
import time
from pathlib import Path

import numpy as np
import torch

from mwdn.data.simulated import Batch, Samples
from mwdn.networks import build
from mwdn.optics import sample_camera
from mwdn.training.gradient import Gradient
from mwdn.training.losses import Loss
from mwdn.training.recipe import Schedule
from mwdn.training.tasks import SupervisedTask


class Fixed(Samples):
    """The same batch, whatever its numbers."""

    def __init__(self, batch):
        self.fixed = batch

    def batch(self, numbers):
        return self.fixed


def trainer(width, batch, *, fast):
    """One optimiser step as a function."""
    torch.manual_seed(0)
    device = batch.scene.device
    network = build("mwdn", width=width).to(device).train()
    optimiser = torch.optim.AdamW(network.parameters(), lr=1e-4)
    numbers = range(len(batch.scene))
    if fast:
        network.to(memory_format=torch.channels_last)
        schedule = Schedule(batch=len(numbers), bfloat16=True)
        gradient = Gradient(network, SupervisedTask(Fixed(batch)), Loss({"mse": 1.0}), schedule, device)

    def step():
        if fast:
            loss = gradient(numbers)["loss"]
        else:
            optimiser.zero_grad(set_to_none=True)
            loss = (network(batch.measurement, batch.psf) - batch.scene).square().mean()
            loss.backward()
        optimiser.step()
        return loss.item()  # waits for the device

    return step


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--batch", type=int, default=2)
    parser.add_argument("--steps", type=int, default=3)
    parser.add_argument("--width", type=int, default=64)
    parser.add_argument("--size", default="320x320", help="height x width")
    parser.add_argument("--out", type=Path, default=Path("benchmarks/results/train.json"))
    arguments = parser.parse_args()
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    generator = torch.Generator().manual_seed(0)
    size = tuple(int(side) for side in arguments.size.split("x"))
    psf = sample_camera(generator, size, family="contours").to(device)
    scene = torch.rand(arguments.batch, 3, *size, generator=generator).to(device)
    batch = Batch(scene, scene, psf)
    steps = {"plain": trainer(arguments.width, batch, fast=False), "mwdn": trainer(arguments.width, batch, fast=True)}
    seconds = {name: [] for name in steps}
    for repeat in range(arguments.steps + 1):
        for name, step in steps.items():
            start = time.perf_counter()
            step()
            if repeat:  # the first step warms up
                seconds[name].append(time.perf_counter() - start)
    speed = {name: arguments.batch / float(np.median(times)) for name, times in seconds.items()}
    for name, value in speed.items():
        print(f"{name:6s} {value:8.2f} pictures/s   {value / speed['plain']:4.1f} x")
    record = {
        "device": torch.cuda.get_device_name() if device.type == "cuda" else "cpu",
        "threads": torch.get_num_threads(),
        "torch": torch.__version__,
        "size": arguments.size,
        "width": arguments.width,
        "batch": arguments.batch,
        "pictures_per_s": speed,
        "ratio": speed["mwdn"] / speed["plain"],
    }
    arguments.out.parent.mkdir(parents=True, exist_ok=True)
    arguments.out.write_text(json.dumps(record, indent=2) + "\n")


if __name__ == "__main__":
    main()

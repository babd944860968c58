"""Training throughput of the paper-size MWDN: as in `mwdn train`, against the plain way, in the same run.

    python benchmarks/train.py [--batch 2] [--steps 3] [--width 64]

Plain: float32, contiguous tensors, no autocast. Both use the same pairs and the same optimiser.
"""

import argparse
import json
import time
from pathlib import Path

import numpy as np
import torch

from mwdn.networks import build
from mwdn.optics import sample_camera

SIZE = 320, 320


def trainer(width, device, *, fast):
    """One optimiser step as a function of a batch."""
    torch.manual_seed(0)
    network = build("mwdn", width=width).to(device).train()
    if fast:
        network.to(memory_format=torch.channels_last)
    optimiser = torch.optim.AdamW(network.parameters(), lr=1e-4)

    def step(measurement, psf, scene):
        if fast:
            measurement = measurement.contiguous(memory_format=torch.channels_last)
        with torch.autocast(device.type, torch.bfloat16, enabled=fast):
            reconstruction = network(measurement, psf)
        loss = (reconstruction.float() - scene).square().mean()
        optimiser.zero_grad(set_to_none=True)
        loss.backward()
        optimiser.step()
        return loss.item()  # waits for the device

    return step


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--batch", type=int, default=2)
    parser.add_argument("--steps", type=int, default=3)
    parser.add_argument("--width", type=int, default=64)
    parser.add_argument("--out", type=Path, default=Path("benchmarks/results/train.json"))
    arguments = parser.parse_args()
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    generator = torch.Generator().manual_seed(0)
    psf = sample_camera(generator, SIZE, family="contours").to(device)
    scene = torch.rand(arguments.batch, 3, *SIZE, generator=generator).to(device)
    steps = {"plain": trainer(arguments.width, device, fast=False), "mwdn": trainer(arguments.width, device, fast=True)}
    seconds = {name: [] for name in steps}
    for repeat in range(arguments.steps + 1):
        for name, step in steps.items():
            start = time.perf_counter()
            step(scene, psf, scene)
            if repeat:  # the first step warms up
                seconds[name].append(time.perf_counter() - start)
    speed = {name: arguments.batch / float(np.median(times)) for name, times in seconds.items()}
    for name, value in speed.items():
        print(f"{name:6s} {value:8.2f} pictures/s   {value / speed['plain']:4.1f} x")
    record = {
        "device": torch.cuda.get_device_name() if device.type == "cuda" else "cpu",
        "threads": torch.get_num_threads(),
        "torch": torch.__version__,
        "width": arguments.width,
        "batch": arguments.batch,
        "pictures_per_s": speed,
        "ratio": speed["mwdn"] / speed["plain"],
    }
    arguments.out.parent.mkdir(parents=True, exist_ok=True)
    arguments.out.write_text(json.dumps(record, indent=2) + "\n")


if __name__ == "__main__":
    main()

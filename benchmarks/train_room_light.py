"""Train the network that finds the light of a room (`mwdn.networks.room_light`), on simulated captures.

    python benchmarks/train_room_light.py ../shared/data [--samples 19200] [--steps 13000] [--folder runs/room-light]

Captures through random cameras, of the recipes mismatched and real-like without their own room light, or with an exact
PSF: objects on dark (`kinds`), some before a bright backdrop, and photographs that fill the frame. A third of them has
no light; the others have light of 3 to 53 % of the scene's: even, a slope, a spot, or two of these, in any colour. The
captures are made once, in coarse pixels, eight at a time, and kept in the folder; a stopped run makes only the rest.
The loss is the root mean square error of the light over the mean of the capture, twice as heavy where there is none.
Too much light counts three times as much as too little (`TOO_MUCH`): the scene cannot get back what is subtracted. The
file of weights gets their moving average. About an hour on two cores, half of it for the captures.
"""

import argparse
import copy
import math
import random
import time
from dataclasses import replace
from pathlib import Path

import torch
from torch.nn import functional as F

import mwdn
from mwdn.data.cameras import CameraPairs, Cameras
from mwdn.data.mismatch import EXACT
from mwdn.data.photographs import Photographs
from mwdn.data.simulated import SimulatedPairs
from mwdn.inference.room_light import PIXELS, halved
from mwdn.networks.room_light import RoomLightUNet, clues
from mwdn.optics.room_light import even_light, sloping_light, spot_light
from mwdn.training.network import update_average
from mwdn.training.recipe import read_recipe
from mwdn.weights.checkpoint import save_network

SIZES = (160, 160), (136, 240), (240, 240), (152, 200), (192, 192)
TOGETHER = 8
SHARES = 0.03, 0.53
"""Range of the light over the scene's; a small one is more frequent than a large one."""

TOO_MUCH = 3.0
"""Factor on the error where there is more light than the room's."""

DIM = 0.3, (0.04, 0.3)
"""Part of the captures in poor light, and the exposure of these."""


def kinds():
    """Part, placement and mismatch of each kind of capture."""
    real, mild = read_recipe("real-like"), read_recipe("mismatched")
    camera = replace(real.mismatch, hot_pixels=0.0, room_light=0.0, gamma_coded=0.0, eight_bit=0.0)
    dark = replace(real.placement, ambient=(0.0, 0.0))
    filling, beyond = replace(dark, extent=(0.95, 1.3), offset=0.1), replace(dark, extent=(1.0, 2.1), offset=0.3)
    return [
        (0.15, dark, EXACT),
        (0.10, dark, mild.mismatch),
        (0.29, dark, camera),
        (0.04, replace(dark, backdrop=(0.0, 0.3)), camera),
        (0.08, filling, EXACT),
        (0.09, filling, camera),
        (0.10, beyond, EXACT),
        (0.15, beyond, camera),
    ]


def shape(kind, size, generator):
    """Light (h, w) of mean 1."""

    def uniform(low, high):
        return low + (high - low) * float(torch.rand((), generator=generator))

    if kind == "even":
        return even_light(size)
    if kind == "slope":
        part = uniform(0.3, 1.0)
        return 1 - part + part * sloping_light(size, uniform(0, 2 * math.pi))
    if kind == "spot":
        return spot_light(size, (uniform(-0.1, 1.1), uniform(-0.1, 1.1)), uniform(0.25, 0.6))
    part, plane = uniform(0.2, 0.8), ("even", "slope")[int(uniform(0, 2))]
    return part * shape(plane, size, generator) + (1 - part) * shape("spot", size, generator)


def light(size, generator):
    """Light (3, h, w) over the mean of the scene's."""
    if float(torch.rand((), generator=generator)) < 0.3:
        return torch.zeros(3, *size)
    kind = ("even", "slope", "spot", "both")[int(torch.randint(4, (), generator=generator))]
    low, high = SHARES
    share = low + (high - low) * float(torch.rand((), generator=generator)) ** 1.3
    colour = 1 + 0.6 * (torch.rand(3, generator=generator) - 0.5) * float(torch.rand((), generator=generator) < 0.6)
    return share * colour[:, None, None] * shape(kind, size, generator)


def simulated(number, photographs):
    """`clues` of captures, and their light over the mean of each colour."""
    generator, size = torch.Generator().manual_seed(number), SIZES[number % len(SIZES)]
    parts, placements, mismatches = zip(*kinds(), strict=True)
    kind = int(torch.multinomial(torch.tensor(parts), 1, generator=generator))
    is_dim = float(torch.rand((), generator=generator)) < DIM[0]
    placement = replace(placements[kind], exposure=DIM[1]) if is_dim else placements[kind]
    sensor, some = read_recipe("real-like").sensor, torch.ones(1, 3, *size)
    pairs = SimulatedPairs(photographs, some, placement, mismatches[kind], sensor, seed=900)
    cameras = CameraPairs(pairs, Cameras((f"{size[0]}x{size[1]}",)), TOGETHER)
    batch = cameras.batch(range(number * TOGETHER, (number + 1) * TOGETHER))
    y, psf, _ = halved(batch.measurement, batch.psf, PIXELS)
    lights = torch.stack([light(y.shape[-2:], generator) for _ in y]) * y.mean((1, 2, 3), keepdim=True)
    mean = (y + lights).mean((-2, -1), keepdim=True)
    return clues((y + lights) / mean, psf).half(), (lights / mean).half()


def turned(maps, lights):
    """The same captures mirrored, turned, and with their colours exchanged, by chance."""
    for axis in (-1, -2):
        if random.random() < 0.5:
            maps, lights = maps.flip(axis), lights.flip(axis)
    if random.random() < 0.5:
        maps, lights = maps.mT, lights.mT
    colours = torch.randperm(3)
    return maps[:, colours], lights[:, colours]


def errors(network, maps, lights):
    """Root mean square error of each capture over its mean."""
    with torch.autocast("cpu", torch.bfloat16):
        found = network(maps)
    error = F.leaky_relu(found.float(), 0.1) - lights  # what is negative is cut off later, so it counts little
    error = torch.where(error > 0, TOO_MUCH * error, error)
    return (error.square().mean((1, 2, 3)) + 1e-4).sqrt()


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("data", type=Path)
    parser.add_argument("--samples", type=int, default=19_200)
    parser.add_argument("--steps", type=int, default=13_000)
    parser.add_argument("--folder", type=Path, default=Path("runs/room-light"))
    arguments = parser.parse_args()
    mwdn.keep_memory()
    arguments.folder.mkdir(parents=True, exist_ok=True)
    photographs = Photographs(arguments.data / "photos" / "train")
    captures = []
    for number in range(arguments.samples // TOGETHER):
        path = arguments.folder / f"captures-{number}.pt"
        if not path.exists():
            with torch.no_grad():
                torch.save(simulated(number, photographs), path)
        captures.append(torch.load(path))
    held = max(1, len(captures) // 50)
    held_out, captures = captures[:held], captures[held:]
    torch.manual_seed(0)
    random.seed(0)
    network = RoomLightUNet()
    average = RoomLightUNet().requires_grad_(False)
    optimiser = torch.optim.AdamW(network.parameters(), weight_decay=1e-3)
    order, start = [], time.time()
    for step in range(arguments.steps):
        order = order or random.sample(captures, len(captures))
        maps, lights = turned(*(each.float() for each in order.pop()))
        for group in optimiser.param_groups:
            group["lr"] = 2e-3 * min(1, step / 100) * (1 + math.cos(math.pi * step / arguments.steps)) / 2
        is_dark = lights.amax((1, 2, 3)) <= 0
        loss = (errors(network, maps, lights) * (1 + is_dark)).mean()
        optimiser.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(network.parameters(), 1.0)
        optimiser.step()
        update_average(average, network, decay=1 - max(0.01, 1 / (step + 1)))
        if (step + 1) % 250 == 0 or step + 1 == arguments.steps:
            with torch.no_grad():
                off = [errors(average, *(each.float() for each in pair)).mean() for pair in held_out]
            print(f"{step + 1} steps, {time.time() - start:.0f} s, error {float(sum(off) / len(off)):.4f}", flush=True)
            save_network(arguments.folder / "room-light.safetensors", copy.deepcopy(average).half(), "room-light", {})


if __name__ == "__main__":
    main()

"""A denoiser that learns from the scenes which plug and play gives it, round by round, mixed with the bundled one.

    python benchmarks/rounds.py ../shared/data [--folder runs/rounds] [--captures 600] [--steps 1200] [--shares 0.3 1]

1. Harvest: captures through random cameras (recipe `universal-exact`, 60 % of them as calibrated) are reconstructed by
   `universal`; six of the twelve scenes that each capture hands to the denoiser are kept beside the true scene.
2. Learn: the bundled denoiser goes on learning from these, with the noise level that plug and play told it; 15 % of
   its samples have white noise of that level instead.
3. Measure: PSNR after plug and play, before the U-Net, of each share of the learned weights in the mixture. The folder
   gets `universal` with each mixture, for `benchmarks/universal.py --methods` and `mwdn evaluate`.

All three resume. On one core 600 captures take 25 minutes, 1,200 steps 8, each share 4 with three captures a row.
"""

import argparse
import json
import math
import random
from dataclasses import replace
from pathlib import Path
from statistics import fmean

import torch
from torch import nn

import mwdn
from mwdn.data.cameras import CameraPairs
from mwdn.data.photographs import Photographs
from mwdn.data.recorded import HELD_OUT
from mwdn.data.simulated import SimulatedPairs
from mwdn.evaluation.distances import log_mse
from mwdn.io.files import atomic
from mwdn.solvers import align
from mwdn.solvers.plug_and_play import plug_and_play
from mwdn.training.network import update_average
from mwdn.training.recipe import read_recipe
from mwdn.weights.bundled import find_weights
from mwdn.weights.checkpoint import read_metadata, save_network
from universal import camera, captures, recipe_of

SIZES = ("256x256", "240x320", "320x320", "256x256", "270x480")
KEPT, SIDE, CROP = 6, 144, 128
PSFS = ("mwdn-camera 320x320", "DiffuserCam 270x480")
KINDS = "exact", "mismatched", "real-like", "filling mismatched"
ROWS = [(psf, light, kind) for psf in PSFS for light in (2000.0, 15000.0) for kind in KINDS]


def training_pairs(data, sizes=SIZES):
    recipe = read_recipe("universal-exact")
    recipe = replace(
        recipe,
        cameras=replace(recipe.cameras, sizes=sizes),
        placement=replace(recipe.placement, exposure=(0.04, 1.0)),
        mismatch=replace(recipe.mismatch, exact=0.6),
    )
    photographs, _ = Photographs(data / "photos/train").split(HELD_OUT)
    size = torch.full((1, 3, 64, 64), 1 / 4096)  # each camera brings its own PSF
    pairs = SimulatedPairs(
        photographs, size, placement=recipe.placement, mismatch=recipe.mismatch, sensor=recipe.sensor, seed=41
    )
    return CameraPairs(pairs, recipe.cameras, 4)


@torch.no_grad()
def harvest(network, pairs, number):
    """Crops (level, handed scene, true scene) of some rounds of one capture, in the units of plug and play."""
    measurement, scene, psf = pairs.batch([number])
    estimate = network.iterate(measurement, network.prepare(psf, measurement.shape[-2:]))
    norm = estimate.psf.bands[-1].norm
    height, width = scene.shape[-2:]
    brightest = (estimate.grid_scene * norm)[..., :height, :width].amax((1, 2, 3), keepdim=True).clamp(min=1e-30)
    truth, generator = scene * norm / brightest, random.Random(number)
    wanted, kept, rounds = set(generator.sample(range(network.rounds), KEPT)), [], iter(range(network.rounds))

    def denoise(image, level):
        if (turn := next(rounds)) in wanted:
            # Plug and play mirrors its scene differently in each round.
            mirrored = truth.flip([axis for axis, bit in ((-1, 1), (-2, 2)) if turn & bit])
            top, left = generator.randrange(height - SIDE + 1), generator.randrange(width - SIDE + 1)
            window = 0, slice(None), slice(top, top + SIDE), slice(left, left + SIDE)
            kept.append((float(level), image[window].half().clone(), mirrored[window].half().clone()))
        return network.denoiser(image, level)

    plug_and_play(estimate, denoise, network.rounds)
    return kept


def harvested(network, data, folder, count):
    """Samples of as many captures, each kept in the folder once it is made."""
    pairs, samples = training_pairs(data), []
    for number in range(count):
        path = folder / f"{number:05}.pt"
        if not path.exists():
            with atomic(path) as temporary:
                torch.save(harvest(network, pairs, number), temporary)
        samples += torch.load(path)
    return samples


def batch(samples, generator):
    """Levels, handed and true scenes of four samples, cropped, mirrored and transposed."""
    levels, handed, true = [], [], []
    for _ in range(4):
        level, image, truth = generator.choice(samples)
        image, truth = image.float(), truth.float()
        if generator.random() < 0.15:
            image = truth + level * torch.randn(truth.shape)
        top, left = (generator.randrange(SIDE - CROP + 1) for _ in range(2))
        axes = [axis for axis in (-1, -2) if generator.random() < 0.5]
        image, truth = (p[:, top : top + CROP, left : left + CROP].flip(axes) for p in (image, truth))
        if generator.random() < 0.5:
            image, truth = image.mT, truth.mT
        levels.append(level), handed.append(image), true.append(truth)
    return torch.tensor(levels).reshape(-1, 1, 1, 1), torch.stack(handed), torch.stack(true)


def learn(denoiser: nn.Module, average: nn.Module, samples, steps):
    """The moving average of the denoiser's weights after these steps."""
    torch.manual_seed(1)
    generator = random.Random(1)
    denoiser.requires_grad_(True).train()
    optimiser = torch.optim.AdamW(denoiser.parameters(), lr=0.0, weight_decay=0.0)
    for step in range(steps):
        for group in optimiser.param_groups:
            group["lr"] = 3e-4 * min(1, (step + 1) / 50) * (0.51 + 0.49 * math.cos(math.pi * step / steps))
        levels, handed, true = batch(samples, generator)
        loss = log_mse(denoiser(handed, levels), true).mean()
        optimiser.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(denoiser.parameters(), 1.0)
        optimiser.step()
        update_average(average, denoiser, decay=min(0.995, (step + 1) / (step + 11)))
        if (step + 1) % 100 == 0:
            print(f"step {step + 1}: {float(loss):.2f}", flush=True)
    return average.state_dict()


@torch.no_grad()
def measured(network, data, count):
    """Mean PSNR in dB of each row after plug and play."""
    photographs, result = Photographs(data / "photos/test"), {}
    for psf, light, kind in ROWS:
        calibration, values = camera(data, psf), []
        simulated = captures(calibration.psf, photographs, recipe_of(kind), light, range(count), exact=kind == "exact")
        for measurement, scene in simulated:
            aligned = align(measurement[None], calibration.psf).move(calibration.psf)
            start = network.iterate(measurement[None], network.prepare(aligned, measurement.shape[-2:]))
            estimate = plug_and_play(start, network.denoiser, network.rounds)
            values.append(float(mwdn.psnr(estimate.scene.clamp(0, 1), scene[None])))
        row = f"{psf}, {light:,.0f} e, {kind}"
        result[row] = round(fmean(values), 2)
        print(row, result[row], flush=True)
    return result


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("data", type=Path)
    parser.add_argument("--folder", type=Path, default=Path("runs/rounds"))
    parser.add_argument("--captures", type=int, default=600)
    parser.add_argument("--steps", type=int, default=1200)
    parser.add_argument("--count", type=int, default=3, help="captures a row")
    parser.add_argument("--learned", type=Path, help="measure these weights of a denoiser; nothing is learned")
    parser.add_argument("--shares", type=float, nargs="+", default=[0.0, 0.3, 1.0])
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    mwdn.keep_memory()
    folder, network = arguments.folder, mwdn.load_network("universal").float().eval()
    folder.mkdir(parents=True, exist_ok=True)
    options = read_metadata(find_weights("universal"))["options"]
    bundled = {name: value.clone() for name, value in network.denoiser.state_dict().items()}
    learned_path = arguments.learned or folder / f"denoiser-{arguments.captures}-{arguments.steps}.pt"
    if not learned_path.exists():
        samples = harvested(network, arguments.data, folder, arguments.captures)
        average = mwdn.load_network("universal").float().eval().denoiser
        with atomic(learned_path) as temporary:
            torch.save(learn(network.denoiser, average, samples, arguments.steps), temporary)
    learned, record_path = torch.load(learned_path), folder / "record.json"
    record = json.loads(record_path.read_text()) if record_path.exists() else {}
    network.denoiser.requires_grad_(False).eval()
    for share in arguments.shares:
        key = f"{learned_path.stem}, share {share}, {arguments.count} captures a row"
        if key not in record:
            network.denoiser.load_state_dict({name: bundled[name].lerp(learned[name], share) for name in bundled})
            save_network(folder / f"{learned_path.stem}-{share}.safetensors", network, "wiener-bank", options)
            record[key] = measured(network, arguments.data, arguments.count)
            with atomic(record_path) as temporary:
                temporary.write_text(json.dumps(record, indent=1) + "\n")
        print(key, record[key])


if __name__ == "__main__":
    main()

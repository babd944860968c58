"""What the U-Net of `wiener-bank` may do to the mean light, trained on exact and real-like cameras together.

    python benchmarks/mean_light.py ../shared/data [--pool 400] [--steps 450]

Each variant starts from `universal-small` and learns from the same captures, through random cameras of the recipe
universal-small with the [mismatch] of real-like, of which two fifths match their calibration. The captures and what is
computed of them before the U-Net are made once. Prints and writes the PSNR in dB of held-out captures, of exact and of
real-like cameras, and of the eight DiffuserCam pairs (best gain and offset, rows 60:270, columns 60:440). One thread.
"""

import argparse
import json
import random
from dataclasses import replace
from pathlib import Path
from statistics import fmean

import torch

import mwdn
from mwdn import Calibration
from mwdn.data.cameras import CameraPairs
from mwdn.data.mismatch import EXACT
from mwdn.data.photographs import Photographs
from mwdn.data.recorded import HELD_OUT
from mwdn.data.simulated import Batch, SimulatedPairs
from mwdn.evaluation.distances import log_mse, ssim
from mwdn.evaluation.metrics import best_gain, psnr
from mwdn.io.files import atomic
from mwdn.io.images import read_frame
from mwdn.networks import build
from mwdn.training.network import update_average
from mwdn.training.recipe import Schedule, read_recipe
from mwdn.training.schedule import learning_rate, make_optimiser, set_rate
from mwdn.weights.growth import grown

OPTIONS = {"width": 16, "regularisations": (1e-3, 5e-5), "finest": 4, "align": False}
VARIANTS = {
    "kept": {"mean_light": "kept"},
    "kept, evidence": {"mean_light": "kept", "evidence": True},
    "free, evidence": {"mean_light": "free", "evidence": True},
    "gated, evidence": {"mean_light": "gated", "evidence": True},
}
SIZES = ("256x256", "240x320", "256x256", "270x480")
CROP, BATCH = 192, 4


def variant(name):
    network = build("wiener-bank", **OPTIONS, **VARIANTS[name])
    network.load_state_dict(grown(mwdn.load_network("universal-small").float().state_dict(), network))
    return network


@torch.no_grad()
def estimates(network, pairs):
    """Estimates, unit and scene of each pair; the evidence comes last, so that variants without it can leave it out."""
    computed = [(network.estimates(pair.measurement, pair.psf), pair.scene) for pair in pairs]
    return [(each.half(), network.unit(each), scene.half()) for each, scene in computed]


def captures(recipe, photographs, mismatch, seed, count):
    psf = torch.full((1, 3, 64, 64), 1 / 64**2)  # its place is taken by random PSFs
    pairs = SimulatedPairs(
        photographs, psf, placement=recipe.placement, mismatch=mismatch, sensor=recipe.sensor, seed=seed
    )
    source = CameraPairs(pairs, replace(recipe.cameras, sizes=SIZES), BATCH)
    return (source.batch([number]) for number in range(count))


def diffusercam(data):
    calibration = Calibration.from_file(
        data / "diffusercam/psf_recovered_270x480.npy", background=0.0, upside_down=True, bgr=True
    )
    for path in sorted((data / "diffusercam/diffuser_images").glob("*.npy")):
        both = (path, data / "diffusercam/ground_truth_lensed" / path.name)
        measurement, scene = (torch.from_numpy(read_frame(each)[::-1, :, ::-1].copy()).float() for each in both)
        yield Batch(measurement.movedim(-1, 0)[None], scene.movedim(-1, 0)[None], calibration.psf)


def crop(sample, generator):
    estimate, unit, scene = sample
    top, left = (generator.randrange(length - CROP + 1) for length in scene.shape[-2:])
    axes = [axis for axis in (-1, -2) if generator.random() < 0.5]
    cut = (..., slice(top, top + CROP), slice(left, left + CROP))
    return estimate[cut].float().flip(axes), unit, scene[cut].float().flip(axes)


def train(network, pool, steps):
    """The moving average of the weights after this many steps."""
    schedule = Schedule(steps=steps, learning_rate=1e-3, warmup=50)
    optimiser, generator = make_optimiser(network, schedule), random.Random(5)
    average = build("wiener-bank", **OPTIONS, mean_light=network.mean_light, evidence=network.has_evidence).eval()
    average.load_state_dict(network.state_dict())
    channels = network.pictures if not network.has_evidence else None
    for step in range(steps):
        set_rate(optimiser, learning_rate(step, schedule))
        samples = [crop(pool[generator.randrange(len(pool))], generator) for _ in range(BATCH)]
        estimate, unit, scene = (torch.cat(part) for part in zip(*samples, strict=True))
        reconstruction = network.train().correct(estimate[:, :channels], unit)
        loss = log_mse(reconstruction, scene).mean() + 0.1 * (1 - ssim(reconstruction, scene)).mean()
        optimiser.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(network.parameters(), 1.0)
        optimiser.step()
        update_average(average, network, decay=min(0.99, step / (step + 10)))
    return average


@torch.no_grad()
def score(network, sets):
    network.eval()
    channels = network.pictures if not network.has_evidence else None
    result = {}
    for name, samples in sets.items():
        values = []
        for estimate, unit, scene in samples:
            image, scene = network.correct(estimate[:, :channels].float(), unit), scene.float()
            if name == "DiffuserCam":
                image, scene = (each[..., 60:270, 60:440] for each in (image, scene))
                image = best_gain(image, scene)
            else:
                image = image.clamp(0, 1)
            values.append(float(psnr(image, scene)))
        result[name] = round(fmean(values), 2)
    return result


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("data", type=Path)
    parser.add_argument("--pool", type=int, default=400)
    parser.add_argument("--steps", type=int, default=450)
    parser.add_argument("--count", type=int, default=24)
    parser.add_argument("--out", type=Path, default=Path("benchmarks/results/mean-light.json"))
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    mwdn.keep_memory()
    recipe = read_recipe("universal-small")
    real = replace(read_recipe("real-like").mismatch, turn_degrees=0.06, scale=0.002)  # the pose is aligned
    photographs, held_out = Photographs(arguments.data / "photos/train").split(HELD_OUT)
    network = variant("kept, evidence").eval()
    pool = estimates(network, captures(recipe, photographs, replace(real, exact=0.4), 41, arguments.pool))
    sets = {
        "exact": estimates(network, captures(recipe, held_out, EXACT, 43, arguments.count)),
        "real-like": estimates(network, captures(recipe, held_out, real, 44, arguments.count)),
        "DiffuserCam": estimates(network, diffusercam(arguments.data)),
    }
    results = {"universal-small": score(variant("kept"), sets)}
    print("universal-small", results["universal-small"], flush=True)
    for name in VARIANTS:
        torch.manual_seed(0)
        results[name] = score(train(variant(name), pool, arguments.steps), sets)
        print(name, results[name], flush=True)
    with atomic(arguments.out) as temporary:
        temporary.write_text(json.dumps({"pool": arguments.pool, "steps": arguments.steps, "psnr": results}, indent=1))


if __name__ == "__main__":
    main()

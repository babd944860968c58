"""Learning from few pairs: the recipe few-pairs on 2, 4, 6 ... pairs of a file, tested on pairs that are left out.

    mwdn import diffusercam ../shared/data/diffusercam -o dc.h5
    python benchmarks/few_pairs.py dc.h5 --psf ../shared/data/diffusercam/psf_recovered_270x480.npy \
        --options "background=0.0 upside_down=true bgr=true" --protocol 60:270,60:440 [--learn 2 4 6] [--folds 4]

Each fold is tested by the last weights, not the best: no choice depends on the pairs it is tested on. A fold learns
from the first pairs that are not left out. `universal` itself and ADMM are measured on the same pairs. Every pair is
aligned and estimated once and kept beside the file of pairs. Scores are those of `mwdn evaluate --variant best-gain`.
Results are written after each fold, and folds that are already in the record are not measured again. `undistorted` are
the pictures of `universal` and ADMM in the geometry of the scenes, as the pairs that are learned from show it.

`--calibrated` refines the calibration first, as `mwdn calibrate --pairs` does, from the pairs that a fold learns from.
"""

import argparse
import json
import tempfile
from dataclasses import replace
from pathlib import Path
from statistics import fmean

import torch

from mwdn import Calibration, Reconstructor, load_network
from mwdn.calibration.term_selection import select_terms
from mwdn.data.pairs import PairFile
from mwdn.data.recorded import RecordedPairs
from mwdn.data.splits import split
from mwdn.evaluation.metrics import Perceptual, Protocol, best_gain, bootstrap, measure
from mwdn.io.contact_sheets import contact_sheet
from mwdn.io.files import atomic
from mwdn.io.images import write_picture
from mwdn.io.toml import parse_value
from mwdn.optics.distortion import displacement_px, undistort
from mwdn.optics.shading import shading
from mwdn.training.recipe import read_recipe
from mwdn.training.sample_cache import SampleCache
from mwdn.training.sample_files import Sample
from mwdn.training.tasks import pair_tasks
from mwdn.training.trainer import Trainer
from mwdn.training.validation import Validation

METRICS = ("psnr", "ssim", "lpips")


def refined(calibration, file, rows):
    """The calibration with the terms that explain these pairs, each left out in turn."""

    def pairs():
        for row in rows:
            measurement, scene = file[row]
            yield measurement[None], scene[None]

    selection = select_terms(calibration.psf, pairs)
    return calibration.refined(selection.fit(selection.taken[-1].terms).refinement())


def estimated(path, calibration, network, name):
    """Each pair's sample as the training caches it, by its position in the file; kept under this name."""
    kept = path.with_suffix(f".{name}.pt")
    if kept.exists():
        return [Sample(*parts) for parts in torch.load(kept, weights_only=True)]
    file = PairFile(path)
    pairs = RecordedPairs(
        file, range(len(file)), calibration.psf, shuffled=False, aligned=True, refinement=calibration.refinement
    )
    cache = SampleCache(pairs, size=len(file), batch=1, crop=0, seed=0)
    samples = [cache._cached(network, row) for row in range(len(file))]
    torch.save([tuple(sample) for sample in samples], kept)
    return samples


def tuned(recipe, calibration, parts, samples, path):
    """The network after the recipe's last step on the pairs at these positions."""
    file = PairFile(path)
    train, test = (RecordedPairs(file, rows, calibration.psf, shuffled=False, aligned=True) for rows in parts)
    recipe = replace(recipe, schedule=replace(recipe.schedule, validation=len(test)))
    tasks = pair_tasks(train, test, recipe.schedule, best_gain=True)
    for task in tasks:
        task.cache.samples = {number: samples[task.samples.row(number)] for number in range(task.cache.size)}
    with tempfile.TemporaryDirectory() as folder:
        trainer = Trainer(recipe, tasks[0], out=Path(folder), calibration=calibration, validator=NoValidation())
        trainer.run()
        return trainer.average


class NoValidation:
    """In place of a validator: the weights of the last step are tested."""

    def __call__(self, *_):
        return Validation(0.0, 0.0)

    def reconstruct_captures(self, *_):
        return []


def scores(picture, scene, protocol, perceptual):
    result = measure(picture, scene[None], protocol, variant="best-gain", perceptual=perceptual)
    return {name: round(float(result[name]), 4) for name in METRICS}


@torch.no_grad()
def of_network(network, sample):
    estimates = sample.estimates[None].float()
    return network.as_recorded(network.correct(estimates, sample.unit[None].float()))


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("pairs", type=Path)
    parser.add_argument("--psf", type=Path, required=True)
    parser.add_argument("--options", default="", help="of Calibration.from_file: background=0.0 bgr=true")
    parser.add_argument("--protocol", default="full")
    parser.add_argument("--learn", type=int, nargs="+", default=[6])
    parser.add_argument("--folds", type=int, default=4)
    parser.add_argument("--steps", type=int)
    parser.add_argument("--calibrated", action="store_true", help="refine the calibration from the learned pairs first")
    parser.add_argument("--sheets", type=Path, help="folder for a sheet of each fold: before, after, scene")
    parser.add_argument("--out", type=Path, default=Path("benchmarks/results/few-pairs.json"))
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    options = dict(word.split("=", 1) for word in arguments.options.split())
    calibration = Calibration.from_file(arguments.psf, **{key: parse_value(value) for key, value in options.items()})
    recipe = read_recipe("few-pairs", steps=arguments.steps)
    protocol, perceptual, file = Protocol.parse(arguments.protocol), Perceptual.load(), PairFile(arguments.pairs)
    universal = load_network(recipe.schedule.start)
    plain = estimated(arguments.pairs, calibration, universal, "estimates")
    record = json.loads(arguments.out.read_text()) if arguments.out.exists() else {}
    admm = Reconstructor("admm", calibration)
    for learn in arguments.learn:
        for fold in range(arguments.folds):
            kind = " calibrated" * arguments.calibrated
            key = f"{arguments.pairs.stem}, {learn} pairs{kind}, fold {fold}, {recipe.schedule.steps} steps"
            if key in record:
                continue
            parts = split(len(file), "folds", folds=arguments.folds, fold=fold)
            learned, samples = parts["train"][:learn], plain
            if arguments.calibrated:
                better = refined(calibration, file, learned)
                samples = estimated(arguments.pairs, better, universal, f"{learn}-{fold}")
            network = tuned(recipe, calibration, (learned, parts["validation"]), samples, arguments.pairs)
            values, lines = {}, []
            for row in parts["validation"]:
                measurement, scene = file[row]
                before, after = of_network(universal, samples[row]), of_network(network, samples[row])
                pictures = {"universal": before, "few-pairs": after, "admm": admm(measurement[None])}
                for name in ("universal", "admm"):
                    pictures[f"{name} undistorted"] = undistort(pictures[name].float(), network.distortion)
                values[row] = {name: scores(picture, scene, protocol, perceptual) for name, picture in pictures.items()}
                lines.append(
                    [*(shown(picture, scene, protocol) for picture in pictures.values()), protocol.crop(scene[None])]
                )
            record[key] = values
            with atomic(arguments.out) as temporary:
                temporary.write_text(json.dumps(record, indent=1) + "\n")
            if arguments.sheets:
                arguments.sheets.mkdir(parents=True, exist_ok=True)
                sheet = contact_sheet(lines, [*pictures, "scene"])
                write_picture(arguments.sheets / f"{learn}-{fold}.png", sheet)
            mean, largest = displacement_px(network.distortion, samples[0].scene.shape[-2:])
            print(key, {row: {n: v["psnr"] for n, v in each.items()} for row, each in values.items()})
            least, most = shading(network.shading, samples[0].scene.shape[-2:]).aminmax()
            print(f"  scenes distorted by {mean:.2f} px (root mean square), {largest:.1f} at most,", end=" ")
            print(f"shaded by {least:.2f} to {most:.2f}", flush=True)
    summarise(record)


def shown(picture, scene, protocol):
    return best_gain(protocol.crop(picture), protocol.crop(scene[None])).clamp(0, 1)


def summarise(record):
    """Means over the folds of each count of pairs, and the gain over ADMM with its confidence interval."""
    groups = {}
    for key, values in record.items():
        pairs, learn, _, steps = key.split(", ")
        groups.setdefault(f"{pairs}, {learn}, {steps}", []).extend(values.values())
    for name, pictures in groups.items():
        means = {m: [round(fmean(p[m][k] for p in pictures), 3) for k in METRICS] for m in pictures[0]}
        print(f"{name}: {len(pictures)} pictures {means}")
        for one, other in (("few-pairs", "admm"), ("universal", "admm"), ("universal undistorted", "admm undistorted")):
            gain = bootstrap([p[one]["psnr"] - p[other]["psnr"] for p in pictures])
            print("  {} over {}: {:+.2f} ({:+.2f} to {:+.2f})".format(one, other, *gain))


if __name__ == "__main__":
    main()

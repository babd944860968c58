"""From nothing to a trained camera, on the simulated rig: every command of docs/build-a-camera.md, one after the other.

    python examples/build_a_camera.py /path/to/photos results/walk --counts 10 50 200

Each command is printed before it runs. A step whose result exists is skipped, so a larger count continues the session
with the same held-out pairs. `walk.json` holds the scores of the held-out pairs.
"""

import argparse
import json
import subprocess
import sys
from pathlib import Path

import h5py

from mwdn.data import PairFile
from mwdn.io.images import write_frame

RIG = {"fill": 1.2, "vignetting": 0.15, "envelope_shift": 0.04, "tails": 0.05}
"""Size of the display in the frame; and how the camera differs from a convolution, which is what pairs can teach."""

MOST = 50
"""Pairs to refine the calibration with: more than ten change its smooth terms little."""


def mwdn(*words, result=None):
    """Run a command, unless its result is there."""
    if result is not None and Path(result).exists():
        return
    print("$ mwdn", *words, flush=True)
    subprocess.run([sys.executable, "-m", "mwdn", *map(str, words)], check=True)


def part(source, rows, path):
    """Some pairs of a file as a file of their own."""
    if path.exists():
        return path
    with PairFile(source) as file:
        shapes = {"measurement_shape": file.measurement_shape, "scene_shape": file.scene_shape}
        with PairFile.create(path, **shapes, attributes=file.attributes, psf=file.psf) as other:
            for row in rows:
                other.append(*file[row])
    return path


def score(out, test, camera, *methods):
    """Mean PSNR, SSIM and LPIPS (where its weights are there) of methods on the held-out pairs."""
    names = (method.parent.name if isinstance(method, Path) else method for method in methods)
    folder = out / "-".join(["scores", camera.stem, *names])
    options = ("--data", test, "--camera", camera, "--variant", "best-gain")
    mwdn("evaluate", *methods, *options, "-o", folder, result=folder / "report.json")
    return json.loads((folder / "report.json").read_text(encoding="utf-8"))


def refine(out, pairs, camera):
    """The camera file refined with pairs."""
    refined = out / pairs.name.replace("train", "camera").replace(".h5", ".toml")
    report = refined.with_name(f"{refined.stem}-refinement.json")  # written last
    mwdn("calibrate", "--camera", camera, "--pairs", pairs, "-o", refined, result=report)
    return refined


def train(out, pairs, camera, steps):
    """The weights of a network trained on pairs."""
    run = out / pairs.stem.replace("train", "few")
    weights = run / "best.safetensors"
    mwdn("train", "few-pairs", "--camera", camera, "--pairs", pairs, *steps, "--out", run, result=weights)
    return weights


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("photos", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--counts", type=int, nargs="*", default=[10, 50, 200], help="numbers of pairs to learn from")
    parser.add_argument("--held-out", type=int, default=20, help="pairs to score on, the first of the session")
    parser.add_argument("--size", type=int, default=160, help="pixels along each side of a measurement")
    parser.add_argument("--method", default="universal", help="reconstructs the captures for the alignment")
    parser.add_argument("--steps", type=int, default=None, help="of the training, instead of the recipe's")
    given = parser.parse_args()
    out, held_out, total = given.out, given.held_out, given.held_out + max(given.counts, default=0)
    rig = {**RIG, "height": given.size, "width": given.size}
    options = [word for name, value in rig.items() for word in (f"--rig.{name.replace('_', '-')}", value)]
    options += ["--pictures.folder", given.photos, "--pictures.count", total]

    captured, camera, aligned = out / "captured.h5", out / "camera.toml", out / f"aligned-{total}.h5"
    out.mkdir(parents=True, exist_ok=True)
    mwdn("capture", "capture-rig", "--point.frames", 8, "--point.lamp", "true", *options, "-o", captured)
    mwdn("calibrate", captured, "-o", camera, result=camera)
    mwdn("align", captured, "--camera", camera, "--method", given.method, "-o", aligned, result=aligned)

    test = part(aligned, range(held_out), out / "test.h5")
    scores = {"0 pairs": score(out, test, camera, "universal", "admm")}
    steps = () if given.steps is None else ("--steps", given.steps)
    best = camera, given.method
    for count in given.counts:
        few, pairs = (
            part(aligned, range(held_out, held_out + n), out / f"train-{n}.h5") for n in (min(count, MOST), count)
        )
        refined = refine(out, few, camera)
        trained = train(out, pairs, refined, steps)
        scores[f"{count} pairs, camera refined"] = score(out, test, refined, "universal", "admm")
        scores[f"{count} pairs, network trained, too"] = score(out, test, refined, trained)
        best = refined, trained
    (out / "walk.json").write_text(json.dumps(scores, indent=2), encoding="utf-8")

    capture = out / "capture.png"  # a raw frame of a held-out picture
    with h5py.File(captured) as file:
        write_frame(capture, file["measurement"][0])
    mwdn("reconstruct", capture, "--camera", best[0], "--method", best[1], "-o", out / "pictures")


if __name__ == "__main__":
    main()

"""From nothing to a trained camera, on the simulated rig: every command of docs/build-a-camera.md, one after the other.

    python examples/build_a_camera.py /path/to/photos results/walk --counts 10 50 200

A folder with a camera's own frames replaces the rig's: `photograph` takes the frames of a point source and of darkness,
which people take with the camera's own program. Everything else is a command, printed before it runs. Each step whose
result is there is skipped. `walk.json` holds the scores of the held-out pairs.
"""

import argparse
import json
import subprocess
import sys
from pathlib import Path

import h5py
import numpy as np

from mwdn.capture.patterns import grey, point
from mwdn.capture.recipe import read_capture_recipe
from mwdn.capture.set_up import open_camera
from mwdn.data import PairFile
from mwdn.io.images import write_frame

RIG = {"fill": 1.2, "vignetting": 0.15, "envelope_shift": 0.04, "tails": 0.05}
"""Size of the display in the frame; and how the camera differs from a convolution, which is what pairs can teach."""

DARK_ROOM = {"room_light": 0.0, "display_black": 0.0}
"""For the point source, as people take it: an LED behind a pinhole, with the display switched off."""

FRAMES = 5
RATIO = 8.0
"""Of the long exposure to the short one."""


def mwdn(*words, result=None):
    """Run a command, unless its result is there."""
    if result is not None and Path(result).exists():
        return
    print("$ mwdn", *words, flush=True)
    subprocess.run([sys.executable, "-m", "mwdn", *map(str, words)], check=True)


def photograph(folder, recipe):
    """Write frames of a point source and of a dark display at two exposures; returns those in milliseconds."""
    folder.mkdir(parents=True, exist_ok=True)
    with open_camera(recipe) as camera:
        full = 2**camera.options.bit_depth - 1
        camera.show(point(camera.screen, 0.1))
        exposure = 0.01
        while True:  # as `mwdn calibrate --watch` guides it
            camera.configure(exposure_s=exposure)
            frames = [camera.read().array for _ in range(3)]
            peak = float(np.quantile(frames[-1], 0.9999)) / full
            if 0.6 < peak < 0.9:
                break
            exposure *= 0.5 if peak >= 0.99 else min(0.8 / max(peak, 0.01), 8.0)
        exposures = exposure, RATIO * exposure
        for kind, picture in (
            ("point", point(camera.screen, 0.1)),
            ("dark", grey(0, (camera.screen.height_px, camera.screen.width_px))),
        ):
            camera.show(picture)
            for number, each in enumerate(exposures):
                camera.configure(exposure_s=each)
                for _ in range(2):
                    camera.read()  # some of the picture before
                for count in range(FRAMES):
                    write_frame(folder / f"{kind}-{number}-{count}.png", camera.read().array)
    return [1000 * each for each in exposures]


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
    folder = out / "-".join(
        ["scores", camera.stem, *(method.parent.name if isinstance(method, Path) else method for method in methods)]
    )
    mwdn(
        "evaluate",
        *methods,
        "--data",
        test,
        "--camera",
        camera,
        "--variant",
        "best-gain",
        "-o",
        folder,
        result=folder / "report.json",
    )
    return json.loads((folder / "report.json").read_text(encoding="utf-8"))


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("photos", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--counts", type=int, nargs="*", default=[10, 50, 200], help="numbers of pairs to learn from")
    parser.add_argument("--held-out", type=int, default=20, help="pairs to score on, the last of the session")
    parser.add_argument("--size", type=int, default=160, help="pixels along each side of a measurement")
    parser.add_argument("--method", default="universal", help="reconstructs the captures for the alignment")
    parser.add_argument("--steps", type=int, default=None, help="of the training, instead of the recipe's")
    given = parser.parse_args()
    out, most = given.out, max(given.counts, default=0)
    rig = {**RIG, "height": given.size, "width": given.size}
    options = [word for name, value in rig.items() for word in (f"--rig.{name.replace('_', '-')}", value)]

    camera = out / "camera.toml"
    if not camera.exists():
        short, long = photograph(out / "frames", read_capture_recipe("capture-rig", rig=rig | DARK_ROOM))
        points, darks = (
            [out / "frames" / f"{kind}-{n}-{c}.png" for n in (0, 1) for c in range(FRAMES)]
            for kind in ("point", "dark")
        )
        mwdn(
            "calibrate",
            *points,
            "--exposures",
            short,
            long,
            "--dark",
            *darks,
            "--dark-exposures",
            short,
            long,
            "--bit-depth",
            12,
            "-o",
            camera,
        )

    captured, aligned = out / "captured.h5", out / "aligned.h5"
    mwdn(
        "capture",
        "capture-rig",
        "--pictures.folder",
        given.photos,
        "--pictures.count",
        most + given.held_out,
        *options,
        "-o",
        captured,
    )
    mwdn("align", captured, "--camera", camera, "--method", given.method, "-o", aligned, result=aligned)

    test = part(aligned, range(most, most + given.held_out), out / "test.h5")
    scores = {"0 pairs": score(out, test, camera, "universal", "admm")}
    for count in given.counts:
        pairs = part(aligned, range(count), out / f"train-{count}.h5")
        refined = out / f"camera-{count}.toml"
        mwdn("calibrate", "--camera", camera, "--pairs", pairs, "-o", refined, result=refined)
        scores[f"{count} pairs, camera refined"] = score(out, test, refined, "universal", "admm")
        run = out / f"few-{count}"
        steps = () if given.steps is None else ("--steps", given.steps)
        mwdn(
            "train",
            "few-pairs",
            "--camera",
            camera,
            "--pairs",
            pairs,
            *steps,
            "--out",
            run,
            result=run / "best.safetensors",
        )
        scores[f"{count} pairs, network trained"] = score(out, test, camera, run / "best.safetensors")
    (out / "walk.json").write_text(json.dumps(scores, indent=2), encoding="utf-8")

    capture = out / "capture.png"  # a raw frame of a held-out picture
    with h5py.File(captured) as file:
        write_frame(capture, file["measurement"][most])
    method = () if not given.counts else ("--method", out / f"few-{most}" / "best.safetensors")
    mwdn("reconstruct", capture, "--camera", camera, *method, "-o", out / "pictures")


if __name__ == "__main__":
    main()

"""LenslessPiCam's solvers beside ours on the eight real DiffuserCam pairs: PSNR, SSIM, LPIPS and time.

    python3 -m venv lpc && lpc/bin/pip install torch==2.13.0 numpy==1.26.4 lensless==1.0.8
    python benchmarks/lenslesspicam.py ../shared/data --lensless lpc/bin/python [--methods admm universal ...]

LenslessPiCam runs in a process of its own, because it needs an older numpy. Both packages take the same float32
tensors: the PSF without its background, over its L2 norm, and the capture over its maximum, as LenslessPiCam scales
them. They take turns on each capture with the same number of threads; loading and preparation are not timed. Each
method has the defaults of its package. 270 x 480 pixels, scored as in docs/universal.md: best gain and offset, rows
60:270, columns 60:440.
"""

import argparse
import json
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from statistics import fmean, median

import numpy as np
import torch

METRICS = ("psnr", "ssim", "lpips")
THEIRS = {
    "LenslessPiCam ADMM, 100 iterations": ("ADMM", 100, {}),
    "LenslessPiCam ADMM, 100 iterations, mu 1e-4, tau 2e-3": (
        "ADMM",
        100,
        {"mu1": 1e-4, "mu2": 1e-4, "mu3": 1e-4, "tau": 2e-3},
    ),
    "LenslessPiCam FISTA, 300 iterations": ("FISTA", 300, {}),
}
"""Class, iterations and options. The second has the constants of K. Monakhova et al., 2019, which LenslessPiCam's own
benchmark offers, too."""


def serve(folder):
    """In LenslessPiCam's environment: reconstruct what each line of the input names, and print the seconds."""
    import lensless

    psf = torch.from_numpy(np.load(folder / "psf.npy"))
    solvers = {}
    for line in sys.stdin:
        label, number = json.loads(line)
        name, iterations, options = THEIRS[label]
        if label not in solvers:
            solvers[label] = getattr(lensless, name)(psf, **options)
        solver = solvers[label]
        solver.set_data(torch.from_numpy(np.load(folder / f"{number}.npy")))
        start = time.perf_counter()
        with torch.no_grad():
            picture = solver.apply(n_iter=iterations, disp_iter=None, plot=False)
        seconds = time.perf_counter() - start
        np.save(folder / "picture.npy", picture.numpy())
        print(json.dumps(seconds), flush=True)


class Theirs:
    """LenslessPiCam in its own process."""

    def __init__(self, python, folder, psf):
        self.folder = folder
        np.save(folder / "psf.npy", as_theirs(psf / psf.square().sum().sqrt()))
        command = [str(python), __file__, "--serve", str(folder)]
        self.process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)

    def reconstruct(self, label, number, measurement):
        """Scene (1, C, H, W) and seconds."""
        np.save(self.folder / f"{number}.npy", as_theirs(measurement / measurement.max()))
        self.process.stdin.write(json.dumps([label, number]) + "\n")
        self.process.stdin.flush()
        seconds = json.loads(self.process.stdout.readline())
        picture = torch.from_numpy(np.load(self.folder / "picture.npy"))
        return picture.reshape(picture.shape[-3:]).movedim(-1, 0)[None], seconds


def as_theirs(image):
    """(1, C, H, W) to LenslessPiCam's (depth 1, H, W, C)."""
    return image.movedim(1, -1).contiguous().numpy()


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("data", type=Path, nargs="?")
    parser.add_argument("--lensless", type=Path, help="Python of an environment with LenslessPiCam")
    parser.add_argument("--methods", nargs="*", default=["admm", "pyramid", "universal-small", "universal"])
    parser.add_argument("--first", type=int, default=8)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--out", type=Path, default=Path("benchmarks/results/lenslesspicam.json"))
    parser.add_argument("--serve", type=Path, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    if arguments.serve:
        return serve(arguments.serve)

    from mwdn import Reconstructor, keep_memory
    from mwdn.benchmark.dataset_recipe import PRESETS
    from mwdn.data.importers import read_pairs
    from mwdn.evaluation import Perceptual
    from mwdn.evaluation.metrics import measure
    from mwdn.io.files import write_json

    keep_memory()
    folder = arguments.data / "diffusercam"
    recipe = replace(PRESETS["diffusercam"], psf=str(folder / "psf_recovered_270x480.npy"))
    calibration = recipe.calibration()
    ours = {name: Reconstructor(name, calibration) for name in arguments.methods}
    protocol, perceptual = recipe.binned_protocol(), Perceptual.load()
    rows = {label: {key: [] for key in (*METRICS, "seconds")} for label in (*THEIRS, *ours)}
    with tempfile.TemporaryDirectory() as scratch:
        theirs = Theirs(arguments.lensless, Path(scratch), calibration.psf)
        for number, (_, capture, scene) in enumerate(list(read_pairs("diffusercam", folder))[: arguments.first]):
            measurement, truth = (torch.from_numpy(picture.copy()).movedim(-1, 0)[None] for picture in (capture, scene))
            for label, row in rows.items():
                if label in THEIRS:
                    picture, seconds = theirs.reconstruct(label, number, measurement)
                else:
                    start = time.perf_counter()
                    picture = ours[label](measurement)
                    seconds = time.perf_counter() - start
                found = measure(picture, truth, protocol, variant="best-gain", perceptual=perceptual)
                for metric in METRICS:
                    row[metric].append(round(found[metric].item(), 4))
                row["seconds"].append(round(seconds, 4))
        theirs.process.stdin.close()
        theirs.process.wait()
    write_json(arguments.out, {"threads": arguments.threads, "rows": rows})
    print("| | PSNR / dB | SSIM | LPIPS | s |\n| --- | --- | --- | --- | --- |")
    for label, row in rows.items():
        values = (fmean(row[metric]) for metric in METRICS)
        print("| {} | {:.2f} | {:.3f} | {:.3f} | {:.2f} |".format(label, *values, median(row["seconds"])))
    return None


if __name__ == "__main__":
    main()

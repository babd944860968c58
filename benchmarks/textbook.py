"""ADMM as other packages run it, on pair files: DiffuserCam's constants, 100 iterations, anisotropic total variation.

    python benchmarks/textbook.py exact.h5 mismatched.h5

The files must hold the PSF, as those of `mwdn simulate` do. Scored as in `mwdn evaluate` (full, clipped). Prints means
with 95 % intervals, and writes all numbers of each file as JSON.
"""

import argparse
from pathlib import Path

from mwdn import Calibration, Reconstructor
from mwdn.data.pairs import PairFile
from mwdn.evaluation import First, Protocol, evaluate
from mwdn.solvers import TEXTBOOK, Admm

NAME, SHOWN = "admm, textbook constants", ("psnr", "ssim", "lpips")
METHOD = Admm(1e-4, TEXTBOOK, 100, "anisotropic")


def measure(path, first):
    file = PairFile(path)
    if file.psf is None:
        raise SystemExit(f"`{path}` must hold its PSF. Make it with `mwdn simulate`.")
    reconstruct = Reconstructor(METHOD, Calibration(file.psf))
    pairs = First(file, len(file) if first is None else first)
    return evaluate({NAME: reconstruct}, pairs, Protocol.parse("full"))


def row(report):
    summaries = (report.methods[NAME].summary(metric) for metric in SHOWN)
    return " | ".join("{:.3f} [{:.3f}, {:.3f}]".format(*summary) for summary in summaries)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("pairs", type=Path, nargs="+")
    parser.add_argument("--first", type=int)
    parser.add_argument("--out", type=Path, default=Path("benchmarks/results"))
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    print("| pairs | PSNR / dB | SSIM | LPIPS |\n| --- | --- | --- | --- |")
    for path in arguments.pairs:
        report = measure(path, arguments.first)
        print(f"| {path.stem} | {row(report)} |", flush=True)
        (arguments.out / f"textbook-{path.stem}.json").write_text(report.json() + "\n")


if __name__ == "__main__":
    main()

"""Which part lets a network for any camera learn fast: padding, a bank of estimates, image space. Each is trained anew.

    python benchmarks/parts.py ../shared/data [--steps 200]

One change at a time against five Wiener estimates in image space (lambda 3e-2 to 1e-5, the measurement padded and
tapered) as input of a U-Net. All train on the same samples, each through a random camera, with the same schedule
(the recipe universal without kept samples), and are validated on the same captures through the paper's PSF, which
none has seen. Two at a time, of one thread each.
"""

import argparse
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from multiprocessing import get_context
from pathlib import Path
from tempfile import TemporaryDirectory
from unittest.mock import patch

import torch

from mwdn import Calibration
from mwdn.io.files import write_json
from mwdn.networks import wiener_bank
from mwdn.training.experiment import prepare
from mwdn.training.recipe import read_recipe

BANK = {"name": "wiener-bank", "width": 24, "finest": 0, "regularisations": [3e-2, 3e-3, 3e-4, 5e-5, 1e-5]}
PARTS = {
    "bank in image space, tapered": (BANK, "taper"),
    "not continued: circular": (BANK, "circular"),
    "one estimate, lambda 3e-4": (BANK | {"regularisations": [3e-4]}, "taper"),
    "feature space: MWDN": ({"name": "mwdn", "width": 20}, "taper"),
    "bank behind iterations": (BANK | {"finest": 1, "regularisations": [1e-3, 1e-4, 2e-5]}, "taper"),
}
"""Network options, and the boundary of the bank's filters; MWDN tapers by default."""


def learned(part, data, steps):
    """Validation PSNR of one network by step."""
    torch.set_num_threads(1)
    changes = {"steps": steps, "validate_every": steps // 4, "warmup": 20, "pool": 0, "crop": 0}
    recipe = read_recipe("universal", **changes, cameras={"sizes": ["320x320"]}, placement={"exposure": [0.4, 0.95]})
    network, boundary = PARTS[part]
    recipe = replace(recipe, network=network)
    calibration, psnr = Calibration.from_file(data / "mwdn-camera" / "psf_320.png"), {}

    def note(report):
        if report.validation is not None:
            psnr[report.step] = round(report.validation.psnr, 2)

    with TemporaryDirectory() as folder, patch.object(wiener_bank, "BOUNDARY", boundary):
        trainer = prepare(recipe, calibration, photos=data / "photos" / "train", out=Path(folder) / "run", device="cpu")
        trainer.run(note)
        number = sum(p.numel() for p in trainer.network.parameters() if p.requires_grad)
    return {"learnable": number, "psnr": psnr}


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("data", type=Path)
    parser.add_argument("--steps", type=int, default=200)
    parser.add_argument("--out", type=Path, default=Path("benchmarks/results/parts.json"))
    arguments = parser.parse_args()
    with ProcessPoolExecutor(2, mp_context=get_context("spawn")) as processes:
        work = {part: processes.submit(learned, part, arguments.data, arguments.steps) for part in PARTS}
        parts = {part: each.result() for part, each in work.items()}
    steps = list(next(iter(parts.values()))["psnr"])
    print(f"| validation PSNR / dB after steps | learnable | {' | '.join(map(str, steps))} |")
    print("| --- " * (2 + len(steps)) + "|")
    for part, each in parts.items():
        print(f"| {part} | {each['learnable']:,} | {' | '.join(f'{psnr:.2f}' for psnr in each['psnr'].values())} |")
    write_json(arguments.out, {"steps": arguments.steps, "torch": torch.__version__, "parts": parts})


if __name__ == "__main__":
    main()

"""What limits reconstructions of the real DiffuserCam pairs: each cause removed with the help of the ground truth.

    python benchmarks/limits.py ../shared/data

Everything is linear light at 270 x 480. Correlations are of detail in green: the picture minus a blur over 21 pixels.
"""

import argparse
import tempfile
from pathlib import Path

import torch
from torch import Tensor
from torch.nn import functional as F

from mwdn import Calibration, convolve, correlate
from mwdn.data.importers import import_pairs
from mwdn.data.pairs import PairFile
from mwdn.evaluation.metrics import Protocol, best_gain, psnr
from mwdn.networks.block_means import block_means
from mwdn.solvers import Pyramid, align

PART = Protocol.parse("60:270,60:440")


def blurred(pictures: Tensor, width: int) -> Tensor:
    return F.avg_pool2d(F.pad(pictures, (width // 2,) * 4, mode="reflect"), width, 1)


def correlation(a: Tensor, b: Tensor) -> float:
    detail = [(x - blurred(x, 21)).flatten() for x in (a, b)]
    return float(torch.corrcoef(torch.stack(detail))[0, 1])


def score(results: Tensor, truths: Tensor) -> float:
    results, truths = PART.crop(results), PART.crop(truths)
    return float(psnr(best_gain(results, truths).clamp(0, 1), truths).mean())


def with_true_mean_light(results: Tensor, truths: Tensor, block: int) -> float:
    """The score with the true mean light of blocks."""
    results, truths = PART.crop(results), PART.crop(truths)
    results = best_gain(results, truths)
    return float(psnr((results + block_means(truths - results, block)).clamp(0, 1), truths).mean())


def refitted(psf: Tensor, scenes: Tensor, measurements: Tensor, weight: float, steps: int = 40) -> Tensor:
    """Fit the PSF to these measurements by conjugate gradients, with ``weight`` on the change."""
    gains = torch.stack([m.std() for m in measurements])[:, None, None, None]
    scenes, measurements = scenes / gains, measurements / gains

    def normal(change: Tensor) -> Tensor:
        return correlate(convolve(scenes, change), scenes).sum(0, keepdim=True)

    slope = correlate(measurements - convolve(scenes, psf), scenes).sum(0, keepdim=True)
    probe = torch.randn_like(slope)
    for _ in range(5):
        probe = normal(probe / probe.norm())
    weight, change, rest, along = weight * float(probe.norm()), torch.zeros_like(psf), slope.clone(), slope.clone()
    for _ in range(steps):
        image = normal(along) + weight * along
        length = rest.square().sum() / (along * image).sum()
        change, old, rest = change + length * along, rest.square().sum(), rest - length * image
        along = rest + rest.square().sum() / old * along
    return psf + change


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("data", type=Path)
    folder = parser.parse_args().data / "diffusercam"
    calibration = Calibration.from_file(
        folder / "psf_recovered_270x480.npy", background=0.0, upside_down=True, bgr=True
    )
    psf = calibration.psf / calibration.psf.sum((-2, -1), keepdim=True)
    with tempfile.TemporaryDirectory() as scratch:
        import_pairs("diffusercam", folder, Path(scratch) / "pairs.h5")
        pairs = [PairFile(Path(scratch) / "pairs.h5")[n] for n in range(8)]
    measurements, scenes = (torch.stack(each) for each in zip(*pairs, strict=True))

    print("Correlation of the measurements' detail with that of the true scenes through the PSF")
    green = slice(1, 2)
    for tone in (0.5, 1.0, 1.5, 2.2):
        pairs_of_detail = zip(convolve(scenes[:, green] ** tone, psf[:, green]), measurements[:, green], strict=True)
        print(f"  scenes to the power {tone}: " + " ".join(f"{correlation(*each):.2f}" for each in pairs_of_detail))
    for held in (0, 3, 6):
        others = [n for n in range(8) if n != held]
        fit = refitted(psf[:, green], scenes[others][:, green], measurements[others][:, green], weight=1e-3)
        before, after = (
            correlation(convolve(scenes[held : held + 1, green], each)[0], measurements[held, green])
            for each in (psf[:, green], fit)
        )
        print(f"  pair {held}, PSF fitted anew to the other seven: {before:.2f} before, {after:.2f} after")

    each_colour = [x.flatten(0, 1)[:, None] for x in (convolve(scenes, psf), measurements)]
    predicted = best_gain(*each_colour).view_as(measurements)
    unexplained = blurred(measurements - predicted, 25)
    parts = unexplained.std((1, 2, 3)) / measurements.mean((1, 2, 3))
    print(f"Smooth light that nothing explains: {100 * parts.min():.0f} to {100 * parts.max():.0f} % of the mean")

    poses = [align(each[None], psf).move(psf) for each in measurements]

    def by_pyramid(given: Tensor) -> Tensor:
        return torch.cat([Pyramid()(each[None], pose) for each, pose in zip(given, poses, strict=True)])

    results = by_pyramid(measurements)
    print(f"Pyramid, PSF aligned: {score(results, scenes):.2f} dB")
    shares = unexplained / measurements.mean((1, 2, 3), keepdim=True)
    common = torch.stack([shares[[n for n in range(8) if n != m]].mean(0) for m in range(8)])
    without = measurements - common * measurements.mean((1, 2, 3), keepdim=True)
    print(f"  without what the others share of that light: {score(by_pyramid(without.clamp(min=0)), scenes):.2f} dB")
    print(f"  without their own: {score(by_pyramid((measurements - unexplained).clamp(min=0)), scenes):.2f} dB")
    for block in (64, 32, 16):
        reached = with_true_mean_light(results, scenes, block)
        print(f"  with the true mean light of blocks of {block} pixels: {reached:.2f} dB")


if __name__ == "__main__":
    with torch.inference_mode():
        main()

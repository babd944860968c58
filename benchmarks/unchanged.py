"""Record the outputs of every method on fixed inputs, and compare two recordings: does a refactoring change results?

    python benchmarks/unchanged.py record before.npz [--data ../shared/data] [--only solvers networks]
    python benchmarks/unchanged.py compare before.npz after.npz

Recorded: convolution and Wiener filter, every solver, the bundled networks, and every network with random weights
(output and gradient; through `Reconstructor` in both precisions), on captures simulated through one random camera.
With `--data` also real captures. One thread, CPU: on one machine the same code gives the same bits.

`compare` prints each output that differs and exits with 1 if one differs by more than 1e-6 of its largest value, has
another shape, or is missing. The script uses public names only, so it also records another commit:

    git worktree add ../before main
    PYTHONPATH=../before/src python benchmarks/unchanged.py record before.npz
"""

import argparse
import warnings
from pathlib import Path

import numpy as np
import torch
from torch.nn import functional as F

from mwdn import Calibration, Reconstructor, build, convolve, correlate, read_frame, wiener
from mwdn.networks import NETWORKS
from mwdn.optics import sample_camera
from mwdn.solvers import SOLVERS

BUNDLED = ("universal", "universal-small")
PRECISIONS = ("fast", "exact")
SIZES = ((80, 80), (90, 121))
OPTIONS = {"wiener": {}, "le-admm": {}, "updn": {}, "ifin": {"width": 16}}
"""Options of networks that the common `{"width": 8}` does not suit."""
TOLERANCE = 1e-6


def seeded(number):
    return torch.Generator().manual_seed(number)


def simulated(size):
    """A calibration, and a batch of two noisy captures of smooth random scenes."""
    psf = sample_camera(seeded(0), size, family="contours")
    coarse = torch.rand(2, 3, *(side // 8 + 1 for side in size), generator=seeded(1))
    scenes = F.interpolate(coarse, size, mode="bicubic").clamp(0, 1)
    noise = 0.003 * torch.randn(scenes.shape, generator=seeded(2))
    return Calibration(psf), (convolve(scenes, psf) + noise).clamp(0, 1)


def fourier():
    for size in SIZES:
        calibration, measurement = simulated(size)
        yield f"inputs/psf {size}", calibration.psf
        yield f"inputs/measurement {size}", measurement
        for circular in (False, True):
            yield f"convolve {size}, circular {circular}", convolve(measurement, calibration.psf, circular=circular)
            yield f"correlate {size}, circular {circular}", correlate(measurement, calibration.psf, circular=circular)
        for boundary in ("circular", "zero", "replicate", "taper"):
            yield f"wiener {size}, {boundary}", wiener(measurement, calibration.psf, 1e-3, boundary=boundary)


def solvers():
    for size in SIZES:
        calibration, measurement = simulated(size)
        for name in SOLVERS:
            yield f"{name} {size}", Reconstructor(name, calibration, device="cpu")(measurement)
    for name in ("admm", "wiener"):
        reconstruct = Reconstructor(name, calibration, regularisation=1e-3, device="cpu")
        yield f"{name}, regularisation 1e-3", reconstruct(measurement)


def bundled():
    for size in SIZES:
        calibration, measurement = simulated(size)
        for name in BUNDLED:
            for precision in PRECISIONS:
                reconstruct = Reconstructor(name, calibration, precision=precision, device="cpu")
                yield f"{name} {size}, {precision}", reconstruct(measurement)


def networks():
    calibration, measurement = simulated(SIZES[0])
    for name in NETWORKS:
        torch.manual_seed(0)
        network = build(name, **OPTIONS.get(name, {"width": 8})).train()
        with torch.no_grad():
            network(measurement, calibration.psf)  # gives BatchNorm its statistics
            network.eval()
            yield f"{name}, random weights", network(measurement, calibration.psf)
        for precision in PRECISIONS:
            reconstruct = Reconstructor(network, calibration, precision=precision, device="cpu")
            yield f"{name}, random weights, {precision}", reconstruct(measurement)
        network.train()
        (network(measurement, calibration.psf) - 0.3).square().mean().backward()
        gradients = [weight.grad.flatten() for weight in network.parameters() if weight.grad is not None]
        yield f"{name}, gradient", torch.cat(gradients)


def real(data):
    """Two objects of the paper's camera, one capture of DiffuserCam's."""
    camera, diffusercam = data / "mwdn-camera", data / "diffusercam"
    calibration = Calibration.from_file(camera / "psf_320.png")
    frames = [read_frame(camera / "real-objects" / f"object_{number}.png") for number in (0, 3)]
    for name in (*SOLVERS, *BUNDLED):
        reconstruct = Reconstructor(name, calibration, device="cpu")
        yield f"real objects, {name}", torch.cat([reconstruct(calibration.correct(frame)) for frame in frames])
        yield f"stream of real objects, {name}", torch.cat([scene for _, scene in reconstruct.stream(frames)])
    stored = {"upside_down": True, "bgr": True}
    calibration = Calibration.from_file(diffusercam / "psf_recovered_270x480.npy", background=0.0, **stored)
    measurement = calibration.correct(read_frame(diffusercam / "diffuser_images" / "im10.npy", bgr=True))
    for name in BUNDLED:
        yield f"DiffuserCam, {name}", Reconstructor(name, calibration, device="cpu")(measurement)


SECTIONS = {"fourier": fourier, "solvers": solvers, "bundled": bundled, "networks": networks}


def record(path, data, only):
    torch.set_num_threads(1)
    warnings.simplefilter("ignore")  # of PSFs that a network was not trained for, and the like
    sections = {name: section for name, section in SECTIONS.items() if name in only}
    if data is not None:
        sections["real"] = lambda: real(data)
    outputs = {}
    for name, section in sections.items():
        for label, output in section():
            outputs[f"{name}: {label}"] = output.detach().float().numpy()
            print(f"{name}: {label}", flush=True)
    np.savez_compressed(path, **outputs)
    print(f"{len(outputs)} outputs in {path}")


def difference(one, other):
    """Largest difference relative to the largest value; infinite for another shape."""
    if one.shape != other.shape:
        return np.inf
    if np.array_equal(one, other, equal_nan=True):
        return 0.0
    largest = np.abs(one - other).max() / max(np.abs(one).max(), 1e-30)
    return largest if np.isfinite(largest) else np.inf


def compare(before, after):
    """Print what differs; true if all agree within the tolerance."""
    one, other = np.load(before), np.load(after)
    missing = [name for name in one.files if name not in other.files]
    differences = {name: difference(one[name], other[name]) for name in one.files if name in other.files}
    for name, value in differences.items():
        if value > 0:
            print(f"{value:8.1e}  {name}{'  <-- CHANGED' if value > TOLERANCE else ''}")
    for name in missing:
        print(f" missing  {name}")
    for name in other.files:
        if name not in one.files:
            print(f"     new  {name}")
    changed = sum(value > TOLERANCE for value in differences.values())
    equal = sum(value == 0 for value in differences.values())
    print(f"{len(one.files)} outputs: {equal} equal to the bit, {changed} changed, {len(missing)} missing")
    return changed == 0 and not missing


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="command", required=True)
    recording = commands.add_parser("record", help="write the outputs of this code")
    recording.add_argument("file", type=Path)
    recording.add_argument("--data", type=Path, help="folder of real captures")
    recording.add_argument("--only", nargs="+", choices=SECTIONS, default=list(SECTIONS))
    comparison = commands.add_parser("compare", help="compare two recordings")
    comparison.add_argument("before", type=Path)
    comparison.add_argument("after", type=Path)
    arguments = parser.parse_args()
    if arguments.command == "record":
        record(arguments.file, arguments.data, arguments.only)
    elif not compare(arguments.before, arguments.after):
        raise SystemExit(1)


if __name__ == "__main__":
    main()

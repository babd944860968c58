"""ADMM, 100 iterations, two threads: this package against a textbook loop in numpy and scipy.

    python benchmarks/admm.py [--size 270x480] [--repeats 3]

Both take turns in one process, on the same problem with the same constants, and must agree. The textbook version keeps
every copy and multiplier on the padded grid and computes six transforms per iteration, as the equations are written, in
numpy's default float64; a second one uses float32. `universal-small`, prepared for the camera, takes turns too.
Anything that takes less than a second is repeated for a second; the shortest time of each counts.
"""

import argparse
import json
import time
from pathlib import Path

import numpy as np
import scipy.fft
import torch

from mwdn import Calibration, Reconstructor, keep_memory
from mwdn.optics import sample_camera
from mwdn.solvers import TEXTBOOK, Admm, Pyramid

ITERATIONS = 100
AGREE = 1e-3
"""Largest difference over the peak."""


def textbook(b, h, dtype, tau=1e-4):
    """The equations of DiffuserCam's ADMM as written."""
    mu1, mu2, mu3 = (dtype(mu) for mu in TEXTBOOK)
    tau, b, h = dtype(tau), b.astype(dtype), h.astype(dtype)
    height, width = b.shape[-2:]
    grid = 2 * height, 2 * width
    top, left = grid[0] // 2 - height // 2, grid[1] // 2 - width // 2
    inside = (slice(None), slice(top, top + height), slice(left, left + width))
    fft = lambda z: scipy.fft.rfft2(z, workers=2)  # noqa: E731
    ifft = lambda z: scipy.fft.irfft2(z, s=grid, workers=2)  # noqa: E731
    padded, data, sensor = (np.zeros((3, *grid), dtype) for _ in range(3))
    padded[inside], data[inside], sensor[inside] = h, b, 1
    H = fft(np.fft.ifftshift(padded, axes=(-2, -1)))
    delta = np.zeros((2, *grid), dtype)
    delta[:, 0, 0] = -1
    delta[0, -1, 0] = delta[1, 0, -1] = 1
    psi2 = (abs(fft(delta)) ** 2).sum(0)
    denominator = mu1 * abs(H) ** 2 + mu2 * psi2 + mu3
    v, xi, rho = (np.zeros((3, *grid), dtype) for _ in range(3))
    eta = np.zeros((2, 3, *grid), dtype)
    psi = lambda z: np.stack([np.roll(z, -1, -2) - z, np.roll(z, -1, -1) - z])  # noqa: E731
    psi_t = lambda z: np.roll(z[0], 1, -2) - z[0] + np.roll(z[1], 1, -1) - z[1]  # noqa: E731
    for _ in range(ITERATIONS):
        g = psi(v) + eta / mu2
        u = np.sign(g) * np.maximum(abs(g) - tau / mu2, 0)
        x = (xi + mu1 * ifft(H * fft(v)) + data) / (sensor + mu1)
        w = np.maximum(rho / mu3 + v, 0)
        right = mu3 * w - rho + psi_t(mu2 * u - eta) + ifft(H.conj() * fft(mu1 * x - xi))
        v = ifft(fft(right) / denominator)
        xi = xi + mu1 * (ifft(H * fft(v)) - x)
        eta = eta + mu2 * (psi(v) - u)
        rho = rho + mu3 * (v - w)
    return np.maximum(v[inside], 0)


def seconds_of(run):
    """The shortest time of repeated calls, for a second and at least once, and the result."""
    times = []
    while sum(times) < 1:
        start = time.perf_counter()
        result = run()
        times.append(time.perf_counter() - start)
    return min(times), result


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--size", default="270x480")
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--out", type=Path, default=Path("benchmarks/results/admm.json"))
    arguments = parser.parse_args()
    size = tuple(map(int, arguments.size.split("x")))
    torch.set_num_threads(2)
    keep_memory()
    generator = torch.Generator().manual_seed(0)
    h = sample_camera(generator, size, family="contours")
    b = torch.rand(1, 3, *size, generator=generator)
    h, b = h / h.norm(), b / b.norm()
    small = Reconstructor("universal-small", Calibration(h / h.sum((-2, -1), keepdim=True)))
    solver = Admm(1e-4, TEXTBOOK, ITERATIONS, "anisotropic")
    contenders = {
        "textbook (numpy, scipy)": lambda: textbook(b[0].numpy(), h[0].numpy(), np.float64),
        "textbook, float32": lambda: textbook(b[0].numpy(), h[0].numpy(), np.float32),
        "mwdn, same constants": lambda: solver(b, h)[0].numpy(),
        "mwdn, defaults": lambda: Admm(iterations=ITERATIONS)(b, h)[0].numpy(),
        "mwdn, pyramid": lambda: Pyramid()(b, h)[0].numpy(),
        "mwdn, universal-small": lambda: small(b)[0].numpy(),
    }
    seconds, results = {name: [] for name in contenders}, {}
    for _ in range(arguments.repeats):
        for name, run in contenders.items():
            spent, results[name] = seconds_of(run)
            seconds[name].append(spent)
    # Ours is the scene for a PSF of unit sum.
    plain = results["textbook (numpy, scipy)"] * h[0].sum((-2, -1), keepdim=True).numpy()
    difference = float(abs(plain - results["mwdn, same constants"]).max() / abs(plain).max())
    if difference > AGREE:
        raise SystemExit(f"Textbook and mwdn differ by {difference:.1e} of the peak.")
    shortest = {name: min(times) for name, times in seconds.items()}
    base = shortest["textbook (numpy, scipy)"]
    for name, time_of in shortest.items():
        print(f"{name:26s} {time_of:7.3f} s   {base / time_of:5.1f} x")
    print(f"largest difference of textbook and mwdn, same constants: {difference:.1e} of the peak")
    record = {
        "size": size,
        "iterations": ITERATIONS,
        "threads": torch.get_num_threads(),
        "torch": torch.__version__,
        "shortest_s": shortest,
        "ratio": {name: base / time_of for name, time_of in shortest.items()},
        "difference": difference,
    }
    arguments.out.parent.mkdir(parents=True, exist_ok=True)
    arguments.out.write_text(json.dumps(record, indent=2) + "\n")


if __name__ == "__main__":
    main()

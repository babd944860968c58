"""The denoiser of plug and play, trained through all its rounds at once: the error of the last scene is the loss.

    python benchmarks/unrolled.py ../shared/data --start runs/rounds/denoiser-600-1200.pt --share 0.3 \
        [--steps 320] [--stop 120] [--out runs/unrolled/denoiser.pt]

Captures through random cameras of 160 to 240 pixels (those of `benchmarks/rounds.py`: recipe `universal-exact`, 60 % as
calibrated) are reconstructed by `universal` with the denoiser that learns; gradients flow back through its twelve
rounds, whose activations are computed again. The start is the bundled denoiser mixed with this share of other weights.
The learning rate falls as for `--steps`; `--stop` ends before. It resumes. Five to ten seconds a step of two captures.

`python benchmarks/rounds.py ../shared/data --learned OUT --shares 0.4` measures a mixture of the result.
"""

import argparse
import copy
import math
from pathlib import Path

import torch
from torch.utils.checkpoint import checkpoint

import mwdn
from mwdn.evaluation.distances import log_mse
from mwdn.io.files import atomic
from mwdn.solvers.plug_and_play import plug_and_play
from mwdn.training.network import update_average
from rounds import training_pairs

SIZES = ("192x192", "176x224", "192x192", "224x160", "240x240")
FIRST = 100_000
"""Number of the first capture: none of those that `benchmarks/rounds.py` harvests."""
BATCH, RATE = 2, 8e-5


def unrolled_loss(network, measurement, scene, psf):
    """Logarithm of the mean square error of each capture's scene after plug and play."""
    with torch.no_grad():
        start = network.iterate(measurement, network.prepare(psf, measurement.shape[-2:]))
    estimate = plug_and_play(
        start, lambda *inputs: checkpoint(network.denoiser, *inputs, use_reentrant=False), network.rounds
    )
    return log_mse(estimate.scene, scene)


def learn(network, average, pairs, out, steps, stop):
    """Train the network's denoiser; ``out`` gets the moving average of its weights."""
    denoiser = network.denoiser.requires_grad_(True)
    optimiser = torch.optim.Adam(denoiser.parameters(), betas=(0.9, 0.99))
    state, first = out.with_suffix(".state.pt"), 0
    if state.exists():
        first, *states = torch.load(state)
        for each, kept in zip((denoiser, average, optimiser), states, strict=True):
            each.load_state_dict(kept)
    for step in range(first, stop):
        for group in optimiser.param_groups:
            group["lr"] = RATE * min(1, (step + 1) / 20) * (0.5 + 0.5 * math.cos(math.pi * step / steps))
        numbers = range(FIRST + BATCH * step, FIRST + BATCH * (step + 1))
        loss = unrolled_loss(network, *pairs.batch(list(numbers))).mean()
        optimiser.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(denoiser.parameters(), 1.0)
        optimiser.step()
        update_average(average, denoiser, decay=min(0.98, (step + 1) / (step + 10)))
        print(f"step {step + 1}: {10 * float(loss.detach()):.2f} dB", flush=True)
        if (step + 1) % 20 == 0 or step + 1 == stop:
            with atomic(state) as temporary:
                torch.save((step + 1, denoiser.state_dict(), average.state_dict(), optimiser.state_dict()), temporary)
            with atomic(out) as temporary:
                torch.save(average.state_dict(), temporary)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("data", type=Path)
    parser.add_argument("--start", type=Path, help="weights of a denoiser to mix with the bundled ones")
    parser.add_argument("--share", type=float, default=0.3, help="of --start")
    parser.add_argument("--steps", type=int, default=320)
    parser.add_argument("--stop", type=int, default=120)
    parser.add_argument("--out", type=Path, default=Path("runs/unrolled/denoiser.pt"))
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    mwdn.keep_memory()
    network = mwdn.load_network("universal").float().eval()
    if arguments.start:
        other = torch.load(arguments.start)
        mixed = {name: own.lerp(other[name], arguments.share) for name, own in network.denoiser.state_dict().items()}
        network.denoiser.load_state_dict(mixed)
    arguments.out.parent.mkdir(parents=True, exist_ok=True)
    average = copy.deepcopy(network.denoiser).requires_grad_(False)
    pairs = training_pairs(arguments.data, SIZES)
    learn(network, average, pairs, arguments.out, arguments.steps, arguments.stop)


if __name__ == "__main__":
    main()

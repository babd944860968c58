"""A bundled network trained as a whole: its denoiser through all rounds of plug and play, and the U-Net behind it.

    python benchmarks/unrolled.py ../shared/data [--network universal-small] [--steps 4000] [--pixels 600000]
        [--device cuda] [--workers 12] [--start CHECKPOINT] [--seconds 480] [--out runs/unrolled/universal.safetensors]

Each batch has captures through random cameras of three kinds (`SHARES`): nearly as calibrated, as real ones are, and
scenes that fill the frame. Half of the batches are dim (`DIM`). The network reconstructs them; the gradient of both
errors, after plug and play and after the U-Net, flows back through the twelve rounds. `universal-small` has no rounds,
so only its U-Net learns. The loss is that of the network's recipe. The learning rate falls to nearly zero at `--steps`
or `--seconds`. The file gets the moving average of the weights. `--pixels` is the size of a batch: a step of 600,000
takes 0.13 s on an H200, one of 75,000 10 s on a core of a CPU.
"""

import argparse
import copy
import math
import time
from dataclasses import asdict, replace
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional as F
from torch.utils.checkpoint import checkpoint
from torch.utils.data import DataLoader, Dataset

import mwdn
from mwdn.data.cameras import CameraPairs, Cameras
from mwdn.data.photographs import Photographs
from mwdn.data.recorded import HELD_OUT
from mwdn.data.simulated import SimulatedPairs
from mwdn.evaluation.distances import log_mse
from mwdn.networks import build
from mwdn.networks.block_means import block_means
from mwdn.optics.warp import hazed
from mwdn.training.losses import Loss
from mwdn.training.recipe import read_recipe
from mwdn.weights.bundled import find_weights
from mwdn.weights.checkpoint import read_metadata, save_network
from mwdn.weights.growth import grown

SIZES = ((192, 192), (256, 256), (176, 224), (240, 320), (320, 320), (270, 480))
SHARES = {"calibrated": 0.4, "real": 0.35, "filling": 0.25}
"""Of each kind in a batch; rounded, so a third of each in a batch of three."""
DIM = (0.04, 0.3)
"""Peak light of the scenes in every other batch of a size, over full scale: 600 to 4,500 electrons."""
TOO_MUCH_HAZE = 0.4, 0.03
"""Part of the calibrated and filling captures whose PSF has haze that the camera has not, and the most of it:
`mwdn.solvers.align` finds up to 0.025 where there is none."""
RATES = {"denoiser": 2e-4, "unet": 4e-4}
COARSE = {"calibrated": 1.0, "real": 0.3, "filling": 1.0}
"""Weight of the error's mean light after plug and play: what real cameras take away, no denoiser can know."""


RECIPES = {"universal": "universal-exact", "universal-small": "universal-small"}
"""Of each network: loss, placement and mild mismatch."""


def recipes(network):
    """Placement and mismatch of each kind: what correction and, for `universal`, alignment of a capture leave."""
    mild, real = read_recipe(RECIPES[network]), read_recipe("real-like")
    left = replace(real.mismatch, hot_pixels=0.0, grain=0.1, exact=0.0)
    if network == "universal":
        left = replace(left, turn_degrees=0.06, scale=0.002, envelope_shift=0.008, haze=0.05, room_light=0.05)
    fitted = replace(mild.mismatch, exact=0.6)
    return {
        "calibrated": (replace(mild.placement, exposure=(0.04, 1.0)), fitted),
        "real": (replace(mild.placement, exposure=(0.04, 1.2)), left),
        "filling": (replace(mild.placement, exposure=(0.04, 1.0), extent=(1.0, 2.1), offset=0.3), fitted),
    }


def numbers(count, parts):
    """Number of captures of each kind in a batch, the kinds having these shares."""
    first, second, _ = (round(count * share) for share in parts)
    return dict(zip(SHARES, (first, second, count - first - second), strict=True))


class Mixed(NamedTuple):
    """A `Batch` of all kinds, with the weight of each capture in `COARSE`."""

    measurement: Tensor
    scene: Tensor
    psf: Tensor
    coarse: Tensor


class Captures(Dataset):
    """Batches of captures, each of one size."""

    def __init__(self, photographs, arguments):
        self.photographs, self.recipes, self.shares = photographs, recipes(arguments.network), arguments.shares
        self.pixels, self.first, self.steps = arguments.pixels, arguments.first, arguments.steps
        self.sensor = read_recipe("universal-exact").sensor

    def __len__(self):
        return self.steps

    def __getitem__(self, number):
        size = SIZES[number % len(SIZES)]
        count = max(3, self.pixels // (size[0] * size[1]))
        parts, wanted = [], numbers(count, self.shares)
        is_dim = number // len(SIZES) % 2 == 1
        for seed, (kind, (placement, mismatch)) in enumerate(self.recipes.items()):
            placement = replace(placement, exposure=DIM) if is_dim else placement
            size_only = torch.full((1, 3, *size), 1.0)
            pairs = SimulatedPairs(self.photographs, size_only, placement, mismatch, self.sensor, seed=51 + seed)
            cameras = CameraPairs(pairs, Cameras((f"{size[0]}x{size[1]}",)), count)
            start = 100 * (self.first + number)
            if wanted[kind]:
                batch = cameras.batch(range(start, start + wanted[kind]))
                parts.append(batch if kind == "real" else too_hazy(batch, start + seed))
        coarse = torch.cat([torch.full((each, 1, 1, 1), COARSE[kind]) for kind, each in wanted.items()])
        return Mixed(*(torch.cat(each) for each in zip(*parts, strict=True)), coarse)


def too_hazy(batch, seed):
    """The batch, some of whose PSFs are given haze that its cameras have not: `TOO_MUCH_HAZE`."""
    some, most = TOO_MUCH_HAZE
    chosen, amount = torch.rand(2, len(batch.psf), 1, 1, 1, generator=torch.Generator().manual_seed(seed))
    return batch._replace(psf=hazed(batch.psf, most * amount * (chosen < some)))


def losses(network, loss, batch, recompute):
    """The loss, and its parts: mean logarithm of the square error after plug and play, and the `Loss` after the U-Net.

    The error's mean light after plug and play has the weights ``batch.coarse``.
    """
    with torch.no_grad():
        prepared = network.prepare(batch.psf, batch.measurement.shape[-2:])
        start = network.iterate(batch.measurement, prepared)
    refined = start.scene.new_zeros(())
    if network.rounds and network.denoiser.training:
        estimate = checkpoint(network.refined, start, use_reentrant=False) if recompute else network.refined(start)
        error = estimate.scene - batch.scene
        error = error - (1 - batch.coarse) * block_means(error, network.block)
        refined = log_mse(error, torch.zeros_like(error)).mean()
    else:
        with torch.no_grad():
            estimate = network.refined(start)
    estimates = network.filtered(estimate, prepared)
    border = network.block if network.rounds else 0  # as `WienerBank.correct` does in evaluation mode
    wide = F.pad(estimates, (border,) * 4, mode="reflect")
    height, width = batch.scene.shape[-2:]
    result = network.correct(wide, network.unit(estimates))[..., border : border + height, border : border + width]
    total, parts = loss(result, batch.scene)
    return refined + total, [refined.detach(), *parts.values()]


class Step:
    """One step of the optimiser for batches of one size. On a GPU it is recorded as a CUDA graph at its third call.

    A step is 16,000 operations, which take Python longer than the GPU.
    """

    WARM = 2

    def __init__(self, network, loss, average, optimiser, sums, decay, pool):
        self.network, self.loss, self.optimiser = network, loss, optimiser
        self.sums, self.decay, self.pool = sums, decay, pool
        pairs = list(zip(network.state_dict().values(), average.state_dict().values(), strict=True))
        self.values, self.means = ([pair[side] for pair in pairs if pair[0].is_floating_point()] for side in (0, 1))
        self.calls, self.graph, self.batch = 0, None, None

    def __call__(self, batch):
        device, self.calls = self.sums.device, self.calls + 1
        if self.batch is None:
            self.batch = Mixed(*(torch.empty_like(part, device=device) for part in batch))
        for mine, given in zip(self.batch, batch, strict=True):
            mine.copy_(given)
        if self.graph is not None:
            self.graph.replay()
        elif device.type == "cpu" or self.calls <= self.WARM or self.pool is None:
            self.run()
        else:
            self.graph = torch.cuda.CUDAGraph()
            stream = torch.cuda.current_stream()
            with torch.cuda.graph(self.graph, pool=self.pool, stream=stream, capture_error_mode="thread_local"):
                self.run()
            self.graph.replay()

    def run(self):
        recompute = self.sums.device.type == "cpu"
        total, parts = losses(self.network, self.loss, self.batch, recompute)
        self.optimiser.zero_grad(set_to_none=True)
        total.backward()
        for group in self.optimiser.param_groups:
            torch.nn.utils.clip_grad_norm_(group["params"], 1.0)
        self.optimiser.step()
        with torch.no_grad():
            change = torch._foreach_sub(self.values, self.means)
            torch._foreach_mul_(change, self.decay)
            torch._foreach_add_(self.means, change)
            self.sums += torch.stack(parts)


def make_network(name, start):
    """A bundled network with evidence and a gate for its mean light, from these weights."""
    options = read_metadata(find_weights(name))["options"] | {"evidence": True, "mean_light": "gated"}
    network = build("wiener-bank", **options)
    network.load_state_dict(grown(mwdn.load_network(start).float().state_dict(), network))
    return network.requires_grad_(True), options


def described(arguments):
    """What the weights were trained on and how, for their file."""
    kinds = recipes(arguments.network).items()
    kinds = {
        kind: {"share": share, "placement": asdict(placement), "mismatch": asdict(mismatch)}
        for share, (kind, (placement, mismatch)) in zip(arguments.shares, kinds, strict=True)
    }
    sizes = [f"{height}x{width}" for height, width in SIZES]
    schedule = {key: getattr(arguments, key) for key in ("start", "pixels", "rate", "ema")}
    schedule |= {"rates": RATES, "dim": DIM, "too_much_haze": TOO_MUCH_HAZE}
    loss = read_recipe(RECIPES[arguments.network]).loss
    return {"cameras": {"sizes": sizes}, "kinds": kinds, "loss": loss, "schedule": schedule}


def learn(network, loss, average, batches, arguments, save):
    """Train; the average of the weights is saved every minute and at the end."""
    device = torch.device(arguments.device)
    is_gpu = device.type == "cuda"
    if is_gpu:
        torch.cuda.set_stream(torch.cuda.Stream())  # the default one cannot be recorded
    unet = [value for name, value in network.named_parameters() if not name.startswith("denoiser.")]
    groups = {"unet": unet}
    if network.rounds and not arguments.only_unet:
        groups["denoiser"] = list(network.denoiser.parameters())
    rates = {name: torch.zeros((), device=device) if is_gpu else 0.0 for name in groups}
    optimiser = torch.optim.Adam(
        [{"params": each, "name": name, "lr": rates[name]} for name, each in groups.items()],
        betas=(0.9, 0.99),
        capturable=is_gpu,
    )
    sums, decay = torch.zeros(1 + len(loss.weights), device=device), torch.zeros((), device=device)
    pool = torch.cuda.graph_pool_handle() if is_gpu and not arguments.eager else None
    network.train()
    if arguments.keep_statistics:
        for module in network.modules():
            module.train(not isinstance(module, nn.BatchNorm2d))
    if network.rounds and arguments.only_unet:
        network.denoiser.requires_grad_(False).eval()
    steps, began, saved = {}, time.monotonic(), 0.0
    for step, batch in enumerate(batches, 1):
        now = time.monotonic() - began
        done = min(1.0, max((step - 1) / arguments.steps, now / arguments.seconds if arguments.seconds else 0.0))
        factor = arguments.rate * min(1, step / 100) * (0.51 + 0.49 * math.cos(math.pi * done))
        for group in optimiser.param_groups:
            rate = factor * RATES[group["name"]]
            group["lr"] = group["lr"].fill_(rate) if is_gpu else rate
        decay.fill_(1 - min(arguments.ema, step / (step + 9)))
        size = batch.scene.shape[-2:]
        if size not in steps:
            steps[size] = Step(network, loss, average, optimiser, sums, decay, pool)
        try:
            steps[size](batch)
        except RuntimeError as error:
            if steps[size].graph is None:
                raise
            print(f"no graph: {error}", flush=True)
            pool = None
            steps.clear()
            torch.cuda.synchronize()
        if step % arguments.every == 0 or step in (1, 3, 10, 20):
            print(f"step {step}: {now:.1f} s, " + ", ".join(f"{value:.4f}" for value in sums.tolist()), flush=True)
        if step % arguments.every == 0:
            sums.zero_()
            if now - saved > 60:
                save(step)
                saved = now
        if done == 1:
            break
    save(step)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("data", type=Path)
    parser.add_argument("--network", choices=RECIPES, default="universal")
    parser.add_argument("--start", help="checkpoint, or the bundled network")
    parser.add_argument("--steps", type=int, default=4000)
    parser.add_argument("--pixels", type=int, default=600_000, help="of a batch")
    parser.add_argument("--first", type=int, default=0, help="number of the first batch, for a run that goes on")
    parser.add_argument("--rate", type=float, default=1.0, help="factor of the learning rates")
    parser.add_argument("--ema", type=float, default=0.998)
    parser.add_argument("--every", type=int, default=50, help="steps between lines")
    parser.add_argument("--seconds", type=float, default=0.0)
    parser.add_argument("--shares", type=float, nargs=3, default=list(SHARES.values()), help=f"of {', '.join(SHARES)}")
    parser.add_argument("--only-unet", action="store_true", help="the denoiser stays as it is")
    parser.add_argument("--keep-statistics", action="store_true", help="BatchNorm keeps those of the start")
    parser.add_argument("--eager", action="store_true", help="no CUDA graphs")
    parser.add_argument("--workers", type=int, default=0)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--out", type=Path)
    arguments = parser.parse_args()
    arguments.start = arguments.start or arguments.network
    out = arguments.out or Path(f"runs/unrolled/{arguments.network}.safetensors")
    torch.manual_seed(1)
    if arguments.device == "cpu":
        torch.set_num_threads(1)
        mwdn.keep_memory()
    photographs, _ = Photographs(arguments.data / "photos/train").split(HELD_OUT)
    batches = Captures(photographs, arguments)
    workers = {"num_workers": arguments.workers, "prefetch_factor": 2} if arguments.workers else {}
    loaded = iter(DataLoader(batches, batch_size=None, **workers))  # starts the workers: before CUDA, which cannot fork
    network, options = make_network(arguments.network, arguments.start)
    network = network.to(arguments.device)
    loss = Loss(read_recipe(RECIPES[arguments.network]).loss).to(arguments.device)
    average = copy.deepcopy(network).requires_grad_(False)
    out.parent.mkdir(parents=True, exist_ok=True)

    def save(step):
        kept = copy.deepcopy(average).cpu()
        for part in kept.children():
            part.half()
        about = {"psf_hash": None, "pairs": "simulated across cameras", "recipe": described(arguments), "step": step}
        save_network(out, kept, "wiener-bank", options, **about)

    learn(network, loss, average, loaded, arguments, save)


if __name__ == "__main__":
    main()

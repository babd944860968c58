"""Time of an engine's convolutions and transforms against the arithmetic limit; used by `benchmarks/engine.py`."""

import math
import time

import torch
from torch.profiler import ProfilerActivity, profile
from torch.utils.flop_counter import FlopCounterMode

from mwdn.inference.engine import Engine, half_precision
from mwdn.networks import build

METHODS = ("mwdn", "mwdn-cpsf", "unet", "wiener-unet")
HEAD = "| method | size | device | threads | precision | part | GFLOP | ms | share | GFLOP/s | of the limit |"
FFT = torch.ops.aten


def real_transform(shape, dims, *_, **__):
    """2.5 n log2 n operations, half of a complex transform."""
    return int(2.5 * math.prod(shape) * math.log2(math.prod(shape[dim] for dim in dims)))


def inverse_real_transform(shape, dims, *_, out_shape, **__):
    return real_transform(out_shape, dims)


def complex_transform(shape, dims, *_, **__):
    return 2 * real_transform(shape, dims)


COUNTED = {FFT._fft_r2c: real_transform, FFT._fft_c2r: inverse_real_transform, FFT._fft_c2c: complex_transform}


def operations(method, size):
    """GFLOP of one picture's convolutions and transforms, without what is prepared from the PSF."""
    with torch.no_grad():
        network, picture = build(method).eval(), torch.rand(1, 3, *size)
        prepared = network.prepare(picture, picture.shape[-2:])
        with FlopCounterMode(display=False, custom_mapping=COUNTED) as counter:
            network.reconstruct(picture, prepared)
    counts = counter.get_flop_counts()["Global"]
    transforms = sum(count for operation, count in counts.items() if operation in COUNTED)
    return {"convolutions": (sum(counts.values()) - transforms) / 1e9, "transforms": transforms / 1e9}


def part_of(name):
    return "transforms" if "fft" in name else "convolutions" if "conv" in name else "the rest"


def milliseconds(engine, picture):
    """Milliseconds of each part of one call."""
    cuda = picture.is_cuda
    engine(picture)
    with profile(activities=[ProfilerActivity.CUDA if cuda else ProfilerActivity.CPU]) as profiler:
        engine._reconstruct(picture)  # a recorded graph would be one kernel
        if cuda:
            torch.cuda.synchronize()
    spent = {"convolutions": 0.0, "transforms": 0.0, "the rest": 0.0}
    for event in profiler.key_averages():
        microseconds = event.self_device_time_total if cuda else event.self_cpu_time_total
        spent[part_of(event.key)] += microseconds / 1e3
    return spent


def limit(dtype, device):
    """GFLOP/s of a large matrix product, the limit of this machine."""
    n = 8192 if device == "cuda" else 2048
    a, b, best = torch.rand(n, n, device=device).to(dtype), torch.rand(n, n, device=device).to(dtype), math.inf
    for _ in range(5):
        start = time.perf_counter()
        a @ b
        if device == "cuda":
            torch.cuda.synchronize()
        best = min(best, time.perf_counter() - start)
    return 2 * n**3 / best / 1e9


def rows(method, size, psf, picture, precision):
    """One row for each part of a call of the engine."""
    device = psf.device.type
    torch.manual_seed(0)
    engine = Engine(build(method), psf, precision=precision)
    half = half_precision(psf.device) if precision == "fast" else None
    limits = {"convolutions": limit(half or torch.float32, device), "transforms": limit(torch.float32, device)}
    counted, spent = operations(method, size), milliseconds(engine, picture.to(device))
    for part, ms in spent.items():
        row = {"method": method, "size": "{}x{}".format(*size), "device": device, "threads": torch.get_num_threads()}
        row |= {"precision": precision, "part": part, "ms": ms, "share": ms / sum(spent.values())}
        if counted.get(part):
            speed = counted[part] / ms * 1e3
            row |= {"gflop": counted[part], "gflop_per_s": speed, "of_limit": speed / limits[part]}
        yield row


def line(row):
    """A row of the table."""
    cells = [row[key] for key in ("method", "size", "device", "threads", "precision", "part")]
    cells += [f"{row['gflop']:.1f}" if "gflop" in row else "", f"{row['ms']:.0f}", f"{row['share']:.0%}"]
    cells += [f"{row['gflop_per_s']:.0f}", f"{row['of_limit']:.0%}"] if "gflop" in row else ["", ""]
    return f"| {' | '.join(map(str, cells))} |"

"""Tensors on their way between the processor's memory and a GPU's.

A GPU copies by itself from and to pinned memory, which the system cannot move, and does so while it computes: each way
has a stream of its own. Where there is no GPU, both functions are `Tensor.to`.
"""

from functools import cache

import torch
from torch import Tensor


@cache
def _stream(device: torch.device, way: str) -> torch.cuda.Stream:
    """One for each way: to have more would keep the memory of each apart."""
    return torch.cuda.Stream(device)  # type: ignore[no-untyped-call]


def to_device(tensor: Tensor, device: torch.device) -> Tensor:
    """A tensor on the device; what is queued there after this call waits for it, what was before does not."""
    if device.type != "cuda" or tensor.device.type != "cpu":
        return tensor.to(device)
    with torch.cuda.device(device):
        stream, here = _stream(device, "there"), torch.cuda.current_stream()
        with torch.cuda.stream(stream):
            found = tensor.pin_memory().to(device, non_blocking=True)
        here.wait_stream(stream)
        found.record_stream(here)  # its memory is the other stream's, and used here
    return found


def to_host(tensor: Tensor) -> Tensor:
    """A tensor in ordinary memory; waits for what was queued before this call, not for what other threads queue."""
    if tensor.device.type != "cuda":
        return tensor.to("cpu")
    with torch.cuda.device(tensor.device):
        stream = _stream(tensor.device, "back")
        stream.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(stream):
            pinned = torch.empty(tensor.shape, dtype=tensor.dtype, pin_memory=True)
            pinned.copy_(tensor, non_blocking=True)
            tensor.record_stream(stream)
            done = stream.record_event()
        done.synchronize()
    return pinned.clone()  # pinned memory is short: who keeps a thousand pictures must not keep that

"""Asynchronous copies between host memory and a GPU.

A GPU copies to and from pinned (page-locked) memory while it computes, in a separate stream for each direction. Without
a GPU, both functions are `Tensor.to`.
"""

from functools import cache

import torch
from torch import Tensor


@cache
def _stream(device: torch.device, direction: str) -> torch.cuda.Stream:
    """One stream per direction: torch's allocator does not share memory between streams."""
    return torch.cuda.Stream(device)  # type: ignore[no-untyped-call]


def to_device(tensor: Tensor, device: torch.device) -> Tensor:
    """Asynchronous copy to the device; later work on the current stream waits for it, earlier work overlaps with it."""
    if device.type != "cuda" or tensor.device.type != "cpu":
        return tensor.to(device)
    with torch.cuda.device(device):
        stream, current = _stream(device, "to device"), torch.cuda.current_stream()
        with torch.cuda.stream(stream):
            copy = tensor.pin_memory().to(device, non_blocking=True)
        current.wait_stream(stream)
        copy.record_stream(current)  # allocated in one stream, used in another: freed only when both are done
    return copy


def to_host(tensor: Tensor) -> Tensor:
    """Copy to pageable host memory; waits for work queued before this call, not for later work of other threads."""
    if tensor.device.type != "cuda":
        return tensor.to("cpu")
    with torch.cuda.device(tensor.device):
        stream = _stream(tensor.device, "to host")
        stream.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(stream):
            pinned = torch.empty(tensor.shape, dtype=tensor.dtype, pin_memory=True)
            pinned.copy_(tensor, non_blocking=True)
            tensor.record_stream(stream)
            done = stream.record_event()
        done.synchronize()
    return pinned.clone()  # pinned memory is scarce: a caller that keeps a thousand pictures must not keep it

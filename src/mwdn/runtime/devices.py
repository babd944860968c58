"""Select a device; numeric precision of devices."""

import re
from collections.abc import Iterator
from contextlib import contextmanager

import torch

from mwdn.errors import ParameterError


def select_device(device: str | torch.device | None = None) -> torch.device:
    """Return the device after a test that torch can use it.

    Args:
        device: cpu, cuda, cuda:1 ...; unless given, a GPU if there is one, else the CPU.

    Raises:
        ParameterError: torch cannot use the device.
    """
    device = device or ("cuda" if torch.cuda.is_available() else "cpu")
    try:
        torch.zeros(1, device=device).item()
    except (RuntimeError, AssertionError, ImportError) as error:  # a torch without CUDA raises AssertionError
        reason = re.split(r"\.\s|\n", str(error))[0].rstrip(".")  # the first sentence of up to 7,000 characters
        raise ParameterError(
            f"`device` ({device}) must be one that torch can use here: {reason}. Leave it out, or run `mwdn doctor`."
        ) from error
    return torch.device(device)


def is_out_of_memory(error: BaseException) -> bool:
    """Whether an error says that a device has too little memory. On a CPU torch has no type for it."""
    return isinstance(error, MemoryError | torch.OutOfMemoryError) or "can't allocate memory" in str(error)


@contextmanager
def memory_errors(name: str, shape: tuple[int, ...], device: torch.device) -> Iterator[None]:
    """Turn a device's lack of memory for pictures of this shape, the argument called ``name``, into one sentence.

    Raises:
        ParameterError: the device has too little memory.
    """
    try:
        yield
    except (MemoryError, RuntimeError) as error:
        if not is_out_of_memory(error):
            raise
        raise ParameterError(
            f"`{name}` {shape} needs more memory than {device} has free. Bin or crop it: `bin=2`, "
            "`crop=(1000, 1000)`; or try `device='cpu'`, `method='wiener'`."
        ) from error


def has_bfloat16(device: torch.device) -> bool:
    """Whether the device computes bfloat16 in hardware. Emulated bfloat16 is slower than float32."""
    if device.type == "cuda":
        return torch.cuda.is_bf16_supported(including_emulation=False)
    # Builds without oneDNN, such as those for Macs, lack the second function.
    return torch.backends.mkldnn.is_available() and torch.ops.mkldnn._is_mkldnn_bf16_supported()  # type: ignore[no-untyped-call]


@contextmanager
def without_tf32() -> Iterator[None]:
    """Compute float32 convolutions on a GPU with the 23 bits of float32, not the 10 of TF32."""
    convolutions = torch.backends.cudnn.conv  # type: ignore[attr-defined]
    before, convolutions.fp32_precision = convolutions.fp32_precision, "ieee"
    try:
        yield
    finally:
        convolutions.fp32_precision = before

"""Devices to compute on, and the precisions that they compute fast."""

import re
from collections.abc import Iterator
from contextlib import contextmanager

import torch

from mwdn.errors import ParameterError


def select_device(device: str | torch.device | None = None) -> torch.device:
    """Return the device once it has held a number and given it back.

    Args:
        device: cpu, cuda, cuda:1 ...; a GPU if there is one unless given.

    Raises:
        ParameterError: torch cannot use it here.
    """
    device = device or ("cuda" if torch.cuda.is_available() else "cpu")
    try:
        torch.zeros(1, device=device).item()
    except (RuntimeError, AssertionError, ImportError) as error:  # torch without CUDA asserts
        why = re.split(r"\.\s|\n", str(error))[0].rstrip(".")  # its first sentence of up to seven thousand characters
        raise ParameterError(
            f"`device` ({device}) must be one that torch can use here: {why}. Leave it out, or see `mwdn doctor`."
        ) from error
    return torch.device(device)


def has_bfloat16(device: torch.device) -> bool:
    """Whether the device multiplies bfloat16 in hardware. Emulated, it is slower than float32."""
    if device.type == "cuda":
        return torch.cuda.is_bf16_supported(including_emulation=False)
    # Builds without oneDNN, such as those for Macs, do not have the question.
    return torch.backends.mkldnn.is_available() and torch.ops.mkldnn._is_mkldnn_bf16_supported()  # type: ignore[no-untyped-call]


@contextmanager
def without_tf32() -> Iterator[None]:
    """Let float32 convolutions on a GPU have the 23 bits of float32, not the 10 of TF32."""
    convolutions = torch.backends.cudnn.conv  # type: ignore[attr-defined]
    before, convolutions.fp32_precision = convolutions.fp32_precision, "ieee"
    try:
        yield
    finally:
        convolutions.fp32_precision = before

"""Which devices there are to compute on."""

import re

import torch

from mwdn.errors import ParameterError


def usable(device: str | torch.device | None = None) -> torch.device:
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

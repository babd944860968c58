"""Which devices there are to compute on."""

import torch

from mwdn.errors import ParameterError


def usable(device: str | torch.device | None = None) -> torch.device:
    """Return the device once it has held a tensor.

    Args:
        device: cpu, cuda, cuda:1 ...; a GPU if there is one unless given.

    Raises:
        ParameterError: torch cannot use it here.
    """
    device = device or ("cuda" if torch.cuda.is_available() else "cpu")
    try:
        torch.empty(1, device=device)
    except (RuntimeError, AssertionError) as error:  # torch without CUDA asserts
        raise ParameterError(
            f"`device` ({device}) must be one that torch can use here: {str(error).splitlines()[0]} "
            "Leave it out, or see `mwdn doctor`."
        ) from error
    return torch.device(device)

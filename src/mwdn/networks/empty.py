"""Build a network without memory for its weights, to check the options of a file or a recipe."""

import warnings
from typing import Any, no_type_check

import torch
from torch import Tensor, nn
from torch.overrides import TorchFunctionMode

from mwdn.errors import MwdnError, ParameterError, reason
from mwdn.networks import build

MAX_PARAMETERS = 2**28
"""Largest number of parameters: 1 GiB in float32, twelve times the largest network of the paper."""

MAX_TENSORS = 8_000
"""Limit of the tensors made while a network is built, about a second; the networks of the package make up to 540."""


class _Counted(TorchFunctionMode):
    """Counts the tensors that this thread makes, and stops at `MAX_TENSORS`."""

    count = 0

    @no_type_check  # it is called for each operation of torch, and the tests check each call's types
    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:  # noqa: ANN401
        result = func(*args, **(kwargs or {}))
        self.count += isinstance(result, Tensor)
        if self.count > MAX_TENSORS:
            raise ParameterError("the network has too many layers. Lower its depth.")
        return result


def build_empty(name: str, **options: Any) -> nn.Module:  # noqa: ANN401
    """Build a network on torch's meta device, where tensors have shapes but no memory.

    Args:
        name: as for `mwdn.networks.build`.
        **options: as for `mwdn.networks.build`.

    Raises:
        UnknownNameError: as for `mwdn.networks.build`.
        ParameterError: an option is out of range, a layer has no channels, or there are too many layers or parameters.
    """
    try:
        with _Counted(), torch.device("meta"), warnings.catch_warnings(action="ignore"):  # torch warns of empty layers
            network = build(name, **options)
    except MwdnError:
        raise
    except Exception as error:  # torch has many kinds for a size below 0 or beyond 64 bits
        raise ParameterError(f"the options of '{name}' are impossible: {reason(error)}.") from error
    empty = [key for key, parameter in network.named_parameters() if parameter.numel() == 0]
    if empty:
        raise ParameterError(f"`{empty[0]}` of the network '{name}' has no channels. Choose positive sizes.")
    count = sum(parameter.numel() for parameter in network.parameters())
    if count > MAX_PARAMETERS:
        raise ParameterError(
            f"the network '{name}' has {count:,} parameters; at most {MAX_PARAMETERS:,} are allowed. Lower `width`."
        )
    return network

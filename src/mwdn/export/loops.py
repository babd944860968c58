"""Iterations of a solver as one loop of an exported program, in place of a copy of the operations for each."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import TypeVar

import torch
from torch import Tensor
from torch.utils._pytree import tree_flatten, tree_unflatten

from mwdn.runtime.iterations import record_loops

S = TypeVar("S")


@torch.library.custom_op("mwdn::begin_loop", mutates_args=())
def begin_loop(state: list[Tensor], count: int) -> list[Tensor]:
    """Mark the state at the beginning of an iteration, of which there are ``count``."""
    return [tensor.clone() for tensor in state]


@torch.library.custom_op("mwdn::end_loop", mutates_args=())
def end_loop(state: list[Tensor]) -> list[Tensor]:
    """Mark the state at the end of an iteration."""
    return [tensor.clone() for tensor in state]


begin_loop.register_fake(lambda state, count: [tensor.clone() for tensor in state])
end_loop.register_fake(lambda state: [tensor.clone() for tensor in state])

BEGIN, END = torch.ops.mwdn.begin_loop.default, torch.ops.mwdn.end_loop.default


@contextmanager
def as_loops() -> Iterator[None]:
    """Programs that torch traces meanwhile have one iteration between `BEGIN` and `END`, for `to_onnx`."""
    with record_loops(_record):
        yield


def _record(updates: Sequence[Callable[[S], S]], state: S, count: int) -> S:
    tensors, layout = tree_flatten(state)
    state = tree_unflatten(begin_loop(tensors, count), layout)
    for update in updates:
        state = update(state)
    tensors, layout = tree_flatten(state)
    return tree_unflatten(end_loop(tensors), layout)

"""One run on several processes that `torchrun` started: each takes its part of every batch, the result stays the same.

Without torchrun there is one process, and nothing here does anything.
"""

import atexit
import ctypes
import json
import os
import secrets
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor, nn
from torch import distributed as dist

from mwdn.errors import ParameterError, ProcessError
from mwdn.runtime.devices import select_device


def launched_processes() -> int:
    """Number of processes that torchrun started, whether they have joined or not.

    Raises:
        ParameterError: the environment holds another thing than a number.
    """
    return max(1, int(_of_torchrun("WORLD_SIZE", "1")))


def _of_torchrun(name: str, otherwise: str = "") -> str:
    """What torchrun has set in the environment: numbers, and one address."""
    value = os.environ.get(name, otherwise)
    if not (value and (value.isdecimal() or name == "MASTER_ADDR")):
        raise ParameterError(
            f"`{name}` ({value or 'not set'}) must be set as torchrun sets it for each of several processes. Start "
            "them by `torchrun --nproc-per-node 2 -m mwdn ...`, or one alone: `unset WORLD_SIZE`."
        )
    return value


def _joined() -> bool:
    return dist.is_available() and dist.is_initialized()


def rank() -> int:
    """Number of this process, from 0."""
    return dist.get_rank() if _joined() else 0


def world_size() -> int:
    """Number of processes."""
    return dist.get_world_size() if _joined() else 1


@contextmanager
def process_group() -> Iterator[None]:
    """Join the processes that torchrun started, and part from them at the end.

    Raises:
        ProcessError: they cannot be reached.
        ParameterError: the environment says that there are several, but not how to reach them.
    """
    if launched_processes() == 1:
        yield
        return
    for name in ("RANK", "LOCAL_RANK", "MASTER_ADDR", "MASTER_PORT"):
        _of_torchrun(name)
    _end_with_parent()
    # Tensors meet where they are: small messages through the CPU, gradients from GPU to GPU.
    backend = "cpu:gloo,cuda:nccl" if torch.cuda.is_available() else "gloo"
    with _together():
        store, rank, world = next(dist.rendezvous("env://"))  # type: ignore[attr-defined]
        # After a restart torchrun's store still holds where the processes before could be reached.
        store = dist.PrefixStore(os.environ.get("TORCHELASTIC_RESTART_COUNT", "0"), store)  # type: ignore[attr-defined]
        dist.init_process_group(backend, store=store, rank=rank, world_size=world)
    yield
    # Not after an error: NCCL would wait for processes that may have ended.
    all_reduce_sum(torch.zeros(1))  # nobody hangs up while another still writes the last checkpoint
    dist.destroy_process_group()
    atexit.register(_leave)


def _leave(status: int = 0) -> None:
    """End at once: on a busy machine torch's own threads may outlive what they use, which then aborts the process.

    All is written, and the other processes have parted.
    """
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(status)


def set_exit_status(status: int) -> None:
    """Exit status of this process, where several have parted."""
    if launched_processes() > 1:
        atexit.register(_leave, status)  # before the one above: the last one registered comes first


def _end_with_parent() -> None:
    """Let Linux kill this process with torchrun, which would leave it at work if it were itself killed."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(1, signal.SIGKILL)  # PR_SET_PDEATHSIG


def local_device(device: str | torch.device | None = None) -> torch.device:
    """The device of this process: of several GPUs in a machine, each process takes that of its number.

    Args:
        device: cpu, cuda ...; a GPU if there is one unless given.

    Raises:
        ParameterError: torch cannot use it, or it names one GPU for several processes.
    """
    if launched_processes() == 1:
        return select_device(device)
    name = str(device or ("cuda" if torch.cuda.is_available() else "cpu"))
    if name.startswith("cuda:"):
        raise ParameterError(
            f"`device` ({name}) must be `cuda`: each of {launched_processes()} processes takes a GPU of its own."
        )
    # Asked for by its number at once: a first tensor on `cuda` would take memory of the first GPU.
    found = select_device(f"cuda:{os.environ['LOCAL_RANK']}" if name == "cuda" else name)
    if found.type == "cuda":
        torch.cuda.set_device(found)
    return found


@contextmanager
def _together() -> Iterator[None]:
    """Say so if another process has gone: its own message tells why."""
    try:
        yield
    except RuntimeError as error:
        name = f"{os.environ.get('RANK')} of {os.environ.get('WORLD_SIZE')}"
        raise ProcessError(
            f"Process {name} lost the others: {str(error).splitlines()[0]} The message of the one that ended first "
            "says why. The same command given again goes on from the last saved state."
        ) from error


def all_reduce_sum(value: Tensor) -> Tensor:
    """Sum over all processes; ``value`` itself is changed. Every process gets the same bits."""
    if world_size() > 1:
        with _together():
            dist.all_reduce(value)
    return value


def broadcast(compute: Callable[[], bytes]) -> bytes:
    """What the first process computes or reads, on all."""
    content = compute() if rank() == 0 else b""
    if world_size() == 1:
        return content
    with _together():
        length = torch.tensor([len(content)])
        dist.broadcast(length, 0)
        # Never empty: an empty tensor cannot be made from a buffer. A bytearray may be written to, as a tensor may.
        message = torch.frombuffer(bytearray(content.ljust(int(length) + 1)), dtype=torch.uint8)
        dist.broadcast(message, 0)
    return message[:-1].numpy().tobytes()


def broadcast_json(compute: Callable[[], Any]) -> Any:  # noqa: ANN401
    """A value that JSON can hold, computed by the first process, on all.

    Strings may hold lone surrogates: file names that are not UTF-8.
    """
    return compute() if world_size() == 1 else json.loads(broadcast(lambda: json.dumps(compute()).encode()))


def broadcast_floats(numbers: list[float]) -> list[float]:
    """The numbers that the first process gives, on all, to the last bit."""
    return json.loads(broadcast(lambda: json.dumps(numbers).encode()))


def check_same(identity: dict[str, Any]) -> None:
    """Check that every process was given the same.

    Raises:
        ParameterError: this process was given something else than the first.
    """
    own = json.dumps(identity, sort_keys=True).encode()
    if broadcast(lambda: own) != own:
        raise ParameterError(
            f"Process {rank()} must be given the recipe and PSF that process 0 was given. Copy them to all machines."
        )


def shard(numbers: range) -> range:
    """The part of a batch's samples that belongs to this process; parts differ by one sample at most.

    Raises:
        ParameterError: there are fewer samples than processes.
    """
    count = len(numbers)
    if count < world_size():
        raise ParameterError(
            f"`batch` ({count}) must be at least the number of processes ({world_size()}): each takes a part of it. "
            f"Make it larger, `--batch {world_size()}`, or start fewer processes."
        )
    return numbers[rank() * count // world_size() : (rank() + 1) * count // world_size()]


def work_queue(count: int) -> Iterator[int]:
    """The numbers below ``count``, each to one process alone: to whichever asks first."""
    if world_size() == 1:
        yield from range(count)
        return
    # The server of torchrun outlives its processes: each start counts under a name of its own.
    name = broadcast(lambda: secrets.token_hex(8).encode()).decode()
    with _together():
        address = os.environ["MASTER_ADDR"], int(os.environ["MASTER_PORT"])
        store = dist.TCPStore(*address, is_master=False)  # type: ignore[attr-defined]
        while (number := store.add(name, 1) - 1) < count:
            yield number


def all_reduce_gradients(network: nn.Module) -> None:
    """Sum every gradient over all processes, in one message: one of 17 million float32 numbers has 69 MB."""
    if world_size() == 1:
        return
    gradients = [parameter.grad for parameter in network.parameters() if parameter.grad is not None]
    flat = all_reduce_sum(torch.cat([gradient.flatten() for gradient in gradients]))
    parts = torch.split(flat, [gradient.numel() for gradient in gradients])
    for gradient, part in zip(gradients, parts, strict=True):
        gradient.copy_(part.view_as(gradient))

"""Data-parallel runs under `torchrun`: each process takes a part of every batch, with the result of a single process.

Without torchrun there is one process, and these functions do nothing.
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
    """Number of processes that torchrun started, before or after they join.

    Raises:
        ParameterError: ``WORLD_SIZE`` in the environment is not a number.
    """
    return max(1, int(_environment("WORLD_SIZE", "1")))


def _environment(name: str, default: str = "") -> str:
    """A variable that torchrun sets in the environment: numbers, and one address."""
    value = os.environ.get(name, default)
    if not (value and (value.isdecimal() or name == "MASTER_ADDR")):
        raise ParameterError(
            f"`{name}` ({value or 'not set'}) must be set as torchrun sets it. Start several processes by "
            "`torchrun --nproc-per-node 2 -m mwdn ...`, or a single one: `unset WORLD_SIZE`."
        )
    return value


def _joined() -> bool:
    return dist.is_available() and dist.is_initialized()


def rank() -> int:
    """Number of this process, starting at 0."""
    return dist.get_rank() if _joined() else 0


def world_size() -> int:
    """Number of processes."""
    return dist.get_world_size() if _joined() else 1


@contextmanager
def process_group() -> Iterator[None]:
    """Join the processes that torchrun started; leave the group at the end.

    Raises:
        ProcessError: they cannot be reached.
        ParameterError: the environment lacks their addresses.
    """
    if launched_processes() == 1:
        yield
        return
    for name in ("RANK", "LOCAL_RANK", "MASTER_ADDR", "MASTER_PORT"):
        _environment(name)
    _end_with_parent()
    # Tensors on the CPU (small messages) go by gloo, tensors on GPUs (gradients) by NCCL.
    backend = "cpu:gloo,cuda:nccl" if torch.cuda.is_available() else "gloo"
    with _communication():
        store, rank, world = next(dist.rendezvous("env://"))  # type: ignore[attr-defined]
        # After a restart torchrun's store still has the addresses of the previous processes: use keys of our own.
        store = dist.PrefixStore(os.environ.get("TORCHELASTIC_RESTART_COUNT", "0"), store)  # type: ignore[attr-defined]
        dist.init_process_group(backend, store=store, rank=rank, world_size=world)
    yield
    # Not after an error: NCCL would wait for processes that may have ended.
    all_reduce_sum(torch.zeros(1))  # wait until the first process has written the last checkpoint
    dist.destroy_process_group()
    atexit.register(_leave)


def _leave(status: int = 0) -> None:
    """Exit without Python's cleanup, in which torch's threads may abort the process on a busy machine.

    At this point everything is written and the group is destroyed.
    """
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(status)


def set_exit_status(status: int) -> None:
    """Set the exit status of this process in a run of several."""
    if launched_processes() > 1:
        atexit.register(_leave, status)  # runs before the `_leave` above: last registered, first called


def _end_with_parent() -> None:
    """Let Linux kill this process when torchrun is killed, which would otherwise leave it running."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(1, signal.SIGKILL)  # PR_SET_PDEATHSIG


def local_device(device: str | torch.device | None = None) -> torch.device:
    """The device of this process: on a machine with several GPUs, each process has its own.

    Args:
        device: cpu, cuda ...; by default a GPU if there is one.

    Raises:
        ParameterError: torch cannot use it, or it names one GPU for several processes.
    """
    if launched_processes() == 1:
        return select_device(device)
    name = str(device or ("cuda" if torch.cuda.is_available() else "cpu"))
    if name.startswith("cuda:"):
        raise ParameterError(
            f"`device` ({name}) must be `cuda`: each of {launched_processes()} processes takes its own GPU."
        )
    # By its number from the start: a first tensor on `cuda` would allocate memory on the first GPU.
    selected = select_device(f"cuda:{os.environ['LOCAL_RANK']}" if name == "cuda" else name)
    if selected.type == "cuda":
        torch.cuda.set_device(selected)
    return selected


@contextmanager
def _communication() -> Iterator[None]:
    """Raise a `ProcessError` if another process has ended."""
    try:
        yield
    except RuntimeError as error:
        name = f"{os.environ.get('RANK')} of {os.environ.get('WORLD_SIZE')}"
        raise ProcessError(
            f"Process {name} lost the others: {str(error).splitlines()[0]} The reason is in the message of the "
            "process that ended first. The same command resumes from the last saved state."
        ) from error


def all_reduce_sum(value: Tensor) -> Tensor:
    """Sum over all processes, in place. Every process gets the same bits."""
    if world_size() > 1:
        with _communication():
            dist.all_reduce(value)
    return value


def broadcast(compute: Callable[[], bytes], *, source: int = 0) -> bytes:
    """Send what one process, the first by default, computes or reads to all."""
    content = compute() if rank() == source else b""
    if world_size() == 1:
        return content
    with _communication():
        length = torch.tensor([len(content)])
        dist.broadcast(length, source)
        # One byte longer: a tensor cannot share an empty buffer. A bytearray, as torch warns of read-only buffers.
        message = torch.frombuffer(bytearray(content.ljust(int(length) + 1)), dtype=torch.uint8)
        dist.broadcast(message, source)
    return message[:-1].numpy().tobytes()


def broadcast_json(compute: Callable[[], Any]) -> Any:  # noqa: ANN401
    """A value that JSON can hold, computed by the first process, on all.

    Strings may hold lone surrogates: file names that are not UTF-8.
    """
    return compute() if world_size() == 1 else json.loads(broadcast(lambda: json.dumps(compute()).encode()))


def gather_json(value: Any) -> list[Any]:  # noqa: ANN401
    """The values that all processes have, in the order of the processes, on all; JSON can hold each."""
    if world_size() == 1:
        return [value]
    content = json.dumps(value).encode()
    return [json.loads(broadcast(lambda: content, source=source)) for source in range(world_size())]


def check_same(identity: dict[str, Any]) -> None:
    """Check that every process has the same recipe and PSF.

    Raises:
        ParameterError: this process has others than the first.
    """
    own = json.dumps(identity, sort_keys=True).encode()
    if broadcast(lambda: own) != own:
        raise ParameterError(
            f"Process {rank()} must have the same recipe and PSF as process 0. Copy them to all machines."
        )


def shard(numbers: range) -> range:
    """Share of a batch for this process; shares differ by one sample at most.

    Raises:
        ParameterError: the batch has fewer samples than there are processes.
    """
    count = len(numbers)
    if count < world_size():
        raise ParameterError(
            f"`batch` ({count}) must be at least the number of processes ({world_size()}): each takes a share of it. "
            f"Make it larger, `--batch {world_size()}`, or start fewer processes."
        )
    return numbers[rank() * count // world_size() : (rank() + 1) * count // world_size()]


def work_queue(count: int) -> Iterator[int]:
    """The numbers below ``count``, shared by all processes: each number goes to the next process that is free."""
    if world_size() == 1:
        yield from range(count)
        return
    # torchrun's server outlives its processes: each start counts under a name of its own.
    name = broadcast(lambda: secrets.token_hex(8).encode()).decode()
    with _communication():
        address = os.environ["MASTER_ADDR"], int(os.environ["MASTER_PORT"])
        store = dist.TCPStore(*address, is_master=False)  # type: ignore[attr-defined]
        while (number := store.add(name, 1) - 1) < count:
            yield number


def all_reduce_gradients(network: nn.Module) -> None:
    """Sum every gradient over all processes, in one message: 69 MB for 17 million float32 numbers."""
    if world_size() == 1:
        return
    gradients = [parameter.grad for parameter in network.parameters() if parameter.grad is not None]
    flat = all_reduce_sum(torch.cat([gradient.flatten() for gradient in gradients]))
    parts = torch.split(flat, [gradient.numel() for gradient in gradients])
    for gradient, part in zip(gradients, parts, strict=True):
        gradient.copy_(part.view_as(gradient))

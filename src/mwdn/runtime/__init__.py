"""The machine: devices, memory, processes, threads, transfers.

Each name is imported at its first use, so that the command line can import `keep_memory` without torch.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from mwdn.runtime.devices import has_bfloat16, select_device, without_tf32
    from mwdn.runtime.memory import keep_memory
    from mwdn.runtime.streams import latest, prefetch
    from mwdn.runtime.transfers import to_device, to_host

__all__ = [
    "has_bfloat16",
    "keep_memory",
    "latest",
    "prefetch",
    "select_device",
    "to_device",
    "to_host",
    "without_tf32",
]

_MODULES = {
    "has_bfloat16": "devices",
    "keep_memory": "memory",
    "latest": "streams",
    "prefetch": "streams",
    "select_device": "devices",
    "to_device": "transfers",
    "to_host": "transfers",
    "without_tf32": "devices",
}


def __getattr__(name: str) -> Any:  # noqa: ANN401
    if name not in _MODULES:
        raise AttributeError(f"module 'mwdn.runtime' has no attribute '{name}'")
    return getattr(import_module(f"mwdn.runtime.{_MODULES[name]}"), name)

"""The machine: devices, memory, processes, threads, transfers.

Each name is imported at its first use, so that the command line can import `keep_memory` without torch.
"""

from typing import TYPE_CHECKING

from mwdn.first_use import at_first_use

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

__getattr__ = at_first_use(__name__, _MODULES)

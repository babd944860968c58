"""The machine: devices, memory, processes, threads, transfers."""

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

"""Describe the machine and the installed packages, for `mwdn doctor` and benchmark reports."""

import os
import platform
from importlib.metadata import PackageNotFoundError, version

import torch

from mwdn.runtime.devices import has_bfloat16

_PACKAGES = (
    "mwdn",
    "torch",
    "numpy",
    "opencv-python-headless",
    "tifffile",
    "h5py",
    "safetensors",
    "cyclopts",
    "rich",
    "rawpy",
)


def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return "not installed"


def describe_environment() -> dict[str, str]:
    """Versions and hardware, by name: what a bug report needs."""
    facts = {"python": f"{platform.python_version()} on {platform.platform()}"}
    facts |= {package: _version(package) for package in _PACKAGES}
    facts["CPU"] = (
        f"{platform.machine()}, {os.cpu_count()} cores, instructions {torch.backends.cpu.get_cpu_capability()}"
    )
    facts["threads"] = f"{torch.get_num_threads()} (set OMP_NUM_THREADS to change)"
    facts["bfloat16 on the CPU"] = (
        "yes, in hardware" if has_bfloat16(torch.device("cpu")) else "emulated: float32 is faster"
    )
    if not torch.cuda.is_available():
        facts["GPU"] = "none that torch can use"
    for index in range(torch.cuda.device_count()):
        card = torch.cuda.get_device_properties(index)
        bfloat = "with" if has_bfloat16(torch.device("cuda", index)) else "without"
        facts[f"cuda:{index}"] = f"{card.name}, {card.total_memory / 2**30:.0f} GiB, {bfloat} bfloat16"
    return facts

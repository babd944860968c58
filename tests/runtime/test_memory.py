"""Kept memory is reused, not requested from the system again."""

import subprocess
import sys

import pytest

from mwdn import keep_memory

FAULTS = """
import resource, torch
from mwdn import keep_memory

def work():
    for size in (2**20, 2**24, 2**22):  # 4 to 64 MB
        torch.ones(size)

def faults():
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    work()
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before

usual = min(faults() for _ in range(5))  # the heap reaches its final size after a few rounds
assert keep_memory()
print(usual, min(faults() for _ in range(5)))
"""


@pytest.mark.skipif(sys.platform != "linux", reason="glibc only")
def test_freed_memory_is_used_again():
    """84 MB have 21,504 pages of 4 kB, or 42 of 2 MB."""
    told = subprocess.run([sys.executable, "-c", FAULTS], capture_output=True, check=True, text=True).stdout
    usual, kept = map(int, told.split())
    assert kept < 100
    assert usual > max(20, 10 * kept)


def test_elsewhere_nothing_happens(monkeypatch):
    monkeypatch.setattr(sys, "platform", "darwin")
    assert not keep_memory()

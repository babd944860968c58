"""A forked child of a process that has computed on two threads."""

import subprocess
import sys

import pytest

SCRIPT = """
import os, torch, mwdn
torch.set_num_threads(2)
psf = torch.rand(1, 3, 96, 96) ** 8
camera = mwdn.Calibration.from_array(psf[0].movedim(0, -1).numpy())
capture = torch.rand(1, 3, 96, 96)
for method in ("wiener", "universal-small"):
    reconstruct = mwdn.Reconstructor(method, camera, precision="exact")
    expected = reconstruct(capture)
    child = os.fork()
    if child == 0:
        near = torch.allclose(reconstruct(capture), expected, atol=1e-3)
        os._exit(0 if near and torch.get_num_threads() == 1 else 1)
    print(method, os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), torch.get_num_threads())
"""


@pytest.mark.skipif(sys.platform == "win32", reason="no fork")
def test_a_forked_child_computes():
    """It waited forever for OpenMP threads that a fork does not copy, 3 of 3 times."""
    command = [sys.executable, "-W", "ignore::DeprecationWarning", "-c", SCRIPT]
    result = subprocess.run(command, capture_output=True, text=True, timeout=240, check=False)
    assert (result.stdout, result.stderr) == ("wiener 0 2\nuniversal-small 0 2\n", "")

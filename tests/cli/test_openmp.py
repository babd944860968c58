"""How long OpenMP's threads spin."""

import os

import pytest

from mwdn.cli import main
from mwdn.cli.openmp import SPINS, sleep_soon


def test_threads_sleep_soon_unless_the_user_chose_a_way_of_waiting():
    nothing, spins, policy = {}, {"GOMP_SPINCOUNT": "7"}, {"OMP_WAIT_POLICY": "active"}
    for environment in (nothing, spins, policy):
        sleep_soon(environment)
    assert nothing == {"GOMP_SPINCOUNT": SPINS}
    assert spins == {"GOMP_SPINCOUNT": "7"}
    assert policy == {"OMP_WAIT_POLICY": "active"}


def test_the_command_line_sets_it_before_torch_is_imported(monkeypatch):
    for name in ("GOMP_SPINCOUNT", "OMP_WAIT_POLICY"):
        monkeypatch.setenv(name, "")
        monkeypatch.delenv(name)
    with pytest.raises(SystemExit):
        main(["--version"])
    assert os.environ["GOMP_SPINCOUNT"] == SPINS

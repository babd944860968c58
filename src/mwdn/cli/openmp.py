"""How long OpenMP's threads wait for each other before they sleep."""

from collections.abc import MutableMapping

SPINS = "1000"
"""Turns of a waiting thread before it sleeps, about 20 us: GNU OpenMP's own number for more threads than cores.

Otherwise it takes 300,000, which is 6 ms. Where another program takes a core, threads then spin while the thread that
they wait for cannot run. 1,000 turns cost 5 % of the time on an idle machine, and save 40 % beside another program
(``benchmarks/spinning.py``).
"""


def sleep_soon(environment: MutableMapping[str, str]) -> None:
    """Set the number of turns for GNU OpenMP, unless the user has chosen a way of waiting.

    Must be called before torch is imported: OpenMP reads its settings once.
    """
    if "OMP_WAIT_POLICY" not in environment:
        environment.setdefault("GOMP_SPINCOUNT", SPINS)

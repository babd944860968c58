"""Classical reconstruction, no training needed. Each is called as ``solver(measurement, psf)``."""

from typing import Any

from mwdn.errors import UnknownNameError, check_options
from mwdn.optics.noise import noise_level
from mwdn.solvers.admm import Admm, Progress
from mwdn.solvers.alignment import Pose, align
from mwdn.solvers.fista import Fista
from mwdn.solvers.pyramid import Pyramid
from mwdn.solvers.splitting import TEXTBOOK, Penalties
from mwdn.solvers.warm_start import WarmStart
from mwdn.solvers.wiener import Wiener

Solver = Admm | Fista | Pyramid | Wiener

SOLVERS: dict[str, type[Solver]] = {"admm": Admm, "fista": Fista, "pyramid": Pyramid, "wiener": Wiener}
"""Every solver by the name that the command line uses."""


def build(name: str, **options: Any) -> Solver:  # noqa: ANN401
    """Make a solver.

    Args:
        name: one of `SOLVERS`.
        **options: keyword arguments of that solver, for example ``iterations=50``.

    Raises:
        UnknownNameError: there is no such solver, or it has no such option.
    """
    if name not in SOLVERS:
        raise UnknownNameError("solver", name, SOLVERS)
    check_options(SOLVERS[name], f"the solver '{name}'", options)
    return SOLVERS[name](**options)


__all__ = [
    "SOLVERS",
    "TEXTBOOK",
    "Admm",
    "Fista",
    "Penalties",
    "Pose",
    "Progress",
    "Pyramid",
    "Solver",
    "WarmStart",
    "Wiener",
    "align",
    "build",
    "noise_level",
]

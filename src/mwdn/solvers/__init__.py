"""Classical reconstruction without training. Each method is called as ``solver(measurement, psf)``.

- `Wiener`: one linear filter, its lambda chosen from the noise. The fastest.
- `Admm`: total variation and non-negativity, 100 iterations.
- `Fista`: non-negativity alone, 200 gradient steps. The cross-check of ADMM.
- `Pyramid`: ADMM from coarse to fine. Better than `Admm`, in a fraction of its time.

`WarmStart` continues `Admm` or `Fista` from frame to frame of a stream; `align` corrects the PSF of a camera that has
changed since its calibration.
"""

from collections.abc import Callable
from typing import Any

from mwdn.arguments import check_options
from mwdn.errors import ParameterError, UnknownNameError
from mwdn.optics.noise import noise_level
from mwdn.runtime.forks import survive_forks
from mwdn.runtime.plugins import Registry, check_complete, plugin_errors
from mwdn.solvers.admm import Admm
from mwdn.solvers.alignment import align
from mwdn.solvers.fista import Fista
from mwdn.solvers.pose import Pose
from mwdn.solvers.pyramid import Pyramid
from mwdn.solvers.splitting import TEXTBOOK, Penalties
from mwdn.solvers.warm_start import WarmStart
from mwdn.solvers.wiener import Wiener
from mwdn.types import Measurement, Psf, Scene

survive_forks()  # here, because every method imports the solvers

Solver = Admm | Fista | Pyramid | Wiener

NETWORK_NAMES = frozenset(
    {"drunet", "flatnet", "ifin", "le-admm", "le-admm-u", "mmcn", "mwdn", "mwdn-cpsf", "svdeconv", "unet", "updn"}
    | {"wiener-bank", "wiener-unet"}
)
"""Names of networks, except ``wiener``, which is also a solver: this folder cannot import `mwdn.networks`."""

BUNDLED_NAMES = frozenset({"universal", "universal-small"})
"""Names of the networks of `mwdn.weights.BUNDLED`, for the same reason."""

SOLVERS: Registry[type[Solver]] = Registry(
    {"admm": Admm, "fista": Fista, "pyramid": Pyramid, "wiener": Wiener},
    "mwdn.solvers",
    accepts=lambda entry: isinstance(entry, type) and any("__call__" in vars(base) for base in entry.__mro__),
    must_be="a class whose objects are called as `solver(measurement, psf)`",
    reserved=NETWORK_NAMES | BUNDLED_NAMES,
)
"""Every solver by its name on the command line, those of plugins included."""


def build(name: str, **options: Any) -> Callable[[Measurement, Psf], Scene]:  # noqa: ANN401
    """Make a solver.

    Args:
        name: one of `SOLVERS`.
        **options: keyword arguments of that solver, for example ``iterations=50``.

    Raises:
        UnknownNameError: there is no such solver, or it has no such option.
        ParameterError: ``name`` is a network, or an option is of another type or out of range.
        PluginError: the class is a plugin's and raises an error.
    """
    if name in NETWORK_NAMES:
        raise ParameterError(
            f"'{name}' is a network, not a solver: `mwdn.networks.build('{name}')` builds it without weights, "
            "`mwdn.load_network(path)` loads a trained one."
        )
    if name not in SOLVERS:
        raise UnknownNameError("solver", name, SOLVERS)
    check_options(SOLVERS[name], f"the solver '{name}'", options)
    check_complete(SOLVERS[name], f"the solver '{name}'", options)
    with plugin_errors(name, SOLVERS[name]):
        return SOLVERS[name](**options)


__all__ = [
    "SOLVERS",
    "TEXTBOOK",
    "Admm",
    "Fista",
    "Penalties",
    "Pose",
    "Pyramid",
    "Solver",
    "WarmStart",
    "Wiener",
    "align",
    "build",
    "noise_level",
]

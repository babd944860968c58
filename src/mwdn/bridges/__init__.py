"""Bridges to other libraries: scipy, DeepInverse.

Each name is imported at its first use, and with it the library that it needs.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from mwdn.bridges.deepinverse import DeepInverseSolver, LenslessPhysics
    from mwdn.bridges.linear_operator import linear_operator

__all__ = ["DeepInverseSolver", "LenslessPhysics", "linear_operator"]

_MODULES = {
    "DeepInverseSolver": "deepinverse",
    "LenslessPhysics": "deepinverse",
    "linear_operator": "linear_operator",
}
"""Modules that hold the public names."""


def __getattr__(name: str) -> Any:  # noqa: ANN401
    """Import a public name at its first use (PEP 562)."""
    if name not in _MODULES:
        raise AttributeError(f"module 'mwdn.bridges' has no attribute '{name}'")
    value = globals()[name] = getattr(import_module(f"mwdn.bridges.{_MODULES[name]}"), name)
    return value

"""Bridges to other libraries: scipy, DeepInverse, SCICO, the Hugging Face hub, bioimage.io, napari.

Each name is imported at its first use, and with it the library that it needs.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from mwdn.bridges.bioimage import export_bioimage
    from mwdn.bridges.deepinverse import DeepInverseSolver, LenslessPhysics
    from mwdn.bridges.huggingface import from_pretrained, save_pretrained
    from mwdn.bridges.linear_operator import linear_operator
    from mwdn.bridges.scico import scico_operator

__all__ = [
    "DeepInverseSolver",
    "LenslessPhysics",
    "export_bioimage",
    "from_pretrained",
    "linear_operator",
    "save_pretrained",
    "scico_operator",
]

_MODULES = {
    "DeepInverseSolver": "deepinverse",
    "LenslessPhysics": "deepinverse",
    "export_bioimage": "bioimage",
    "from_pretrained": "huggingface",
    "linear_operator": "linear_operator",
    "save_pretrained": "huggingface",
    "scico_operator": "scico",
}
"""Modules that hold the public names."""


def __getattr__(name: str) -> Any:  # noqa: ANN401
    """Import a public name at its first use (PEP 562)."""
    if name not in _MODULES:
        raise AttributeError(f"module 'mwdn.bridges' has no attribute '{name}'")
    value = globals()[name] = getattr(import_module(f"mwdn.bridges.{_MODULES[name]}"), name)
    return value

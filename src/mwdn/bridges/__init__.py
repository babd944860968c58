"""Bridges to other libraries: scipy, DeepInverse, SCICO, the Hugging Face hub, bioimage.io, napari.

Each name is imported at its first use, and with it the library that it needs.
"""

from typing import TYPE_CHECKING

from mwdn.first_use import at_first_use

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

__getattr__ = at_first_use(__name__, _MODULES)

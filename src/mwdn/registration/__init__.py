"""Where displayed pictures are in a camera's reconstructions, and aligned pairs for training."""

from mwdn.registration.captured import SessionPairs
from mwdn.registration.estimate import Registered, estimate, through_corners
from mwdn.registration.outline import find_outline
from mwdn.registration.projection import Projection
from mwdn.registration.registration import Place, read_projection
from mwdn.registration.views import Views
from mwdn.registration.warp import warp_pictures

__all__ = [
    "Place",
    "Projection",
    "Registered",
    "SessionPairs",
    "Views",
    "estimate",
    "find_outline",
    "read_projection",
    "through_corners",
    "warp_pictures",
]

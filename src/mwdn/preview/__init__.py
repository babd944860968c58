"""A page and an HTTP interface that reconstruct captures, for people and programs."""

from mwdn.preview.cameras import StoredCameras
from mwdn.preview.limits import Limits
from mwdn.preview.server import PreviewServer, make_server

__all__ = ["Limits", "PreviewServer", "StoredCameras", "make_server"]

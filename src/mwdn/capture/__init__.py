"""Cameras, the display in front of them, and sessions that record pairs."""

from mwdn.capture.source import CameraSource, Frame
from mwdn.capture.sources import SOURCES, Kind, open_source

__all__ = ["SOURCES", "CameraSource", "Frame", "Kind", "open_source"]

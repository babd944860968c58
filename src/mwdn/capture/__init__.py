"""Cameras, the display in front of them, and sessions that record pairs."""

from mwdn.capture.source import CameraFrame, CameraSource
from mwdn.capture.sources import SOURCES, Kind, open_source

__all__ = ["SOURCES", "CameraFrame", "CameraSource", "Kind", "open_source"]

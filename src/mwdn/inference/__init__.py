"""Reconstruction of measurements, streams of frames and folders of captures."""

from mwdn.inference.reconstructor import Reconstructor

__all__ = ["Reconstructor"]

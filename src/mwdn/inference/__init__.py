"""Reconstruction: a method bound to a camera, a stream of frames, a folder of captures."""

from mwdn.inference.reconstructor import Reconstructor

__all__ = ["Reconstructor"]

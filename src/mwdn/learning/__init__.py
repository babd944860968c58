"""Checkpoints of networks."""

from mwdn.learning.checkpoint import load_network, save_network

__all__ = ["load_network", "save_network"]

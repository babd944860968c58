"""Losses, and checkpoints of networks."""

from mwdn.learning.alexnet import load_alexnet, load_heads
from mwdn.learning.checkpoint import load_network, save_network
from mwdn.learning.losses import Loss

__all__ = ["Loss", "load_alexnet", "load_heads", "load_network", "save_network"]

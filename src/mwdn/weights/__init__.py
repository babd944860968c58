"""Trained weights: checkpoints, the bundled networks, the files of the paper's authors."""

from mwdn.weights.bundled import BUNDLED, find_weights, load_network
from mwdn.weights.checkpoint import load_checkpoint, save_network

__all__ = ["BUNDLED", "find_weights", "load_checkpoint", "load_network", "save_network"]

"""The bundled network that estimates the light of a room where a capture is known to have some."""

from functools import lru_cache

import torch

from mwdn.networks.room_light import RoomLightUNet, clues
from mwdn.types import Measurement, Psf
from mwdn.weights.bundled import bundled_file
from mwdn.weights.tensors import fill, read_header, read_tensors


@torch.no_grad()
def estimate_room_light(b: Measurement, psf: Psf) -> Measurement:
    """Smooth light in captures of at most `mwdn.solvers.room_light.PIXELS` pixels.

    Args:
        b: (B, C, h, w), each colour of mean 1, nearly.
        psf: (B, C, h, w), centred, of sum 1.

    Returns:
        (B, C, h, w), not negative.
    """
    unit = b.mean((-2, -1), keepdim=True).clamp(min=torch.finfo(torch.float32).tiny)
    return (_network(b.device)(clues(b / unit, psf)) * unit).clamp(min=0)


@lru_cache(maxsize=4)
def _network(device: torch.device) -> RoomLightUNet:
    path = bundled_file("room-light")
    network = RoomLightUNet().float()
    fill(network, read_tensors(path, read_header(path)), f"`{path}`")
    return network.requires_grad_(False).to(device)

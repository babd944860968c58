"""Mean of a network's results for a measurement and its mirror images."""

from typing import Generic

import torch

from mwdn.inference.engine import Engine
from mwdn.networks.network import Prepared
from mwdn.optics.orientation import Orientation, turn
from mwdn.types import Measurement, Psf, Scene

MIRRORS: dict[Orientation, tuple[int, ...]] = {
    "flip-left-right": (-1,),
    "flip-top-bottom": (-2,),
    "rotate-180": (-2, -1),
}
"""Turns that keep height and width, and the axes that they reverse."""


class Ensemble(Generic[Prepared]):
    """An engine that is applied four times: as it is, and with both measurement and PSF mirrored.

    A mirrored camera takes the mirrored capture of the mirrored scene, ``R d = crop(R h * R x)``, so the four results,
    mirrored back, estimate the same scene. Their mean has less of the errors that depend on direction: with ``s`` one
    of the four,

        E |mean - x|^2 = E |s - x|^2 - E |s - mean|^2

    so on average over the four the mean is never worse.

    Args:
        engine: of the network and PSF.
    """

    def __init__(self, engine: Engine[Prepared]) -> None:
        self.engine = engine
        self.precision = engine.precision
        self.mirrored = {axes: engine.with_psf(turn(engine.psf, name)) for name, axes in MIRRORS.items()}

    def with_psf(self, psf: Psf) -> "Ensemble[Prepared]":
        """An ensemble with another PSF that shares the network and its weights."""
        return Ensemble(self.engine.with_psf(psf))

    @torch.inference_mode()
    def __call__(self, measurement: Measurement) -> Scene:
        """Reconstruct a batch, (B, C, H, W), on the device of the PSF."""
        total = self.engine(measurement)
        for axes, engine in self.mirrored.items():
            total = total + engine(measurement.flip(axes)).flip(axes)
        return total / (1 + len(self.mirrored))

"""Warm starts for streams: the iterations for each frame begin at the last iterate of the one before."""

from dataclasses import replace
from typing import Any

import torch

from mwdn.arguments import check_at_least, check_batch, checked
from mwdn.solvers.admm import Admm
from mwdn.solvers.fista import Fista
from mwdn.solvers.levels import root_mean_square
from mwdn.types import Measurement, Psf, Scene

CUT = 4.0
"""Ratio of brightness to the frame before beyond which the iterations start from zero."""


@checked
class WarmStart:
    """A solver with all its iterations for the first frame of a stream, and a few for each that follows.

    Warm starts converge faster than starts from zero when the scene moves slowly; after a cut, the new scene takes a
    few frames to appear. A frame of another shape or PSF is a first frame, and so is one more than `CUT` times as
    bright or dark as the frame before: noise of a dark frame would take tens of frames to go. So is the next one after
    a result that is not finite.

    Args:
        solver: whose last iterate is kept from frame to frame: several times the memory of the scene.
        iterations: for each frame but the first.

    Raises:
        ParameterError: ``iterations`` is below 1.
    """

    def __init__(self, solver: Admm | Fista, *, iterations: int = 10) -> None:
        check_at_least(1, iterations=iterations)
        self.first, self.following = solver, replace(solver, iterations=iterations)
        self.shape, self.psf, self.last, self.brightness = torch.Size(), torch.empty(0), None, torch.empty(0)

    def __call__(self, measurement: Measurement, psf: Psf) -> Scene:
        """Reconstruct the next frame, or a batch of frames of as many streams."""
        check_batch(measurement, "measurement")
        light = root_mean_square(measurement)
        warm = self.last is not None and psf is self.psf and measurement.shape == self.shape
        warm = warm and bool(((light < CUT * self.brightness) & (self.brightness < CUT * light)).all())
        solver: Any = self.following if warm else self.first
        scene, last = solver.solve(measurement, psf, self.last if warm else None)
        self.last = last if scene.isfinite().all() else None
        self.shape, self.psf, self.brightness = measurement.shape, psf, light
        return scene

"""A solver for streams: each frame begins where the last one ended."""

from dataclasses import replace
from typing import Any

import torch

from mwdn.errors import ParameterError
from mwdn.solvers.admm import Admm
from mwdn.solvers.fista import Fista
from mwdn.types import Measurement, Psf, Scene


class WarmStart:
    """A solver that takes all its iterations for the first frame of a stream, and a few for each that follows.

    A scene that moves slowly is then nearer to where the iterations would end than as many come from darkness; another
    scene takes a few frames to appear. A frame of another shape, or by another PSF, is a first one, and so is the next
    one after a scene that is not finite.

    Args:
        solver: whose state is kept from frame to frame: several times the memory of the scene.
        iterations: for each frame but the first.

    Raises:
        ParameterError: no iteration is asked for.
    """

    def __init__(self, solver: Admm | Fista, *, iterations: int = 10) -> None:
        if iterations < 1:
            raise ParameterError(f"`iterations` ({iterations}) must be at least 1.")
        self.solver, self.brief = solver, replace(solver, iterations=iterations)
        self.shape, self.psf, self.last = torch.Size(), torch.empty(0), None

    def __call__(self, measurement: Measurement, psf: Psf) -> Scene:
        """Reconstruct the next frame, or batch of frames of as many streams."""
        goes_on = self.last is not None and psf is self.psf and measurement.shape == self.shape
        solver: Any = self.brief if goes_on else self.solver
        scene, reached = solver.follow(measurement, psf, self.last if goes_on else None)
        self.last = reached if scene.isfinite().all() else None
        self.shape, self.psf = measurement.shape, psf
        return scene

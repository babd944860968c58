"""The part of a capture that no scene explains, at the coarse size of the search in `mwdn.solvers.light_spot`."""

import torch
from torch import Tensor

from mwdn.runtime.iterations import iterations
from mwdn.solvers.splitting import Penalties, Problem, initial_state, make_filters, update_copies, update_scene
from mwdn.types import Measurement, Psf

ITERATIONS = 40
"""ADMM iterations for each scene. With 20 the best scenes are not reached."""

BACKGROUND_STEP = 0.05
"""Step of the finite differences of the background, as a part of the mean measurement."""

_PENALTIES = Penalties(0.15, 0.0, 0.6)


def unexplained(b: Measurement, psf: Psf, saturated: Tensor) -> Tensor:
    """``b - C H v`` with the best scene ``v >= 0`` after `ITERATIONS` from a dark one: (B, C, pixels).

    Args:
        b: (B, C, h, w), of mean 1, less a background.
        psf: (B, C, h, w).
        saturated: (B, C, h, w), bool: there the light was at least b, and a brighter scene contradicts nothing.
    """
    planes, h = b.reshape(-1, 1, *b.shape[-2:]), psf.reshape(-1, 1, *psf.shape[-2:])
    norm = h.square().sum((-2, -1), keepdim=True).sqrt()  # the penalties are for a PSF of unit norm
    saturated = saturated.reshape(planes.shape)
    problem = Problem.from_psf(planes, h / norm)._replace(saturated=saturated)
    filters, state = make_filters(problem, _PENALTIES, smooth=False), initial_state(problem, smooth=False)
    for _ in iterations(ITERATIONS):
        state = update_scene(update_copies(state, problem, _PENALTIES, 0.0, "colour"), problem, filters)
    r = planes - state.Hv
    return torch.where(saturated, r.clamp(min=0), r).reshape(*b.shape[:2], -1)


def energy(r: Tensor) -> Tensor:
    """Mean square (B,) of what is unexplained (B, C, pixels), over all colours."""
    return r.square().mean((1, 2))


def differences(b: Measurement, psf: Psf, saturated: Tensor, lights: Tensor) -> Tensor:
    """Derivatives (B, T, pixels) of `unexplained` of the mean colour by each light (T, h, w), as finite differences."""
    trials = b.mean(1, keepdim=True) - BACKGROUND_STEP * torch.cat([torch.zeros_like(lights[:1]), lights])
    psf, saturated = psf.mean(1, keepdim=True), saturated.any(1, keepdim=True)
    r = unexplained(trials, *(each.expand(-1, trials.shape[1], -1, -1) for each in (psf, saturated)))
    return (r[:, 1:] - r[:, :1]) / BACKGROUND_STEP

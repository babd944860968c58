"""Whether the scenes of pairs are linear in light: the camera that recorded them may have encoded them for viewing."""

from collections.abc import Callable, Iterable
from itertools import islice
from statistics import fmean

from mwdn.calibration.pair_model import PairModel, Terms
from mwdn.types import Measurement, Psf, Scene

GAMMAS = (1.0, 1.4, 1.8, 2.2)
"""Powers that are tried; 1 is linear, 2.2 about sRGB."""

MAX_PAIRS = 10
"""Pairs that are examined, the first ones."""

MIN_DECREASE = 0.1
"""Relative decrease of the unexplained part from which a gamma is accepted."""

CLIPPED = 0.02
"""Part of a scene's pixels at its maximum from which it counts as clipped. Clipping bends a scene as a gamma does."""


def unexplained_by_gamma(
    psf: Psf, pairs: Callable[[], Iterable[tuple[Measurement, Scene]]]
) -> dict[float, tuple[float, ...]]:
    """Part of each measurement that its scene, decoded with each of `GAMMAS`, leaves unexplained.

    The measurement is linear in light. So if the scene is encoded as light to the power 1 / gamma, its PSF explains the
    measurement best after the scene is raised to the power gamma.

    Args:
        psf: (1, C, H, W), of the calibration.
        pairs: reads the pairs, (1, C, H, W) each; called once for each gamma. Pairs with clipped scenes are left out.
    """
    chosen = [number for number, (_, v) in enumerate(islice(pairs(), MAX_PAIRS)) if not _is_clipped(v)]
    if not chosen:
        return dict.fromkeys(GAMMAS, ())
    return {gamma: _unexplained(psf, pairs(), chosen, gamma) for gamma in GAMMAS}


def scene_gamma(unexplained: dict[float, tuple[float, ...]]) -> float | None:
    """The gamma that explains the pairs best; ``None`` if there is no evidence that they are not linear."""
    linear = unexplained[1.0]
    if not linear:
        return None
    best = min(unexplained, key=lambda gamma: fmean(unexplained[gamma]))
    wins = sum(decoded < plain for decoded, plain in zip(unexplained[best], linear, strict=True))
    return best if fmean(unexplained[best]) < (1 - MIN_DECREASE) * fmean(linear) and wins > len(linear) / 2 else None


def _is_clipped(scene: Scene) -> bool:
    return float((scene >= 0.995 * scene.amax((-2, -1), keepdim=True)).float().mean()) > CLIPPED


def _unexplained(
    psf: Psf, pairs: Iterable[tuple[Measurement, Scene]], chosen: list[int], gamma: float
) -> tuple[float, ...]:
    decoded = ((b, v.clamp(min=0) ** gamma) for number, (b, v) in enumerate(pairs) if number in chosen)
    model = PairModel(psf, islice(decoded, len(chosen)), moves=False)
    return tuple(model.unexplained(model.start(Terms()), pair) for pair in range(len(model)))

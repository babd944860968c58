"""Whether the scenes of pairs are linear in light: a lens camera may encode them for viewing, or clip bright parts."""

from collections.abc import Callable, Iterable
from itertools import islice
from statistics import fmean

from mwdn.calibration.pair_model import PairModel, Terms
from mwdn.types import Measurement, Psf, Scene

GAMMAS = (1.0, 1.2, 1.4, 1.6, 1.8, 2.0, 2.2)
"""Powers that are tried; 1 is linear, 2.2 about sRGB."""

MOST_PAIRS = 10
"""Pairs that are examined; each takes a second at 270 x 480."""

LEAST = 0.05
"""Relative decrease of the unexplained part that speaks for a gamma."""


def unexplained_by_gamma(
    psf: Psf, pairs: Callable[[], Iterable[tuple[Measurement, Scene]]]
) -> dict[float, tuple[float, ...]]:
    """Part of each measurement that its scene, decoded with each of `GAMMAS`, leaves unexplained.

    The measurement is linear in light. So if the scene is encoded as light to the power 1 / gamma, its PSF explains the
    measurement best after the scene is raised to the power gamma.

    Args:
        psf: (1, C, H, W), of the calibration.
        pairs: reads the pairs, (1, C, H, W) each; called once for each gamma.
    """
    models = (
        PairModel(psf, ((b, v.clamp(min=0) ** gamma) for b, v in islice(pairs(), MOST_PAIRS))) for gamma in GAMMAS
    )
    parts = (tuple(model.unexplained(model.start(Terms()), pair) for pair in range(len(model))) for model in models)
    return dict(zip(GAMMAS, parts, strict=True))


def scene_gamma(unexplained: dict[float, tuple[float, ...]]) -> float | None:
    """The gamma that explains the pairs best; ``None`` if they are linear as far as can be told."""
    linear = unexplained[1.0]
    best = min(unexplained, key=lambda gamma: fmean(unexplained[gamma]))
    wins = sum(decoded < plain for decoded, plain in zip(unexplained[best], linear, strict=True))
    return best if fmean(unexplained[best]) < (1 - LEAST) * fmean(linear) and wins > len(linear) / 2 else None

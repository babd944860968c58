"""Find where displayed pictures lie in reconstructions of their captures: start, refine, check."""

from collections.abc import Iterator
from contextlib import suppress
from typing import NamedTuple

import numpy as np

from mwdn.errors import AlignmentError, ShapeError
from mwdn.registration.correlation import Refined, correlation_at, refine
from mwdn.registration.features import match_features
from mwdn.registration.markers import match_markers
from mwdn.registration.point_fit import correct, fit_points
from mwdn.registration.projection import Points, Projection, picture_corners
from mwdn.registration.residuals import Residuals, measure_residuals
from mwdn.registration.search import search
from mwdn.registration.views import Views
from mwdn.types import Size

SURE_CORRELATION = 0.8
"""Correlation after coarse refinement at which no other start is tried. Wrong turns and mirror images of ordinary
pictures reach 0.75, because their dark surround is right."""

WORST = 0.6
"""Smallest correlation that is accepted."""

WORST_PX = 1.5
"""Largest residual that is accepted; for large pictures 2 % of their side."""

MAX_OUTSIDE = 0.5
"""Largest share of the picture outside of the camera's frame that is accepted."""

_CLOSE = 0.04
"""Starts whose correlation is this close to the best after coarse refinement are compared again in detail."""

_AMBIGUOUS = 0.05
"""Part by which the unexplained ``1 - correlation`` of the best start must be lower than that of the next."""

_FEW = 4
_MIN_PARTS = 4
_ENOUGH_PARTS = 12
"""Fewest parts that separate shading from a displacement of the whole: 24 numbers for the 8 of a homography."""

_ROUNDS = 2


class Registered(NamedTuple):
    """A projection, and how well it fits.

    Args:
        projection: from the displayed pictures to the reconstructions.
        correlation: of the square roots of both, 0 to 1.
        residuals: displacements of parts of the picture from where the projection puts them.
        start: method that found it: "markers", "features", "search" or "points".
    """

    projection: Projection
    correlation: float
    residuals: Residuals
    start: str

    def content(self) -> dict[str, object]:
        """For JSON: the projection's own numbers, and how well it fits."""
        return {
            **self.projection.to_dict(),
            "start": self.start,
            "correlation": round(self.correlation, 4),
            "residual_px": round(self.residuals.rms_px, 3),
            "parts": len(self.residuals.points),
        }


def estimate(views: Views, *, corners: Points | None = None) -> Registered:
    """Estimate the projection from displayed pictures to reconstructions.

    Markers of a board, features (SIFT), or a search over all places, sizes, turns and mirrorings give a start. The
    correlation over all pictures then refines it (ECC), and the displacements of the picture's parts correct what
    shading and the picture's border have displaced. They decide about a radial term, see `correct`.

    Args:
        views: pictures and reconstructions; more pictures give a better estimate.
        corners: (4, 2), pixels of the camera where the picture's corners are, from its own top left clockwise, to start
            from instead.

    Raises:
        AlignmentError: no start leads to a fit, several fit equally well, or the fit is bad.
    """
    few = views.first(_FEW)
    tried: list[tuple[Refined, str]] = []
    for start, name in _starts(few, views, corners):
        tried.append((refine(start, few, blurs=(4.0, 2.0)), name))
        if name != "search" and tried[-1][0].correlation > SURE_CORRELATION:
            break
    result, name = _single(tried, few)
    result = refine(result.projection, views, blurs=(2.0, 1.0))
    projection, residuals = _through_parts(result.projection, views)
    result = Refined(projection, correlation_at(projection, views, robust=True))
    _check(result, residuals)
    return Registered(result.projection, result.correlation, residuals, name)


def through_corners(corners: Points, picture_size: Size, camera_size: Size) -> Projection:
    """The projection that puts the picture's corners, from its own top left clockwise, to these pixels (4, 2).

    Raises:
        ShapeError: they are not four points.
        AlignmentError: three of them lie on a line.
    """
    corners = np.asarray(corners, np.float64)
    if corners.shape != (4, 2):
        raise ShapeError(f"`corners` {corners.shape} must be four points (4, 2): x to the right and y down, in pixels.")
    return fit_points(
        picture_corners(picture_size), corners, picture_size=picture_size, camera_size=camera_size
    ).projection


def _starts(few: Views, views: Views, corners: Points | None) -> Iterator[tuple[Projection, str]]:
    """Projections to start from, the quickest first."""
    if corners is not None:
        yield through_corners(corners, views.picture_size, views.camera_size), "points"
        return
    yield from ((start, "markers") for start in match_markers(few))
    yield from ((start, "features") for start in match_features(views))
    yield from ((start, "search") for start in search(few))


def _single(tried: list[tuple[Refined, str]], few: Views) -> tuple[Refined, str]:
    """The best start, by fine detail: patterns such as boards look alike in all turns when they are blurred.

    Raises:
        AlignmentError: the picture looks the same turned or mirrored.
    """
    best = max(each.correlation for each, _ in tried)
    close = [(each, name) for each, name in tried if best - each.correlation < _CLOSE]
    if len(close) > 1:
        detailed = [(refine(each.projection, few, blurs=(1.0,)).projection, name) for each, name in close]
        close = [(Refined(each, correlation_at(each, few)), name) for each, name in detailed]
    result, name = max(close, key=lambda each: each[0].correlation)
    corners = result.projection.corners()
    size = float(np.ptp(corners, axis=0).max())
    for other, _ in close:
        is_other = np.abs(other.projection.corners() - corners).max() > 0.2 * size
        if is_other and result.correlation - other.correlation < _AMBIGUOUS * (1 - other.correlation):
            raise AlignmentError(
                "The displayed picture fits the reconstruction in several ways: it was not on the display, or it looks "
                "the same turned or mirrored. Check that picture and capture belong together, show a picture without "
                "symmetry, or give its corners: `--points`."
            )
    return result, name


def _through_parts(projection: Projection, views: Views) -> tuple[Projection, Residuals]:
    """Fit the projection to the positions of the picture's parts in the reconstructions; also returns the residuals."""
    residuals = measure_residuals(projection, views)
    for _ in range(_ROUNDS):
        if len(residuals.points) < _ENOUGH_PARTS:
            break
        with suppress(AlignmentError):  # the parts are scattered by more than the tolerance: `_check` refuses them
            seen = residuals.seen + residuals.displacements
            moved = correct(projection, residuals.points, seen, errors=residuals.errors)
            left = measure_residuals(moved, views)
            if left.rms_px < residuals.rms_px:
                projection, residuals = moved, left
    return projection, residuals


def _check(result: Refined, residuals: Residuals) -> None:
    """Refuse a bad fit."""
    way_out = "Check that the picture was on the display, or give its corners: `--points`."
    if result.correlation < WORST:
        raise AlignmentError(
            f"The displayed picture was not found in the reconstruction: their correlation is {result.correlation:.2f} "
            f"and must be {WORST:g} at least. {way_out}"
        )
    if len(residuals.points) < _MIN_PARTS:
        raise AlignmentError(
            f"Parts of the picture that can be placed: {len(residuals.points)}, and {_MIN_PARTS} are needed. "
            f"Use more pictures, or one with more detail. {way_out}"
        )
    if result.projection.outside > MAX_OUTSIDE:
        raise AlignmentError(
            f"{result.projection.outside:.0%} of the picture lies outside of the camera's frame, and at most "
            f"{MAX_OUTSIDE:.0%} may. Show a smaller one, or turn the camera to it. {way_out}"
        )
    corners = result.projection.corners()
    most = max(WORST_PX, 0.02 * float(np.ptp(corners, axis=0).max()))
    if residuals.rms_px > most:
        raise AlignmentError(
            f"The fit is off by {residuals.rms_px:.1f} px, and must be within {most:.1f} px. {way_out}"
        )

"""Check that a session is continued as it was begun: pairs of different settings are not one data set."""

import json
import math
from dataclasses import asdict
from typing import Any

from mwdn.capture.captured_pairs import SessionFile
from mwdn.capture.recipe import CaptureRecipe
from mwdn.capture.screen import Place, Screen
from mwdn.capture.source import CameraFrame
from mwdn.errors import ParameterError

ROUNDING = 0.01
"""Relative difference of settings that count as equal: cameras round them, and people a measured gamma."""

_ROUNDED = ("exposure_s", "gain", "gamma")


def describe_place(screen: Screen, place: Place) -> dict[str, Any]:
    """Attributes of a file for its display, and the place of the pictures on it."""
    return {**asdict(screen), **{f"place_{name}": value for name, value in asdict(place).items()}}


def check_continued(
    pairs: SessionFile, recipe: CaptureRecipe, first: CameraFrame, screen: Screen, place: Place
) -> None:
    """Check that a file was begun with this display, place, pictures, kind of frames, exposure, gain, gamma and rig.

    Args:
        pairs: the file.
        recipe: of the session; without a gamma, the file's is used.
        first: frame of a dark display, as the camera is set now.
        screen: the display.
        place: of the pictures on it.

    Raises:
        ParameterError: something differs.
    """
    stored = {**pairs.attributes, **pairs.kinds}
    now = {
        **describe_place(screen, place),
        "scene": (*recipe.pictures.size, 3, "uint16"),
        "measurement": (*first.array.shape, str(first.array.dtype)),
        "bit_depth": first.bit_depth,
        "mosaic": first.mosaic or "",
    }
    if pairs.has_pattern("grey"):  # whose first step is a dark display; before it nothing is recorded
        stored |= {**pairs.first_settings("patterns/grey"), "gamma": stored.get("display_gamma")}
        now |= {"exposure_s": first.exposure_s, "gain": first.gain, "gamma": recipe.display.gamma or stored["gamma"]}
    begun = json.loads(stored.get("recipe", "{}")).get("rig", {})
    if recipe.display.kind == "rig" and "seed" in begun:  # another seed is another camera
        stored, now = stored | {"rig.seed": begun["seed"]}, now | {"rig.seed": recipe.rig.seed}
    for name, value in now.items():
        if not _is_same(stored.get(name), value, ROUNDING if name in _ROUNDED else 0.0):
            raise ParameterError(
                f"`{pairs.path}` was begun with `{name}` {_shown(stored.get(name))}, but now it is {_shown(value)}. "
                "Set it as it was, or start a new file: `out`."
            )


def _is_same(a: object, b: object, tolerance: float) -> bool:
    if isinstance(a, float) and isinstance(b, float):
        return math.isclose(a, b, rel_tol=tolerance) or (math.isnan(a) and math.isnan(b))
    return bool(a == b)


def _shown(value: object) -> str:
    if isinstance(value, float):
        return "unknown" if math.isnan(value) else f"{value:.4g}"
    return str(value)

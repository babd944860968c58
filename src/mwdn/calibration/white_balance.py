"""White balance: gains of the colours of a finished picture."""

from typing import Literal

import torch
from torch import Tensor

from mwdn.arguments import fits_type
from mwdn.errors import ParameterError, shown
from mwdn.types import Scene

WhiteBalance = Literal["grey-world", "psf"] | tuple[float, float, float]
"""``"grey-world"``: the picture's mean becomes grey. ``"psf"``: the point source of the PSF becomes white. Three
numbers: gains of red, green and blue; ``(1, 1, 1)`` for none."""

MAX_GAIN = 1000
"""Largest gain, and inverse of the smallest: their ratios stay far within float32."""


def check_white_balance(balance: WhiteBalance | None, light: tuple[float, ...]) -> None:
    """Check that a white balance is possible for a camera.

    Args:
        balance: the white balance: a name, or gains by which red, green and blue are multiplied.
        light: of the point source in each channel, see `mwdn.Calibration`.

    Raises:
        ParameterError: the name is unknown; there are not three gains, or one is not positive; or ``"psf"`` is asked
            for and the colour of the point source is not known.
    """
    if balance is None or balance == "grey-world":
        return
    if balance == "psf":
        if len(light) != 3:
            reason = "grey" if light else "an array without its file's light"
            raise ParameterError(
                f"`white_balance` 'psf' needs a PSF in colour, but this one is {reason}. Use 'grey-world', or gains: "
                "`white_balance=(1.8, 1, 1.5)`."
            )
        return
    is_possible = fits_type(balance, tuple[float, float, float]) and all(
        1 / MAX_GAIN <= gain <= MAX_GAIN for gain in balance
    )
    if not is_possible:
        raise ParameterError(
            f"`white_balance` ({shown(balance)}) must be 'grey-world', 'psf', or three positive gains of red, green "
            f"and blue, {MAX_GAIN:g} at most: `white_balance=(1.8, 1, 1.5)`."
        )


def apply_white_balance(scene: Scene, balance: WhiteBalance, light: tuple[float, ...]) -> Scene:
    """Multiply each colour of each picture by its gain, that of green being 1; grey pictures stay as they are.

    Args:
        scene: (B, C, H, W), linear light. Its camera's colours: never compare the result with a measurement.
        balance: checked by `check_white_balance`.
        light: as there.

    References:
        Grey world: G. Buchsbaum, "A spatial processor model for object colour perception", Journal of the Franklin
        Institute 310, 1-26 (1980). Negative pixels, which only noise causes, count as 0.
    """
    if scene.shape[1] != 3:
        return scene
    if balance == "grey-world":
        gains = _inverse(scene.clamp(min=0).mean((-2, -1)))
    elif balance == "psf":
        gains = _inverse(torch.tensor([light]))
    else:
        gains = torch.tensor([balance]) / balance[1]
    return scene * gains.to(scene)[..., None, None]


def _inverse(colour: Tensor) -> Tensor:
    """Gains (B, 3) that make the colour grey; 1 where there is no light."""
    gains = colour[:, 1:2] / colour
    return torch.where(gains.isfinite() & (gains > 0), gains, torch.ones_like(gains))

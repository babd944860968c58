"""What is compared, under which protocol, by which numbers, and how sure they are."""

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import torch
from torch import Tensor

from mwdn.errors import CheckpointError, ParameterError, ShapeError
from mwdn.evaluation import distances
from mwdn.evaluation.alexnet import AlexNet, Heads, load_alexnet, load_heads
from mwdn.types import Image

Variant = Literal["raw", "clipped", "best-gain"]
"""What is done to a reconstruction, after the crop and before it is compared.

- ``raw``: nothing.
- ``clipped``: clipped to [0, 1], as every picture is that somebody looks at.
- ``best-gain``: one gain and one offset a picture, by least squares over all its pixels and colours; not clipped.
  For methods and data whose absolute brightness means nothing.
"""

VARIANTS = ("raw", "clipped", "best-gain")

METRICS = ("psnr", "ssim", "lpips", "feature_mse", "mse")
"""What `measure` gives, in the order of tables."""

LARGER_IS_BETTER = frozenset({"psnr", "ssim"})


@dataclass(frozen=True)
class Protocol:
    """The part of each picture that is compared.

    Args:
        name: as `parse` understands it.
        centre: side of the central square, or ``None``.
        rows: first row and the row after the last, or ``None``.
        columns: likewise.
    """

    name: str = "full"
    centre: int | None = None
    rows: tuple[int, int] | None = None
    columns: tuple[int, int] | None = None

    @classmethod
    def parse(cls, text: str) -> "Protocol":
        """Read a protocol's name.

        Args:
            text: ``full``; ``centre-128``, the paper's, or another side; or rows and columns, the end excluded,
                such as ``60:270,60:440``, the region of interest of DiffuserCam.

        Raises:
            ParameterError: none of these, or a part without pixels.
        """
        name = text.replace(" ", "")
        if name == "full":
            return cls()
        if (match := re.fullmatch(r"centre-(\d+)", name)) and int(match[1]) > 0:
            return cls(name, centre=int(match[1]))
        if match := re.fullmatch(r"(\d+):(\d+),(\d+):(\d+)", name):
            top, bottom, left, right = map(int, match.groups())
            if top < bottom and left < right:
                return cls(name, rows=(top, bottom), columns=(left, right))
        raise ParameterError(
            f"`protocol` ('{text}') must be full, centre-128 (or another side), or rows and columns with a start "
            "below the end: `--protocol 60:270,60:440`."
        )

    @property
    def variant(self) -> Variant:
        """The one that goes with it unless another is asked for: the paper's central part is not clipped."""
        return "raw" if self.centre else "clipped"

    def crop(self, image: Image) -> Tensor:
        """Cut out the part that is compared, as a view.

        Raises:
            ShapeError: it does not lie inside the picture.
        """
        height, width = image.shape[-2:]
        rows, columns = self.rows or (0, height), self.columns or (0, width)
        if self.centre:
            top, left = (height - self.centre) // 2, (width - self.centre) // 2
            rows, columns = (top, top + self.centre), (left, left + self.centre)
        if rows[0] < 0 or columns[0] < 0 or rows[1] > height or columns[1] > width:
            raise ShapeError(
                f"The protocol '{self.name}' must lie inside the pictures ({height} x {width}). Choose a smaller "
                "part: `--protocol full`."
            )
        return image[..., rows[0] : rows[1], columns[0] : columns[1]]


@dataclass(frozen=True)
class Perceptual:
    """The networks behind `lpips` and `feature_mse`, as far as they can be had.

    Args:
        alexnet: for both.
        heads: for `lpips` alone.
        missing: metrics that cannot be measured, and why.
    """

    alexnet: AlexNet | None
    heads: Heads | None
    missing: dict[str, str]

    @classmethod
    def load(cls, alexnet: str | Path | None = None, heads: str | Path | None = None) -> "Perceptual":
        """Find or download the weights; what cannot be had goes to ``missing`` with its reason.

        Args:
            alexnet: file of AlexNet's weights; see `mwdn.evaluation.alexnet.load_alexnet`.
            heads: file of LPIPS's heads; see `mwdn.evaluation.alexnet.load_heads`.
        """
        try:
            features = load_alexnet(alexnet)
        except CheckpointError as error:
            return cls.none(str(error))
        try:
            return cls(features, load_heads(heads, alexnet=alexnet), {})
        except CheckpointError as error:
            return cls(features, None, {"lpips": str(error)})

    @classmethod
    def none(cls, reason: str = "not asked for") -> "Perceptual":
        """Neither network."""
        return cls(None, None, dict.fromkeys(("lpips", "feature_mse"), reason))


def psnr(image: Image, reference: Image) -> Tensor:
    """Peak signal-to-noise ratio of each sample in dB, for a peak of 1.

    Args:
        image: (B, C, H, W), any range.
        reference: of the same shape.

    Returns:
        (B,); 6.02 dB more for half the error, infinite for identical pictures.

    Raises:
        ShapeError: the shapes differ.
    """
    return -10 * torch.log10(distances.mse(image, reference))


def best_gain(image: Image, reference: Image) -> Image:
    """Each picture times one gain plus one offset, so that its squared error is the least; nothing is clipped.

    An even picture becomes the mean of its reference. The gain may be negative.

    Args:
        image: (B, C, H, W), any range.
        reference: of the same shape.
    """
    axes = (1, 2, 3)
    mean, target = image.mean(axes, keepdim=True), reference.mean(axes, keepdim=True)
    deviation = image - mean
    power = deviation.square().sum(axes, keepdim=True)
    product = (deviation * (reference - target)).sum(axes, keepdim=True)
    return deviation * torch.where(power > 0, product / power, 0) + target


@torch.no_grad()
def measure(
    reconstruction: Image,
    scene: Image,
    protocol: Protocol,
    *,
    variant: Variant | None = None,
    perceptual: Perceptual | None = None,
) -> dict[str, Tensor]:
    """Compare reconstructions with their scenes.

    Numbers are compared as they are: of scenes in linear light, LPIPS and SSIM are not those of sRGB pictures, in which
    papers give them.

    Args:
        reconstruction: (B, C, H, W), in the numbers of the scene.
        scene: (B, C, H, W), in [0, 1], as the data set stores it.
        protocol: the part to compare.
        variant: see `Variant`; that of the protocol unless given.
        perceptual: networks on the device of the pictures; without them, `lpips` and `feature_mse` are missing.

    Returns:
        (B,) for each of `METRICS`, float32: `psnr` in dB, `ssim`, `lpips`, `feature_mse`, `mse`. NaN stands for
        missing, and ``perceptual.missing`` says why.

    Raises:
        ShapeError: the shapes differ, the protocol does not fit, or its part is too small for a metric.
        ParameterError: no such variant.
    """
    variant = variant or protocol.variant
    if variant not in VARIANTS:
        raise ParameterError(f"`variant` ('{variant}') must be one of {', '.join(VARIANTS)}.")
    if reconstruction.shape != scene.shape:
        raise ShapeError(
            f"`reconstruction` {tuple(reconstruction.shape)} and `scene` {tuple(scene.shape)} must have the same "
            "shape. Crop the scene to what the sensor sees."
        )
    image, reference = protocol.crop(reconstruction).float(), protocol.crop(scene).float()
    if variant == "clipped":
        image = image.clamp(0, 1)
    elif variant == "best-gain":
        image = best_gain(image, reference)
    networks = perceptual or Perceptual.none()
    missing = torch.full((len(image),), math.nan, device=image.device)
    alexnet, heads = networks.alexnet, networks.heads
    return {
        "psnr": psnr(image, reference),
        "ssim": distances.ssim(image, reference),
        "lpips": distances.lpips(image, reference, alexnet, heads) if alexnet and heads else missing,
        "feature_mse": distances.feature_mse(image, reference, alexnet) if alexnet else missing,
        "mse": distances.mse(image, reference),
    }


def bootstrap(
    values: Sequence[float] | Tensor, confidence: float = 0.95, *, resamples: int = 2000, seed: int = 0
) -> tuple[float, float, float]:
    """Mean, and a confidence interval for it by the percentile bootstrap.

    Numbers of equal count and seed are resampled alike, so two methods on the same pictures stay comparable.

    Args:
        values: one number a picture.
        confidence: part of all data sets of this kind whose interval would hold the true mean.
        resamples: data sets that are drawn, with replacement, from this one; more make the ends steadier.
        seed: of the draws.

    Returns:
        Mean, lower end, upper end. The interval of few pictures, below about 20, is too narrow; of one it is empty.

    Raises:
        ParameterError: no values, or a number outside its range.

    References:
        B. Efron and R. J. Tibshirani, An Introduction to the Bootstrap (1993), section 13.3.
    """
    numbers = torch.as_tensor(values, dtype=torch.float64, device="cpu").flatten()
    if not (len(numbers) and 0 < confidence < 1 and resamples > 0):
        raise ParameterError(
            f"`values` ({len(numbers)} of them) must not be empty, `confidence` ({confidence}) must lie in (0, 1) "
            f"and `resamples` ({resamples}) must be positive."
        )
    generator = torch.Generator().manual_seed(seed)
    draws = (torch.randint(len(numbers), (len(numbers),), generator=generator) for _ in range(resamples))
    means = torch.stack([numbers[draw].mean() for draw in draws])
    tail = torch.tensor([(1 - confidence) / 2, (1 + confidence) / 2], dtype=torch.float64)
    # The nearest draw, not one between two: infinite values (a PSNR without error) have nothing between them.
    low, high = torch.quantile(means, tail, interpolation="nearest").tolist()
    return numbers.mean().item(), low, high

"""Protocols, metrics and their confidence intervals."""

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import torch
from torch import Tensor

from mwdn.arguments import check_batch, checked
from mwdn.errors import CheckpointError, ParameterError, ShapeError
from mwdn.evaluation import distances
from mwdn.evaluation.alexnet import AlexNet, Heads, load_alexnet, load_heads
from mwdn.types import Image

Variant = Literal["raw", "clipped", "best-gain"]
"""Adjustment of a reconstruction, after the crop and before the comparison.

- ``raw``: none.
- ``clipped``: clipped to [0, 1], as for display.
- ``best-gain``: one gain and one offset per picture, by least squares over all pixels and channels; not clipped. For
  methods and data whose absolute brightness has no meaning.
"""

METRICS = ("psnr", "ssim", "lpips", "feature_mse", "mse")
"""The metrics of `measure`, in the order of tables."""

LARGER_IS_BETTER = frozenset({"psnr", "ssim"})


@dataclass(frozen=True)
class Protocol:
    """The part of each picture that is compared.

    Args:
        name: as for `parse`.
        centre: side of the central square, or ``None``.
        rows: first row and the row after the last one, or ``None``.
        columns: first column and the column after the last one, or ``None``.
    """

    name: str = "full"
    centre: int | None = None
    rows: tuple[int, int] | None = None
    columns: tuple[int, int] | None = None

    @classmethod
    def parse(cls, text: str) -> "Protocol":
        """The protocol of a name.

        Args:
            text: ``full``; ``centre-128`` (the paper's) or another side; or rows and columns, end excluded, such as
                ``60:270,60:440``, DiffuserCam's region of interest.

        Raises:
            ParameterError: another text, or a part without pixels.
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
        """Default variant: ``raw`` for a central square, as in the paper, else ``clipped``."""
        return "raw" if self.centre else "clipped"

    def crop(self, image: Image) -> Tensor:
        """Crop to the part that is compared, as a view.

        Raises:
            ShapeError: the part exceeds the picture.
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
    """The networks of `lpips` and `feature_mse`; ``None`` where they are not available.

    Args:
        alexnet: features for both metrics.
        heads: for `lpips`.
        missing: metrics that cannot be measured, with the reason.
    """

    alexnet: AlexNet | None
    heads: Heads | None
    missing: dict[str, str]

    @classmethod
    def load(
        cls, alexnet: str | Path | None = None, heads: str | Path | None = None, *, download: bool = False
    ) -> "Perceptual":
        """Load the weights; metrics without weights go to ``missing``.

        Args:
            alexnet: file of AlexNet's weights; see `mwdn.evaluation.alexnet.load_alexnet`.
            heads: file of LPIPS's heads; see `mwdn.evaluation.alexnet.load_heads`.
            download: download missing files, 234 MiB, once.
        """
        try:
            features = load_alexnet(alexnet, download=download)
        except CheckpointError as error:
            return cls.none(str(error))
        try:
            return cls(features, load_heads(heads, alexnet=alexnet, download=download), {})
        except CheckpointError as error:
            return cls(features, None, {"lpips": str(error)})

    @classmethod
    def none(cls, reason: str = "not requested") -> "Perceptual":
        """Neither network, for a reason."""
        return cls(None, None, dict.fromkeys(("lpips", "feature_mse"), reason))


@distances.comparing
def psnr(image: Image, reference: Image) -> Tensor:
    """Peak signal-to-noise ratio of each sample in dB, for a peak of 1.

    Args:
        image: (B, C, H, W), any range; or a numpy array or PIL picture, (H, W) or (H, W, 1 or 3): floats as they are,
            uint8 and uint16 divided by their type's maximum.
        reference: of the same shape and kind.

    Returns:
        (B,), a float for arrays, ``-10 log10(mse)``: half the error is 6.02 dB more; infinite for identical pictures.

    Raises:
        ShapeError: the shapes differ.
        ParameterError: integer tensors, or a tensor with an array.
        ImageError: an array has other axes or types.
    """
    return -10 * torch.log10(distances.mse(image, reference))


def best_gain(image: Image, reference: Image, *, axes: tuple[int, ...] = (1, 2, 3)) -> Image:
    """Apply to each picture x the gain a and offset c that minimise ``|a x + c - reference|^2``; nothing is clipped.

    ``a = cov(x, reference) / var(x)``, of either sign. A uniform picture becomes the mean of its reference.

    Args:
        image: (B, C, H, W), any range.
        reference: of the same shape.
        axes: that share a gain and an offset; (2, 3) for one of each colour.
    """
    mean, target = image.mean(axes, keepdim=True), reference.mean(axes, keepdim=True)
    deviation = image - mean
    power = deviation.square().sum(axes, keepdim=True)
    product = (deviation * (reference - target)).sum(axes, keepdim=True)
    # Not a quotient by 0 that is replaced afterwards: its gradient would be NaN.
    return deviation * (product / torch.where(power > 0, power, 1)) + target


@checked
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

    Values are compared as they are: for scenes in linear light, LPIPS and SSIM differ from those of sRGB pictures,
    which papers report.

    Args:
        reconstruction: (B, C, H, W), on the scale of the scene.
        scene: (B, C, H, W), in [0, 1], as the data set stores it.
        protocol: the part to compare.
        variant: see `Variant`; the protocol's unless given.
        perceptual: networks on the device of the pictures; without them `lpips` and `feature_mse` are NaN.

    Returns:
        (B,) for each of `METRICS`, float32: `psnr` in dB, `ssim`, `lpips`, `feature_mse`, `mse`. Missing values are
        NaN, with the reason in ``perceptual.missing``.

    Raises:
        ShapeError: the shapes differ, the part exceeds the picture, or is too small for a metric.
        ParameterError: unknown variant, or not tensors of floats.
    """
    variant = variant or protocol.variant
    check_batch(reconstruction, "reconstruction")
    check_batch(scene, "scene")
    if reconstruction.shape != scene.shape:
        raise ShapeError(
            f"`reconstruction` {tuple(reconstruction.shape)} and `scene` {tuple(scene.shape)} must have the same "
            "shape. Crop the scene to the field of view of the sensor."
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
    """Mean, and its confidence interval by the percentile bootstrap.

    Equal counts and seeds are resampled alike, so two methods on the same pictures stay comparable.

    Args:
        values: one number per picture.
        confidence: probability that an interval computed in this way holds the true mean.
        resamples: number of data sets drawn, with replacement, from this one; more make the ends more stable.
        seed: seed of the draws.

    Returns:
        Mean, lower end, upper end. Below about 20 pictures the interval is too narrow; of one picture it is empty.

    Raises:
        ParameterError: no values, or an argument outside its range.

    References:
        B. Efron and R. J. Tibshirani, An Introduction to the Bootstrap (1993), section 13.3.
    """
    numbers = torch.as_tensor(values, dtype=torch.float64, device="cpu").flatten()
    if not (len(numbers) and 0 < confidence < 1 and resamples > 0):
        raise ParameterError(
            f"`values` ({len(numbers)} of them) must not be empty, `confidence` ({confidence}) must lie in (0, 1) "
            f"and `resamples` ({resamples}) must be positive."
        )
    generator, count = torch.Generator().manual_seed(seed), len(numbers)
    at_once = max(1, 2**16 // count)  # resamples that fit into a processor's cache
    parts = (min(at_once, resamples - first) for first in range(0, resamples, at_once))
    means = torch.cat([numbers[torch.randint(count, (part, count), generator=generator)].mean(1) for part in parts])
    tail = torch.tensor([(1 - confidence) / 2, (1 + confidence) / 2], dtype=torch.float64)
    # No interpolation between means: they may be infinite (the PSNR of identical pictures).
    low, high = torch.quantile(means, tail, interpolation="nearest").tolist()
    return numbers.mean().item(), low, high

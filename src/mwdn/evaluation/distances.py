"""Distances between pictures, one number per sample.

All take two batches (B, C, H, W) of floats and return (B,) numbers, or two numpy arrays or PIL pictures and return one
float: see `comparing`.

All are computed in float32, also inside autocast, on the device of the pictures. All are differentiable, with finite
gradients even between identical pictures. (On a GPU, AlexNet's convolutions follow torch's TF32 setting, which costs
the third digit.)
"""

import math
from collections.abc import Callable
from functools import cache, wraps
from typing import Any, Protocol, cast, overload, runtime_checkable

import numpy as np
import torch
from torch import Tensor

from mwdn.arguments import check_batch
from mwdn.errors import ParameterError, ShapeError
from mwdn.evaluation.alexnet import AlexNet, Heads, load_alexnet, load_heads
from mwdn.evaluation.vgg import Vgg16
from mwdn.io.arrays import as_frame
from mwdn.types import ArrayPicture, Image


@runtime_checkable
class Distance(Protocol):
    """A number for each sample of two batches, or one for two arrays or PIL pictures."""

    @overload
    def __call__(self, image: Tensor, reference: Tensor, *networks: Any, **named: Any) -> Tensor: ...  # noqa: ANN401

    @overload
    def __call__(
        self,
        image: ArrayPicture,
        reference: ArrayPicture,
        *networks: Any,  # noqa: ANN401
        **named: Any,  # noqa: ANN401
    ) -> float: ...


def comparing(distance: Callable[..., Tensor]) -> Distance:
    """Decorate a distance: check that the shapes agree, and compute in float32 outside autocast.

    Two numpy arrays or PIL pictures, (H, W) or (H, W, 1 or 3), are compared as tensors (1, C, H, W) of their numbers:
    uint8 and uint16 divided by their type's maximum, floats as they are, `MAX_WHITES` at most. The result is then a
    float.
    """

    @wraps(distance)
    def wrapped(image: Any, reference: Any, *networks: Any, **named: Any) -> Tensor | float:  # noqa: ANN401
        if isinstance(image, Tensor) != isinstance(reference, Tensor):
            raise ParameterError(
                f"`image` ({type(image).__name__}) and `reference` ({type(reference).__name__}) must both be tensors "
                "(B, C, H, W), or both arrays or PIL pictures (H, W, C)."
            )
        if not isinstance(image, Tensor):
            return float(wrapped(_as_batch(image), _as_batch(reference), *networks, **named))
        if image.shape != reference.shape:
            raise ShapeError(
                f"`image` {tuple(image.shape)} and `reference` {tuple(reference.shape)} must have the same shape "
                "(B, C, H, W). Crop or resize the larger one."
            )
        check_batch(image, "image")
        check_batch(reference, "reference")
        with torch.autocast(image.device.type, enabled=False):
            return distance(image.float(), reference.float(), *networks, **named)

    return cast(Distance, wrapped)


MAX_WHITES = 16.0
"""Largest number in a picture of floats, in units of white; numbers of 8 bits exceed it."""


def _as_batch(picture: ArrayPicture) -> Image:
    frame = as_frame(picture)
    image = torch.from_numpy(frame.astype(np.float32)).movedim(-1, 0)[None]
    if frame.dtype.kind != "f":
        return image / np.iinfo(frame.dtype).max
    if (largest := float(image.max())) > MAX_WHITES:
        raise ParameterError(f"A picture of floats up to {largest:g} must have 1 as white: divide it, 8 bits by 255.")
    return image


@comparing
def mse(image: Image, reference: Image) -> Tensor:
    """Mean squared error of each sample.

    Args:
        image: (B, C, H, W), any range; or an array or PIL picture, see `comparing`.
        reference: of the same shape and kind.

    Returns:
        (B,), 0 for identical pictures.

    Raises:
        ShapeError: the shapes differ.
    """
    return (image - reference).square().mean((1, 2, 3))


@comparing
def l1(image: Image, reference: Image) -> Tensor:
    """Mean absolute error of each sample.

    Args:
        image: (B, C, H, W), any range; or an array or PIL picture, see `comparing`.
        reference: of the same shape and kind.

    Returns:
        (B,), 0 for identical pictures.

    Raises:
        ShapeError: the shapes differ.
    """
    return (image - reference).abs().mean((1, 2, 3))


@comparing
def log_mse(image: Image, reference: Image) -> Tensor:
    """Logarithm to base 10 of each sample's mean squared error: minus a tenth of its PSNR in dB.

    The worst samples dominate a mean of `mse`; here a decibel counts the same in every sample.

    Args:
        image: (B, C, H, W), any range; or an array or PIL picture, see `comparing`.
        reference: of the same shape and kind.

    Returns:
        (B,), -8 for identical pictures.

    Raises:
        ShapeError: the shapes differ.

    References:
        L. Chen et al., "Simple baselines for image restoration", ECCV (2022), which trains networks on PSNR.
    """
    return mse(image, reference).clamp(min=1e-8).log10()


WINDOW = 11
"""Pixels along each side of the window of `ssim`."""


@comparing
def ssim(image: Image, reference: Image) -> Tensor:
    """Structural similarity of each sample, in a Gaussian window of 11 x 11 pixels, sigma 1.5, for a range of 1.

    Averaged over channels and over all windows inside the picture, as scikit-image's
    ``structural_similarity(gaussian_weights=True, use_sample_covariance=False, data_range=1)``. torchmetrics also
    counts windows that reach into a reflected border, which changes the second decimal place of small pictures.

    Args:
        image: (B, C, H, W), nominally in [0, 1]; or an array or PIL picture, see `comparing`.
        reference: of the same shape and kind.

    Returns:
        (B,), at most 1, for identical pictures; larger is more similar. The loss is 1 - SSIM.

    Raises:
        ShapeError: the shapes differ, or a side is shorter than 11 pixels.

    References:
        Z. Wang et al., "Image quality assessment", IEEE Trans. Image Process. 13, 600 (2004), eq. (13).
    """
    if min(image.shape[-2:]) < WINDOW:
        raise ShapeError(f"`image` {tuple(image.shape)} must have at least {WINDOW} x {WINDOW} pixels for SSIM.")
    x, y = image, reference
    mean_x, mean_y, square_x, square_y, product = _blurred(torch.stack([x, y, x * x, y * y, x * y]))
    variances = square_x - mean_x.square() + square_y - mean_y.square()
    covariance = product - mean_x * mean_y
    c1, c2 = 0.01**2, 0.03**2  # (K1 L)^2 and (K2 L)^2 for the range L = 1
    luminance = (2 * mean_x * mean_y + c1) / (mean_x.square() + mean_y.square() + c1)
    structure = (2 * covariance + c2) / (variances + c2)
    return (luminance * structure).mean((1, 2, 3))


def _blurred(planes: Tensor) -> Tensor:
    """Gaussian average of (..., H, W) over each window inside the picture: (..., H - 10, W - 10)."""
    weights = [math.exp(-0.5 * ((i - WINDOW // 2) / 1.5) ** 2) for i in range(WINDOW)]
    # Shifted sums are four times as fast as `conv2d` on a CPU. On a GPU, convolutions may round to TF32, and the
    # variances, differences of nearly equal squares, would lose all their digits.
    for axis in (-2, -1):
        length = planes.shape[axis] - WINDOW + 1
        blurred = planes.narrow(axis, 0, length) * (weights[0] / sum(weights))
        for i in range(1, WINDOW):
            blurred.add_(planes.narrow(axis, i, length), alpha=weights[i] / sum(weights))
        planes = blurred
    return planes


@comparing
def feature_mse(image: Image, reference: Image, alexnet: AlexNet) -> Tensor:
    """Mean squared error of AlexNet's relu2 features plus that of relu4, of each sample.

    The MWDN paper and its public code call this number LPIPS, in training and in tables; it is not `lpips`. Pictures
    are not normalised as for ImageNet. (The authors' files are BGR, and so are the pictures behind their published
    numbers.)

    Args:
        image: (B, 1 or 3, H, W), nominally in [0, 1], at least 31 x 31 pixels; grey is repeated.
        reference: of the same shape.
        alexnet: from `mwdn.evaluation.alexnet.load_alexnet`, on the device of the pictures.

    Returns:
        (B,), 0 for identical pictures.

    Raises:
        ShapeError: the shapes differ or do not suit AlexNet.

    References:
        Eq. (3) of the MWDN paper.
    """
    pairs = zip(alexnet(image, 4), alexnet(reference, 4), strict=True)
    relu = [(a - b).square().mean((1, 2, 3)) for a, b in pairs]
    return relu[1] + relu[3]


@comparing
def vgg_mse(image: Image, reference: Image, vgg: Vgg16) -> Tensor:
    """Mean squared error of VGG-16's relu2_2 features plus that of relu4_3, of each sample.

    The alternative to `feature_mse` in the MWDN authors' code. Pictures are not normalised as for ImageNet.

    Args:
        image: (B, 1 or 3, H, W), nominally in [0, 1], at least 8 x 8 pixels; grey is repeated.
        reference: of the same shape.
        vgg: from `mwdn.evaluation.vgg.load_vgg16`, on the device of the pictures.

    Returns:
        (B,), 0 for identical pictures.

    Raises:
        ShapeError: the shapes differ or do not suit VGG-16.

    References:
        Eq. (3) of the MWDN paper, which names VGG-16 besides AlexNet and uses AlexNet.
    """
    pairs = zip(vgg(image), vgg(reference), strict=True)
    middle, late = ((a - b).square().mean((1, 2, 3)) for a, b in pairs)
    return middle + late


@comparing
def lpips(image: Image, reference: Image, alexnet: AlexNet | None = None, heads: Heads | None = None) -> Tensor:
    """LPIPS 0.1 of each sample: calibrated distance between AlexNet's features.

    Args:
        image: (B, 1 or 3, H, W) in [0, 1], at least 31 x 31 pixels; grey is repeated. LPIPS was calibrated on
            sRGB values, not on linear light. Or an array or PIL picture, see `comparing`.
        reference: of the same shape and kind.
        alexnet: from `mwdn.evaluation.alexnet.load_alexnet`, on the device of the pictures; loaded unless given.
        heads: from `mwdn.evaluation.alexnet.load_heads`, on the same device; loaded unless given.

    Returns:
        (B,), 0 for identical pictures, about 0.1 for slight and 0.7 for strong distortions.

    Raises:
        ShapeError: the shapes differ or do not suit AlexNet.
        CheckpointError: the weights are not given and cannot be loaded.

    References:
        R. Zhang et al., "The unreasonable effectiveness of deep features as a perceptual metric", CVPR (2018),
        eq. (1).
    """
    alexnet, heads = alexnet or _alexnet(image.device), heads or _heads(image.device)
    # LPIPS takes pictures in [-1, 1]; shift and scale are ImageNet's mean and standard deviation for that range.
    shift = image.new_tensor([-0.030, -0.088, -0.188]).view(1, 3, 1, 1)
    scale = image.new_tensor([0.458, 0.448, 0.450]).view(1, 3, 1, 1)
    features = (alexnet((2 * picture - 1 - shift) / scale) for picture in (image, reference))
    return heads([(_unit_norm(a) - _unit_norm(b)).square() for a, b in zip(*features, strict=True)])


@cache
def _alexnet(device: torch.device) -> AlexNet:
    return load_alexnet().to(device)


@cache
def _heads(device: torch.device) -> Heads:
    return load_heads().to(device)


def _unit_norm(features: Tensor) -> Tensor:
    # `vector_norm` has the gradient 0 where all channels are 0, where a square root would give NaN.
    return features / (torch.linalg.vector_norm(features, dim=1, keepdim=True) + 1e-10)

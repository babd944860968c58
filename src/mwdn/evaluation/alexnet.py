"""The features of AlexNet and the heads of LPIPS, with public, frozen weights."""

import hashlib
import logging
import os
from collections.abc import Sequence
from dataclasses import dataclass
from http.client import HTTPException
from pathlib import Path
from typing import TypeVar
from urllib.request import urlopen

import torch
from torch import Tensor, nn

from mwdn.errors import CheckpointError, ShapeError
from mwdn.io.files import atomic, cache_folder
from mwdn.types import Image
from mwdn.weights.checkpoint import first_difference
from mwdn.weights.torch_file import read_plain

ALEXNET_MIN_PX = 31
"""Fewest pixels along each axis: 31 -> 7 (stride 4) -> 3 -> 1 (pooled); with fewer, relu3 to relu5 are empty."""

CHANNELS = 64, 192, 384, 256, 256
"""Channels of relu1 to relu5."""

_Network = TypeVar("_Network", bound=nn.Module)


def check_picture(image: Image, smallest: int, network: str, metrics: str) -> None:
    """Raise a `ShapeError` unless a picture has 1 or 3 channels and sides of ``smallest`` pixels or more."""
    if image.shape[1] not in (1, 3) or min(image.shape[-2:]) < smallest:
        raise ShapeError(
            f"`image` {tuple(image.shape)} must have 1 or 3 channels and at least {smallest} x {smallest} pixels "
            f"for {network}. Use a larger part, or leave out {metrics}."
        )


class AlexNet(nn.Module):
    """The convolutions of AlexNet, with torchvision's keys in the state dict, ``features.N.weight``.

    References:
        A. Krizhevsky, "One weird trick for parallelizing convolutional neural networks", arXiv:1404.5997 (2014).
    """

    def __init__(self) -> None:
        super().__init__()
        self.features = nn.Sequential(
            nn.Conv2d(3, 64, 11, stride=4, padding=2),
            nn.ReLU(),
            nn.MaxPool2d(3, stride=2),
            nn.Conv2d(64, 192, 5, padding=2),
            nn.ReLU(),
            nn.MaxPool2d(3, stride=2),
            nn.Conv2d(192, 384, 3, padding=1),
            nn.ReLU(),
            nn.Conv2d(384, 256, 3, padding=1),
            nn.ReLU(),
            nn.Conv2d(256, 256, 3, padding=1),
            nn.ReLU(),
        )

    def forward(self, image: Image, last: int = 5) -> list[Tensor]:
        """Compute the outputs of the ReLUs.

        Args:
            image: (B, 3, H, W), or (B, 1, H, W), which is repeated; scaled by the caller.
            last: number of the last ReLU to compute; relu5 unless given.

        Returns:
            relu1 to relu``last``, (B, `CHANNELS`, h, w), h and w about H and W over 4, 8, 16, 16, 16.

        Raises:
            ShapeError: neither 1 nor 3 channels, or a side shorter than `ALEXNET_MIN_PX`.
        """
        check_picture(image, ALEXNET_MIN_PX, "AlexNet", "`feature_mse` and `lpips`")
        value, outputs = image.expand(-1, 3, -1, -1), []
        for layer in self.features:
            value = layer(value)
            if isinstance(layer, nn.ReLU):
                outputs.append(value)
            if len(outputs) == last:
                break
        return outputs


class Heads(nn.Module):
    """The five learned 1x1 convolutions of LPIPS 0.1, which weight the channels of AlexNet's features.

    The keys in the state dict are those of the public file, ``linN.model.1.weight``.
    """

    def __init__(self) -> None:
        super().__init__()
        for i, channels in enumerate(CHANNELS):
            # In the public file, layer 0 is a dropout.
            layer = nn.ModuleDict({"model": nn.ModuleDict({"1": nn.Conv2d(channels, 1, 1, bias=False)})})
            self.add_module(f"lin{i}", layer)

    def forward(self, differences: Sequence[Tensor]) -> Tensor:
        """Weighted sum of squared differences (B, `CHANNELS`, h, w), each averaged over its pixels: (B,)."""
        convolutions = [module for module in self.modules() if isinstance(module, nn.Conv2d)]
        maps = [convolution(difference) for convolution, difference in zip(convolutions, differences, strict=True)]
        return torch.stack([weighted.mean((1, 2, 3)) for weighted in maps]).sum(0)


@dataclass(frozen=True)
class PublicWeights:
    """A public weights file.

    Args:
        what: the network, for messages.
        file: its name.
        variable: environment variable that names another file.
        address: to download it from.
        sha256: the first digits of the file's SHA-256.
        mebibytes: its size.
    """

    what: str
    file: str
    variable: str
    address: str
    sha256: str
    mebibytes: int


_ALEXNET = PublicWeights(
    "AlexNet",
    "alexnet-owt-7be5be79.pth",
    "MWDN_ALEXNET",
    "https://download.pytorch.org/models/alexnet-owt-7be5be79.pth",
    "7be5be79",
    233,
)
# The publisher gives no checksum; this is the one of the file that torchmetrics ships.
_HEADS = PublicWeights(
    "the heads of LPIPS",
    "lin_v0.1_alex.pth",
    "MWDN_LPIPS",
    "https://raw.githubusercontent.com/richzhang/PerceptualSimilarity/master/lpips/weights/v0.1/alex.pth",
    "df73285e35b22355a2df87cdb6b70b343713b667eddbda73e1977e0c860835c0",
    1,
)


def load_alexnet(path: str | Path | None = None, *, download: bool = True) -> AlexNet:
    """Load AlexNet with its ImageNet weights, frozen, in evaluation mode, on the CPU.

    Args:
        path: a state dict with torchvision's keys, of the whole AlexNet or of its convolutions. Unless given, the file
            named by the environment variable ``MWDN_ALEXNET``, else ``~/.cache/mwdn/alexnet-owt-7be5be79.pth``, which
            is downloaded once (233 MiB) and checked.
        download: whether a missing file may be downloaded.

    Raises:
        CheckpointError: the file is missing and cannot or may not be downloaded, or holds other weights.
    """
    return load_weights(AlexNet(), locate(_ALEXNET, path, download=download), "features.")


def load_heads(path: str | Path | None = None, *, alexnet: str | Path | None = None, download: bool = True) -> Heads:
    """Load the calibrated heads of LPIPS 0.1 for AlexNet, frozen, in evaluation mode, on the CPU.

    Args:
        path: the public ``lin_v0.1_alex.pth``. Unless given, the file named by the environment variable
            ``MWDN_LPIPS``, else ``lin_v0.1_alex.pth`` beside AlexNet's file, else the one in ``~/.cache/mwdn``, which
            is downloaded once (6 kB) and checked.
        alexnet: the path given to `load_alexnet`, if any.
        download: whether a missing file may be downloaded.

    Raises:
        CheckpointError: the file is missing and cannot or may not be downloaded, or holds other weights.
    """
    return load_weights(Heads(), locate(_HEADS, path or _beside(alexnet), download=download), "lin")


def download_mebibytes(alexnet: str | Path = "", heads: str | Path = "") -> int:
    """Size of the files that `load_alexnet` and `load_heads` would download for these arguments; 0 for none."""
    files = (_ALEXNET, alexnet), (_HEADS, heads or _beside(alexnet))
    searched = [public for public, path in files if not (path or os.environ.get(public.variable))]
    return sum(public.mebibytes for public in searched if not (cache_folder() / public.file).is_file())


def _beside(alexnet: str | Path | None) -> Path | None:
    """The heads beside AlexNet's file, if they are there and no others are named."""
    neighbour = alexnet or os.environ.get(_ALEXNET.variable)
    beside = Path(neighbour).with_name(_HEADS.file) if neighbour else None
    return beside if beside and beside.is_file() and _HEADS.variable not in os.environ else None


def locate(public: PublicWeights, path: str | Path | None, *, download: bool) -> Path:
    """File of public weights: the one given, that of the environment variable, or the one in `cache_folder`.

    Raises:
        CheckpointError: it is missing and cannot or may not be downloaded.
    """
    chosen = path or os.environ.get(public.variable)
    if chosen:
        if not Path(chosen).is_file():
            origin = f" (from {public.variable})" if path is None else ""
            raise CheckpointError(
                f"No weights of {public.what} at `{chosen}`{origin}. Correct the path, or leave it out to download."
            )
        return Path(chosen)
    cached = cache_folder() / public.file
    if not cached.is_file():
        if not download:
            raise CheckpointError(
                f"The public weights of {public.what} ({public.mebibytes} MiB) are not at `{cached}`. Allow the "
                f"download, `--lpips`, in Python `download=True`; or name the file: `export {public.variable}=FILE`."
            )
        _download(public, cached)
    return cached


def _download(public: PublicWeights, path: Path) -> None:
    # A warning is printed even if logging is not set up: 233 MiB take a while.
    logging.getLogger(__name__).warning(
        "Downloading %s (%d MiB, once) from %s", public.what, public.mebibytes, public.address
    )
    try:
        with atomic(path) as temporary:
            digest = _fetch(public.address, temporary)
            if not digest.startswith(public.sha256):
                raise CheckpointError(
                    f"The SHA-256 of {public.address} must start with {public.sha256[:8]}, but starts with "
                    f"{digest[:8]}: damaged or replaced on its way. Try again, or use another network."
                )
    except (OSError, HTTPException) as error:
        raise CheckpointError(
            f"The weights of {public.what} are not at `{path}` and cannot be downloaded ({error}). On a computer with "
            f"internet access run `curl -fL -o {public.file} {public.address}`, copy the file to this one, then "
            f"`export {public.variable}=/PATH/TO/{public.file}`."
        ) from error


def _fetch(address: str, path: Path) -> str:
    """Download a file and return its SHA-256."""
    digest = hashlib.sha256()
    with urlopen(address, timeout=30) as reply, path.open("wb") as file:
        while block := reply.read(2**20):
            digest.update(block)
            file.write(block)
    return digest.hexdigest()


def load_weights(network: _Network, path: Path, prefix: str | tuple[str, ...]) -> _Network:
    """Fill a network with the tensors of a file whose keys start with one of these; frozen, in evaluation mode."""
    content = read_plain(path)
    try:
        network.load_state_dict({key: value for key, value in content.items() if key.startswith(prefix)})
    except (AttributeError, TypeError, RuntimeError) as error:
        kind, reason = type(network).__name__, first_difference(error)
        raise CheckpointError(
            f"`{path}` does not hold the weights of `{kind}`: {reason}. Download it again."
        ) from error
    return network.requires_grad_(False).eval()

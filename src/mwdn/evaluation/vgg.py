"""The features of VGG-16, with public, frozen weights."""

from pathlib import Path

from torch import Tensor, nn

from mwdn.evaluation.alexnet import PublicWeights, check_picture, load_weights, locate
from mwdn.types import Image

VGG_MIN_PX = 8
"""Fewest pixels along each axis: relu4_3 is at 1/8."""

VGG16 = PublicWeights(
    "VGG-16",
    "vgg16-397923af.pth",
    "MWDN_VGG16",
    "https://download.pytorch.org/models/vgg16-397923af.pth",
    "397923af",
    528,
)


class Vgg16(nn.Module):
    """The convolutions of VGG-16 up to relu4_3, with torchvision's keys in the state dict, ``features.N.weight``.

    References:
        K. Simonyan and A. Zisserman, "Very deep convolutional networks", arXiv:1409.1556 (2015), configuration D.
    """

    def __init__(self) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        inputs = 3
        for count, outputs in ((2, 64), (2, 128), (3, 256), (3, 512)):
            layers += [nn.MaxPool2d(2)] if layers else []
            for _ in range(count):
                layers += [nn.Conv2d(inputs, outputs, 3, padding=1), nn.ReLU()]
                inputs = outputs
        self.features = nn.Sequential(*layers)

    def forward(self, image: Image) -> tuple[Tensor, Tensor]:
        """relu2_2, (B, 128, H/2, W/2), and relu4_3, (B, 512, H/8, W/8), of a picture (B, 1 or 3, H, W).

        Raises:
            ShapeError: neither 1 nor 3 channels, or a side shorter than `VGG_MIN_PX`.
        """
        check_picture(image, VGG_MIN_PX, "VGG-16", "`vgg_mse`")
        middle = self.features[:9](image.expand(-1, 3, -1, -1))
        return middle, self.features[9:](middle)


def load_vgg16(path: str | Path | None = None) -> Vgg16:
    """Load VGG-16 with its ImageNet weights, frozen, in evaluation mode, on the CPU.

    Args:
        path: a state dict with torchvision's keys. Unless given, the file named by the environment variable
            ``MWDN_VGG16``, else ``~/.cache/mwdn/vgg16-397923af.pth``, which is downloaded once (528 MiB) and checked.

    Raises:
        CheckpointError: the file is missing and cannot be downloaded, or holds other weights.
    """
    network = Vgg16()
    wanted = tuple(f"{key.rpartition('.')[0]}." for key in network.state_dict())
    return load_weights(network, locate(VGG16, path, download=True), wanted)

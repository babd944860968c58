"""U-Net of FlatNet and SVDeconv."""

from torch import Tensor, nn
from torch.nn import functional as F

from mwdn.networks.blocks import Decoder, Encoder, check_channels, pad_to_minimum


class FlatNetUNet(nn.Module):
    """U-Net with GroupNorm on 2 x 2 pixel-unshuffled input.

    Its six scales have 1, 1, 1, 2, 4 and 8 times ``width`` channels.

    Args:
        channels: of the pictures.
        colours: of the result.
        width: feature channels at the finest scale.
    """

    def __init__(self, channels: int, colours: int, *, width: int) -> None:
        super().__init__()
        self.channels = channels
        widths = (width, width, width, 2 * width, 4 * width, 8 * width)
        self.encoder = Encoder(4 * channels, widths, norm="group")
        self.decoder = Decoder(4 * colours, widths, norm="group")

    def forward(self, pictures: Tensor) -> Tensor:
        """Picture (B, colours, H, W), of unlimited range."""
        check_channels(pictures, self.channels)
        height, width = pictures.shape[-2:]
        # 64 pixels are 64 / 2 / 2^5 = 1 at the coarsest scale; pixel unshuffling needs even sides.
        padded = pad_to_minimum(pictures, 64)
        padded = F.pad(padded, (0, padded.shape[-1] % 2, 0, padded.shape[-2] % 2), mode="replicate")
        features = self.encoder(F.pixel_unshuffle(padded, 2))
        return F.pixel_shuffle(self.decoder(features), 2)[..., :height, :width]

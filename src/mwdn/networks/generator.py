"""The U-Net that FlatNet and SVDeconv put behind their inverse."""

from torch import Tensor, nn
from torch.nn import functional as F

from mwdn.networks.blocks import Decoder, Encoder, at_least, check_channels


class Generator(nn.Module):
    """U-Net over blocks of 2 x 2 pixels with GroupNorm: six scales of 1, 1, 1, 2, 4 and 8 times ``width`` channels.

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
        """Picture (B, colours, H, W), not limited to any range."""
        check_channels(pictures, self.channels)
        height, width = pictures.shape[-2:]
        # 64 pixels are 64 / 2 / 2^5 = 1 at the coarsest scale; the folding needs even sides.
        wide = at_least(pictures, 64)
        wide = F.pad(wide, (0, wide.shape[-1] % 2, 0, wide.shape[-2] % 2), mode="replicate")
        features = self.encoder(F.pixel_unshuffle(wide, 2))
        return F.pixel_shuffle(self.decoder(features), 2)[..., :height, :width]

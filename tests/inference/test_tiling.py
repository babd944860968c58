"""A U-Net in strips of rows gives the result for the whole picture."""

import copy

import pytest
import torch
from torch.nn import functional as F

from made import trained
from mwdn.fourier import memory_format
from mwdn.inference.engine import Engine
from mwdn.inference.fusion import fuse
from mwdn.inference.tiling import StripDecoder, StripEncoder, upsample_rows
from mwdn.networks import build
from mwdn.networks.blocks import Decoder, Encoder
from mwdn.networks.wiener_filter import WienerFilter


def limit_strips(network):
    """Limit strips to few rows. The list returned grows by the height of each strip that is computed."""
    heights = []
    for unet in network.modules():
        if isinstance(unet, StripEncoder | StripDecoder):
            unet.max_strip_numbers = 7 * 45 * 32
            for scale in unet.scales:
                scale[0].register_forward_pre_hook(lambda layer, inputs: heights.append(inputs[0].shape[-2]))
    return heights


@pytest.mark.parametrize("pooling", ["max", "average"])
@pytest.mark.parametrize("size", [(64, 45), (67, 45), (33, 90)])
@torch.no_grad()
def test_strips_are_the_whole_picture(size, pooling, generator):
    """Of 7 rows and of fewer at one scale and of more at another, of which the last is cut off."""
    unet = trained(build("unet", width=16, pooling=pooling), generator)
    picture = torch.rand(2, 3, *size, generator=generator)
    expected = unet(picture, picture[:1])
    fused = fuse(copy.deepcopy(unet), None)
    assert isinstance(fused.encoder, StripEncoder)
    assert isinstance(fused.decoder, StripDecoder)
    heights = limit_strips(fused)
    result = fused(picture, picture[:1])
    assert len(heights) > 20
    assert max(heights) < size[0]
    torch.testing.assert_close(result, expected, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("name", ["mwdn", "mwdn-cpsf"])
@torch.no_grad()
def test_large_pictures_in_parts_everywhere(name, monkeypatch, generator):
    """Strips, channels filtered a few at a time, transfer functions made when they are needed."""
    network = trained(build(name, width=16), generator)
    psf, measurement = torch.rand(1, 3, 64, 45, generator=generator), torch.rand(2, 3, 64, 45, generator=generator)
    expected = network(measurement, psf)
    monkeypatch.setattr(memory_format, "CHUNK_VALUES", 3 * 2 * 64 * 45)
    monkeypatch.setattr(WienerFilter, "max_grid_pixels", 8 * 96 * 70)
    engine = Engine(network, psf, precision="exact")
    heights = limit_strips(engine.network)
    result = engine(measurement)
    kept = [tensor.is_complex() for tensor in engine.prepared]
    assert kept == ([True] * 4 if name == "mwdn" else [False] * 2 + [True] * 2)
    assert len(heights) > 20
    torch.testing.assert_close(result, expected, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("size", [(23, 31), (22, 9), (40, 16)])
def test_upsampled_rows(size, generator):
    picture = torch.rand(2, 3, 11, 16, generator=generator)
    expected = F.interpolate(picture, size=size, mode="bilinear", align_corners=True)
    for first, last in ((0, 5), (5, 6), (6, size[0]), (0, size[0])):
        result = upsample_rows(picture, size, first, last)
        torch.testing.assert_close(result, expected[..., first:last, :], rtol=1e-6, atol=1e-6)


def test_normalisation_over_the_picture_is_not_cut(generator):
    """GroupNorm sees the whole picture."""
    for unet in (Encoder(3, (8, 8), norm="group"), Decoder(3, (8, 8), norm="group")):
        assert type(fuse(unet.eval(), None)) is type(unet)

"""Live JPEGs show what `to_display` shows."""

import cv2
import numpy as np
import pytest
import torch

from mwdn.data.random import seeded
from mwdn.io.contact_sheets import to_display
from mwdn.io.images import srgb_encode
from mwdn.preview.live_encoding import QUALITY, brightest, encode_jpeg


@pytest.mark.parametrize("channels", [1, 3])
def test_picture_is_that_of_to_display(channels):
    smooth = torch.nn.functional.interpolate(
        torch.rand(1, channels, 6, 7, generator=seeded(0)), (60, 71), mode="bicubic"
    )
    codes = srgb_encode(to_display(smooth))[0].mul(255).round().byte().movedim(0, -1).numpy()[..., ::-1]
    expected = cv2.imencode(".jpg", np.ascontiguousarray(codes), [cv2.IMWRITE_JPEG_QUALITY, QUALITY])[1]
    made = np.frombuffer(encode_jpeg(smooth, brightest(smooth)), np.uint8)
    difference = np.subtract(*(cv2.imdecode(data, cv2.IMREAD_UNCHANGED).astype(int) for data in (made, expected)))
    assert np.abs(difference).mean() < 1


def test_white_is_the_number_of_to_display():
    image = torch.rand(1, 3, 400, 400, generator=seeded(1)) ** 2
    exact = image.flatten().kthvalue(image.numel() - int(0.003 * image.numel())).values
    assert brightest(image) == pytest.approx(float(exact), rel=0.01)


def test_darkness_has_a_picture():
    dark = torch.zeros(1, 3, 16, 16)
    assert encode_jpeg(dark, brightest(dark)).startswith(b"\xff\xd8")

"""Photographs, the sRGB curve, and written pictures."""

from collections.abc import Callable
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
import tifffile
import torch
from PIL import Image as Pillow
from PIL import ImageOps
from skimage import io as skimage_io

from image_files import HEIGHT, WIDTH, encoded, flag, noise, npy, put
from mwdn.errors import ImageError, ParameterError
from mwdn.io.images import (
    READABLE,
    read_frame,
    read_picture,
    srgb_decode,
    srgb_encode,
    write_frame,
    write_linear,
    write_picture,
)


@pytest.mark.parametrize("kind", ["JPEG", "PNG", "TIFF"])
@pytest.mark.parametrize("orientation", range(1, 9))
def test_exif_turns_photographs_but_not_frames(tmp_path: Path, kind: str, orientation: int) -> None:
    exif = Pillow.Exif()
    exif[0x0112] = orientation
    exact = {"subsampling": 0, "quality": 100} if kind == "JPEG" else {}
    path = put(tmp_path / "a", encoded(flag(), kind, exif=exif, **exact))
    upright = np.asarray(ImageOps.exif_transpose(Pillow.open(BytesIO(encoded(flag(), "PNG", exif=exif)))))
    assert read_frame(path).shape == flag().shape
    picture = read_picture(path)[0].movedim(0, -1).numpy()
    np.testing.assert_allclose(picture, upright / 255.0, atol=0.02 if kind == "JPEG" else 1e-6)


@pytest.mark.parametrize("dtype", ["uint8", "uint16"])
def test_a_photograph_is_linear_light(tmp_path: Path, dtype: str) -> None:
    peak = np.iinfo(dtype).max
    data = encoded(np.array([[0, round(peak / 2), peak]], dtype), "PNG")
    light = read_picture(put(tmp_path / "a.png", data))
    assert light.shape == (1, 3, 1, 3)
    assert light.dtype == torch.float32
    encoded_half = round(peak / 2) / peak
    expected = torch.tensor([0, ((encoded_half + 0.055) / 1.055) ** 2.4, 1])
    torch.testing.assert_close(light, expected.expand(1, 3, 1, 3))


def test_a_photograph_with_grey_alpha_is_grey(tmp_path: Path) -> None:
    picture = read_picture(put(tmp_path / "a.png", encoded(noise(channels=2), "PNG")))
    expected = srgb_decode(torch.from_numpy(noise(channels=2)[..., 0] / np.float32(255)))
    torch.testing.assert_close(picture, expected.expand(1, 3, HEIGHT, WIDTH))


def test_floats_are_no_photograph(tmp_path: Path) -> None:
    path = put(tmp_path / "a.npy", npy(noise("float32")))
    with pytest.raises(ImageError, match="`read_frame`"):
        read_picture(path)


# The sRGB curve


def test_srgb_has_the_closed_form_values() -> None:
    numbers = torch.tensor([0, 0.02, 0.5, 1], dtype=torch.float64)
    light = torch.tensor([0, 0.02 / 12.92, 0.21404114048, 1], dtype=torch.float64)
    torch.testing.assert_close(srgb_decode(numbers), light)
    torch.testing.assert_close(srgb_encode(light), numbers)
    assert srgb_encode(torch.tensor([-1.0, 2.0])).tolist() == [0, 1]


def test_srgb_agrees_with_skimage() -> None:
    from skimage.color import rgb2xyz, xyz2rgb

    numbers = np.random.default_rng(0).random((20, 20, 3))
    to_light = np.linalg.inv(rgb2xyz(np.eye(3)[None])[0])
    light = rgb2xyz(numbers) @ to_light
    np.testing.assert_allclose(srgb_decode(torch.from_numpy(numbers)).numpy(), light, atol=1e-6)
    np.testing.assert_allclose(srgb_encode(torch.from_numpy(light)).numpy(), xyz2rgb(rgb2xyz(numbers)), atol=1e-6)


def test_srgb_round_trip_keeps_every_16_bit_number() -> None:
    numbers = torch.arange(2**16)
    assert torch.equal((srgb_encode(srgb_decode(numbers / 65535)) * 65535).round().long(), numbers)


# Writing


@pytest.mark.parametrize(("bits", "dtype"), [(8, "uint8"), (16, "uint16")])
@pytest.mark.parametrize("channels", [1, 3])
def test_a_written_picture_has_the_numbers_it_was_read_from(
    tmp_path: Path, bits: int, dtype: str, channels: int
) -> None:
    numbers = noise(dtype, channels)
    light = srgb_decode(torch.from_numpy(numbers.astype(np.float32) / (2**bits - 1))).movedim(-1, 0)
    path = tmp_path / "new" / "folder" / "a.png"
    write_picture(path, light[None].requires_grad_(), bits=bits)
    np.testing.assert_array_equal(read_frame(path), numbers)
    elsewhere = np.atleast_3d(skimage_io.imread(path))  # Pillow reads grey of 16 bits, but halves colour to 8
    np.testing.assert_array_equal(elsewhere, numbers if elsewhere.dtype == dtype else numbers >> 8)
    torch.testing.assert_close(read_picture(path), light.detach().expand(1, 3, -1, -1))


def test_a_written_picture_is_rounded_and_clipped(tmp_path: Path) -> None:
    numbers = torch.tensor([[-3.0, 99.6 / 255, 99.4 / 255, 7.0]])
    write_picture(tmp_path / "a.PNG", srgb_decode(numbers.clamp(0, 1))[None] + (numbers - numbers.clamp(0, 1)))
    assert read_frame(tmp_path / "a.PNG").squeeze().tolist() == [0, 100, 99, 255]


@pytest.mark.parametrize("name", ["a.tif", "a.TIFF", "a.npy", "a.NPY"])
@pytest.mark.parametrize("channels", [1, 3])
def test_linear_numbers_survive_exactly(tmp_path: Path, name: str, channels: int) -> None:
    image = torch.randn(1, channels, HEIGHT, WIDTH) * 10
    write_linear(tmp_path / name, image)
    assert [file.name for file in tmp_path.iterdir()] == [name]
    np.testing.assert_array_equal(read_frame(tmp_path / name), image[0].movedim(0, -1).numpy())


def test_a_linear_tiff_opens_elsewhere_as_rgb(tmp_path: Path) -> None:
    write_linear(tmp_path / "a.tif", torch.rand(3, HEIGHT, WIDTH))
    with tifffile.TiffFile(tmp_path / "a.tif") as file:
        assert file.pages[0].photometric.name == "RGB"
        assert file.series[0].axes == "YXS"


@pytest.mark.parametrize(
    ("write", "name", "image", "message"),
    [
        (write_picture, "a.jpg", torch.rand(3, 4, 4), r"must end in \.png, not '\.jpg'"),
        (write_linear, "a.png", torch.rand(3, 4, 4), r"must end in \.npy or \.tif or \.tiff"),
        (write_linear, "a", torch.rand(3, 4, 4), "not ''"),
        (write_picture, "a.png", torch.rand(2, 3, 4, 4), r"`image` \(2 x 3 x 4 x 4, torch.float32\)"),
        (write_picture, "a.png", torch.rand(2, 4, 4), "1 or 3 channels"),
        (write_picture, "a.png", torch.rand(4, 4), "1 or 3 channels"),
        (write_picture, "a.png", torch.rand(3, 0, 4), "3 x 0 x 4"),
        (write_picture, "a.png", torch.ones(3, 4, 4, dtype=torch.uint8), "torch.uint8"),
        (write_linear, "a.tif", torch.full((3, 4, 4), torch.nan), "NaN or infinity"),
        (write_linear, "a.tif", torch.full((3, 4, 4), 1e300, dtype=torch.float64), "NaN or infinity"),
        (write_picture, "a.png", torch.rand(1, 1, 1_000_001), "cannot be written: OpenCV"),
    ],
)  # fmt: skip
def test_what_cannot_be_written(
    tmp_path: Path, write: Callable[..., None], name: str, image: torch.Tensor, message: str
) -> None:
    with pytest.raises(ImageError, match=message):
        write(tmp_path / name, image)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.usefixtures("unchecked")
def test_integers_are_no_linear_light(tmp_path: Path) -> None:
    with pytest.raises(ImageError, match=r"\(4 x 6 x 3, uint8\) must be .*floats.*`mwdn\.io\.images\.srgb_decode`"):
        write_picture(tmp_path / "a.png", np.ones((4, 6, 3), np.uint8))


def test_png_has_8_or_16_bits(tmp_path: Path) -> None:
    with pytest.raises(ParameterError, match=r"`bits` \(12\)"):
        write_picture(tmp_path / "a.png", torch.rand(3, 4, 4), bits=12)


def test_readable_suffixes_are_in_lower_case() -> None:
    assert {".png", ".tif", ".npy"} <= READABLE
    assert all(suffix == suffix.lower() and suffix.startswith(".") for suffix in READABLE)


@pytest.mark.parametrize("name", ["a.png", "a.tif", "a.npy"])
@pytest.mark.parametrize("dtype", ["uint8", "<u2", ">u2"])
def test_a_frame_without_a_channel_axis_is_not_mirrored(tmp_path: Path, name: str, dtype: str) -> None:
    frame = np.arange(12).reshape(3, 4).astype(dtype)
    write_frame(tmp_path / name, frame)
    np.testing.assert_array_equal(read_frame(tmp_path / name)[..., 0], frame)


@pytest.mark.parametrize("frame", [np.full((3, 4, 1), 0.4, np.float32), np.zeros((3, 4, 2), np.uint8)])
def test_what_a_png_cannot_hold_is_not_written(tmp_path: Path, frame: np.ndarray) -> None:
    with pytest.raises(ImageError):
        write_frame(tmp_path / "a.png", frame)
    assert not list(tmp_path.iterdir())

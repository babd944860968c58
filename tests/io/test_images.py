import os
import struct
import subprocess
import sys
import zlib
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

from mwdn.errors import ImageError, ParameterError
from mwdn.io.files import atomic
from mwdn.io.formats import MAX_PIXELS
from mwdn.io.images import READABLE, read_frame, read_picture, srgb_decode, srgb_encode, write_linear, write_picture

HEIGHT, WIDTH = 37, 51
RED, BLUE = [255, 0, 0], [0, 0, 255]


def noise(dtype: str = "uint8", channels: int = 3) -> np.ndarray:
    full = np.random.default_rng(0).integers(0, 2**16, (HEIGHT, WIDTH, channels), dtype=np.uint16)
    return (full >> 8).astype(np.uint8) if dtype == "uint8" else full.astype(dtype)


RGB_OF_RGBA = noise(channels=4)[..., :3]


def flag() -> np.ndarray:
    """Red at the top left, blue at the bottom left, in blocks that survive JPEG."""
    picture = np.zeros((32, 48, 3), np.uint8)
    picture[:16, :16], picture[16:, :16] = RED, BLUE
    return picture


def encoded(array: np.ndarray, kind: str, **options: object) -> bytes:
    data = BytesIO()
    Pillow.fromarray(array).save(data, kind, **options)
    return data.getvalue()


def chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def png16(array: np.ndarray) -> bytes:
    """Made by hand from the PNG specification: Pillow knows no colour of 16 bits."""
    rows = b"".join(b"\0" + row.astype(">u2").tobytes() for row in array)
    header = chunk(b"IHDR", struct.pack(">IIBBBBB", array.shape[1], array.shape[0], 16, 2, 0, 0, 0))
    return b"\x89PNG\r\n\x1a\n" + header + chunk(b"IDAT", zlib.compress(rows)) + chunk(b"IEND", b"")


def tiff(array: np.ndarray, **options: object) -> bytes:
    data = BytesIO()
    tifffile.imwrite(data, array, **{"photometric": "minisblack"} | options)
    return data.getvalue()


def npy(array: np.ndarray, **options: bool) -> bytes:
    data = BytesIO()
    np.save(data, array, **options)
    return data.getvalue()


def put(path: Path, data: bytes) -> Path:
    path.write_bytes(data)
    return path


# Frames, as stored


@pytest.mark.parametrize(("name", "dtype"), [("a.png", "uint8"), ("a.tif", "uint8"), ("a.tif", "uint16")])
def test_what_skimage_writes_is_read_exactly(tmp_path: Path, name: str, dtype: str) -> None:
    skimage_io.imsave(tmp_path / name, noise(dtype), check_contrast=False)
    np.testing.assert_array_equal(read_frame(tmp_path / name), noise(dtype))


@pytest.mark.parametrize(
    ("name", "data", "expected"),
    [
        ("a.bmp", encoded(noise(), "BMP"), noise()),
        ("grey.bmp", encoded(noise()[..., 0], "BMP"), noise()[..., :1]),
        ("grey.png", encoded(noise()[..., 0], "PNG"), noise()[..., :1]),
        ("grey16.png", encoded(noise("uint16")[..., 0], "PNG"), noise("uint16")[..., :1]),
        ("rgb16.png", png16(noise("uint16")), noise("uint16")),
        ("alpha.png", encoded(noise(channels=4), "PNG"), noise(channels=4)[..., :3]),
        ("grey_alpha.png", encoded(noise(channels=2), "PNG"), noise(channels=2)[..., :1]),
        ("named_wrongly.jpg", encoded(noise(), "PNG"), noise()),
        ("trailer.png", encoded(noise(), "PNG") + b"maker's notes", noise()),
        ("planar.tif", tiff(noise().transpose(2, 0, 1), photometric="rgb", planarconfig="separate"), noise()),
        ("imagej.tif", tiff(noise().transpose(2, 0, 1), imagej=True), noise()),
        ("alpha.tif", tiff(noise(channels=4), photometric="rgb", extrasamples=["unassalpha"]), RGB_OF_RGBA),
        ("big_endian.tif", tiff(noise(">u2"), photometric="rgb", byteorder=">"), noise("uint16")),
        ("big.tif", tiff(noise(), photometric="rgb", bigtiff=True), noise()),
        ("deflated.tif", tiff(noise(), photometric="rgb", compression="zlib", tile=(16, 16)), noise()),
        ("one_page.tif", tiff(noise("float32")[None, ..., 0]), noise("float32")[..., :1]),
        ("rows.tif", encoded(noise(), "TIFF"), noise()),
        ("grey.npy", npy(noise()[..., 0]), noise()[..., :1]),
        ("alpha.npy", npy(noise(channels=4)), noise(channels=4)[..., :3]),
        ("batch.npy", npy(noise()[None]), noise()),
        ("page.npy", npy(noise()[None, ..., 0]), noise()[..., :1]),
        ("fortran.npy", npy(np.asfortranarray(noise())), noise()),
        ("big_endian.npy", npy(noise(">u2")), noise("uint16")),
        ("double.npy", npy(noise("float64") / 3), (noise("float64") / 3).astype(np.float32)),
        ("half.npy", npy(np.float16([[0.5, -2]])), np.float32([[[0.5], [-2]]])),
    ],
)  # fmt: skip
def test_every_format_and_layout(tmp_path: Path, name: str, data: bytes, expected: np.ndarray) -> None:
    frame = read_frame(put(tmp_path / name, data))
    assert frame.dtype == expected.dtype
    assert type(frame) is np.ndarray
    assert frame.flags.c_contiguous
    assert frame.flags.writeable
    np.testing.assert_array_equal(frame, expected)


@pytest.mark.parametrize("kind", ["PNG", "JPEG", "BMP", "TIFF"])
def test_row_0_is_the_top_and_channel_0_is_red(tmp_path: Path, kind: str) -> None:
    path = put(tmp_path / "a", encoded(flag(), kind))
    frame, picture = read_frame(str(path)), read_picture(path)
    off = 12 if kind == "JPEG" else 0
    np.testing.assert_allclose(frame[0, 0].astype(int), RED, atol=off)
    np.testing.assert_allclose(frame[-1, 0].astype(int), BLUE, atol=off)
    assert picture.shape == (1, 3, 32, 48)
    torch.testing.assert_close(picture[0, :, 0, 0], torch.tensor([1.0, 0, 0]), atol=off / 100, rtol=0)
    torch.testing.assert_close(picture[0, :, -1, 0], torch.tensor([0, 0, 1.0]), atol=off / 100, rtol=0)


@pytest.mark.parametrize("name", ["a.npy", "a.png"])
def test_bgr_and_upside_down_are_undone(tmp_path: Path, name: str) -> None:
    turned = np.ascontiguousarray(flag()[::-1, :, ::-1])
    path = put(tmp_path / name, npy(turned) if name.endswith("npy") else encoded(turned, "PNG"))
    np.testing.assert_array_equal(read_frame(path, bgr=True, upside_down=True), flag())
    np.testing.assert_array_equal(read_frame(path, bgr=True), flag()[::-1])
    np.testing.assert_array_equal(read_frame(path, upside_down=True), flag()[..., ::-1])


def test_jpeg_with_thumbnail_trailer_or_scans_is_whole(tmp_path: Path) -> None:
    for number, options in enumerate([{}, {"progressive": True}, {"restart_marker_rows": 1}]):
        path = put(tmp_path / f"{number}.jpg", encoded(noise(), "JPEG", **options) + b"\xff\xda trailer")
        assert read_frame(path).shape == (HEIGHT, WIDTH, 3)


# Photographs


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


def test_png_has_8_or_16_bits(tmp_path: Path) -> None:
    with pytest.raises(ParameterError, match=r"`bits` \(12\)"):
        write_picture(tmp_path / "a.png", torch.rand(3, 4, 4), bits=12)


# Whole or not at all


def test_a_writer_that_fails_half_way_leaves_the_old_file(tmp_path: Path) -> None:
    path = put(tmp_path / "a.bin", b"old")
    with pytest.raises(RuntimeError, match="half-way"), atomic(path) as temporary:  # noqa: PT012
        assert temporary.parent == tmp_path
        assert temporary.suffix == ".bin"
        temporary.write_bytes(b"ne")
        raise RuntimeError("half-way")
    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]


def test_a_writer_that_succeeds_replaces_the_file(tmp_path: Path) -> None:
    path = tmp_path / "deep" / "a.bin"
    for content in (b"old", b"new"):
        with atomic(path) as temporary:
            temporary.write_bytes(content)
    assert path.read_bytes() == b"new"
    assert list(path.parent.iterdir()) == [path]


def test_a_link_is_followed(tmp_path: Path) -> None:
    target, link = put(tmp_path / "target.bin", b"old"), tmp_path / "link.bin"
    link.symlink_to(target)
    with atomic(link) as temporary:
        temporary.write_bytes(b"new")
    assert link.is_symlink()
    assert target.read_bytes() == b"new"


@pytest.mark.parametrize(
    ("write", "name"), [(write_picture, "a.png"), (write_linear, "a.npy"), (write_linear, "a.tif")]
)
def test_a_full_disk_is_an_image_error_and_keeps_the_old_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, write: Callable[..., None], name: str
) -> None:
    def full(_: int) -> None:
        raise OSError(28, "No space left on device")

    path = put(tmp_path / name, b"old")
    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(ImageError, match=rf"{name}` cannot be written: No space left on device"):
        write(path, torch.rand(3, 4, 4))
    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]


def test_a_file_where_a_folder_should_be(tmp_path: Path) -> None:
    put(tmp_path / "taken", b"")
    with pytest.raises(ImageError, match="cannot be written"):
        write_picture(tmp_path / "taken" / "a.png", torch.rand(3, 4, 4))


def test_a_folder_where_the_file_should_be(tmp_path: Path) -> None:
    (tmp_path / "a.png").mkdir()
    with pytest.raises(ImageError, match="cannot be written: Is a directory"):
        write_picture(tmp_path / "a.png", torch.rand(3, 4, 4))
    assert [path.name for path in tmp_path.iterdir()] == ["a.png"]


@pytest.mark.skipif(hasattr(os, "geteuid") and os.geteuid() == 0, reason="nothing is read-only to root")
def test_a_read_only_folder(tmp_path: Path) -> None:
    path = put(tmp_path / "a.png", b"secret")
    path.chmod(0)
    tmp_path.chmod(0o500)
    try:
        with pytest.raises(ImageError, match="cannot be written: Permission denied"):
            write_picture(tmp_path / "b.png", torch.rand(3, 4, 4))
        with pytest.raises(ImageError, match="cannot be read: Permission denied"):
            read_frame(path)
    finally:
        tmp_path.chmod(0o700)


# Bad files


def huge_png() -> bytes:
    header = chunk(b"IHDR", struct.pack(">IIBBBBB", 2**15, 2**15, 8, 2, 0, 0, 0))
    return b"\x89PNG\r\n\x1a\n" + header + chunk(b"IDAT", zlib.compress(b"")) + chunk(b"IEND", b"")


def huge_jpeg() -> bytes:
    data = encoded(noise(), "JPEG")
    size = data.index(b"\xff\xc0") + 5
    return data[:size] + struct.pack(">HH", 2**15, 2**15) + data[size + 4 :]


def huge_bmp() -> bytes:
    data = bytearray(encoded(noise(), "BMP"))
    data[18:26], data[30:34] = struct.pack("<ii", 2**15, -(2**15)), struct.pack("<I", 1)
    return bytes(data)


def huge_tiff() -> bytes:
    data = tiff(noise()[..., 0])
    for tag, number in ((256, WIDTH), (257, HEIGHT)):
        entries = [struct.pack("<HHIHxx", tag, kind, 1, number) for kind in (3, 4)]
        found = next(entry for entry in entries if entry in data)
        data = data.replace(found, struct.pack("<HHII", tag, 4, 1, 2**15))
    return data


def huge_npy() -> bytes:
    data = BytesIO()
    header = {"descr": "|u1", "fortran_order": False, "shape": (2**15, 2**15)}
    np.lib.format.write_array_header_1_0(data, header)
    return data.getvalue()


def damaged_png() -> bytes:
    data = bytearray(encoded(noise(), "PNG"))
    data[len(data) // 2] ^= 255
    return bytes(data)


def half(data: bytes) -> bytes:
    return data[: len(data) // 2]


PALETTE = tiff(noise()[..., 0], photometric="palette", colormap=np.zeros((3, 256), np.uint16))
PLANES = tiff(noise().transpose(2, 0, 1), imagej=True)

BAD = {
    "empty.png": (b"", "is empty"),
    "text.png": (b"version https://git-lfs.github.com/spec/v1\n", "starts with b'version '"),
    "text.npy": (b"1 2 3\n", "must be PNG, JPEG, BMP, TIFF or NPY"),
    "pickle.npy": (b"\x80\x04\x95\x05\x00\x00\x00\x00\x00\x00\x00]\x94.", "must be PNG"),
    "half.png": (half(encoded(noise(), "PNG")), "is cut off.* no end"),
    "tail.png": (encoded(noise(), "PNG")[:-12], "is cut off.* no end"),
    "header.png": (encoded(noise(), "PNG")[:11], "is cut off"),
    "damaged.png": (damaged_png(), "is damaged: the checksum of b'IDAT'"),
    "half.jpg": (half(encoded(noise(), "JPEG")), "is cut off.* no end"),
    "tail.jpg": (encoded(noise(), "JPEG")[:-2], "is cut off.* no end"),
    "scans.jpg": (half(encoded(noise(), "JPEG", progressive=True)), "is cut off"),
    "nothing.jpg": (b"\xff\xd8\xff\xd9", r"axes \(0 x 0\)"),
    "half.bmp": (half(encoded(noise(), "BMP")), "is cut off: this BMP has"),
    "header.bmp": (encoded(noise(), "BMP")[:20], "is cut off"),
    "text.bmp": (b"BM is also how a text may begin, so that this reads as a picture.", "is cut off|axes"),
    "half.tif": (half(tiff(noise(), photometric="rgb")), "cannot be read as TIFF"),
    "deflated.tif": (half(tiff(noise(), photometric="rgb", compression="zlib")), "cannot be read as TIFF"),
    "header.tif": (tiff(noise()[..., 0])[:8], "is cut off"),
    "tags.tif": (tiff(noise()[..., 0])[:100], "TIFF"),
    "end.tif": (encoded(noise(), "TIFF", compression="tiff_adobe_deflate")[:-200], "is cut off|as TIFF"),
    "planes.tif": (PLANES[: len(PLANES) // 2], "is cut off: its list of pages"),
    "palette.tif": (PALETTE, "stores its colours as PALETTE"),
    "half.npy": (half(npy(noise())), "NPY"),
    "header.npy": (npy(noise())[:20], "NPY"),
    "objects.npy": (npy(np.array([[None]]), allow_pickle=True), "NPY.*[Oo]bject"),
    "huge.png": (huge_png(), "claims 32,768 x 32,768 pixels"),
    "huge.jpg": (huge_jpeg(), "claims 32,768 x 32,768 pixels"),
    "huge.bmp": (huge_bmp(), "claims 32,768 x 32,768 pixels"),
    "huge.tif": (huge_tiff(), "claims 32,768 x 32,768 pixels"),
    "complex.npy": (npy(noise("complex64")), "holds complex64"),
    "bool.npy": (npy(noise("bool")), "holds bool"),
    "int64.npy": (npy(noise("int64")), "holds int64; a frame has uint8, uint16 or floats"),
    "record.npy": (npy(np.zeros((2, 2), "u1,u1")), "a frame has uint8"),
    "bits.tif": (tiff(noise("bool")[..., 0]), "holds bool"),
    "complex.tif": (tiff(noise("complex64")[..., 0]), "holds complex64"),
    "line.npy": (npy(np.zeros(5, np.uint8)), r"axes \(5\)"),
    "stack.npy": (npy(np.zeros((2, 5, 6, 3), np.uint8)), r"axes \(2 x 5 x 6 x 3\)"),
    "planar.npy": (npy(np.zeros((3, 5, 6), np.uint8)), "channels last"),
    "two.npy": (npy(noise(channels=2)), r"axes \(37 x 51 x 2\)"),
    "five.npy": (npy(noise(channels=5)), r"axes \(37 x 51 x 5\)"),
    "pages.tif": (tiff(np.zeros((2, 5, 6), np.uint8)), r"axes \(2 x 5 x 6\)"),
    "two.tif": (tiff(noise(channels=2), planarconfig="contig"), r"axes \(37 x 51 x 2\)"),
    "nothing.npy": (npy(np.zeros((0, 4, 3), np.uint8)), "a frame has|NPY"),
    "nan.npy": (npy(np.full((4, 4), np.nan, np.float32)), "holds NaN or infinity"),
    "infinity.tif": (tiff(np.full((4, 4), np.inf, np.float32)), "holds NaN or infinity"),
    "too_large.npy": (npy(np.full((4, 4), 1e300)), "holds NaN or infinity"),
}  # fmt: skip


@pytest.mark.parametrize("name", BAD)
@pytest.mark.parametrize("read", [read_frame, read_picture])
def test_a_bad_file_is_named_with_its_fault(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], read: Callable[[Path], object], name: str
) -> None:
    data, message = BAD[name]
    path = put(tmp_path / name, data)
    with pytest.raises(ImageError, match=message) as caught:
        read(path)
    assert str(caught.value).startswith(f"`{path}` ")
    assert str(caught.value).endswith((".", "`."))
    assert capfd.readouterr() == ("", "")


def test_a_huge_npy_that_is_whole(tmp_path: Path) -> None:
    path = put(tmp_path / "a.npy", huge_npy())
    os.truncate(path, path.stat().st_size + 2**30)  # sparse: no disk is used
    with pytest.raises(ImageError, match="claims 32,768 x 32,768 pixels"):
        read_frame(path)
    assert MAX_PIXELS < 2**30


def test_a_missing_file_and_a_folder(tmp_path: Path) -> None:
    with pytest.raises(ImageError, match=r"none\.png` does not exist"):
        read_frame(tmp_path / "none.png")
    with pytest.raises(ImageError, match="is a folder"):
        read_picture(tmp_path)


def test_every_cut_of_a_file_is_noticed(tmp_path: Path) -> None:
    files = {
        "a.png": encoded(noise(), "PNG"),
        "a.jpg": encoded(noise(), "JPEG"),
        "a.bmp": encoded(noise(), "BMP"),
    }
    files |= {"a.npy": npy(noise()), "a.tif": tiff(noise(), photometric="rgb"), "b.tif": PLANES}
    for name, data in files.items():
        for length in range(0, len(data) - 24, 199):  # ImageJ files end in 20 bytes that nobody needs
            with pytest.raises(ImageError, match=name):
                read_frame(put(tmp_path / name, data[:length]))


@pytest.mark.parametrize("compression", ["tiff_lzw", "tiff_adobe_deflate", "packbits"])
def test_compressed_tiff_is_read_exactly(tmp_path: Path, compression: str) -> None:
    """The paper's PSF is LZW, which tifffile leaves to another package and OpenCV reads."""
    path = put(tmp_path / "a.tif", encoded(noise(), "TIFF", compression=compression))
    np.testing.assert_array_equal(read_frame(path), noise())


# The package itself


def test_importing_it_loads_no_image_library() -> None:
    code = "import sys, mwdn.data; assert not {'cv2', 'tifffile'} & set(sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True)


def test_readable_suffixes_are_in_lower_case() -> None:
    assert {".png", ".tif", ".npy"} <= READABLE
    assert all(suffix == suffix.lower() and suffix.startswith(".") for suffix in READABLE)

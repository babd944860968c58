"""Every format and layout is read exactly; every damaged file is named with its fault."""

import os
import struct
import zlib
from collections.abc import Callable
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
import torch
from skimage import io as skimage_io

from image_files import BLUE, HEIGHT, RED, WIDTH, chunk, encoded, flag, noise, npy, png16, put, tiff
from mwdn.errors import ImageError
from mwdn.io.arrays import MAX_PIXELS
from mwdn.io.images import read_frame, read_picture, srgb_decode

RGB_OF_RGBA = noise(channels=4)[..., :3]
OPAQUE = np.concatenate([RGB_OF_RGBA, np.full_like(RGB_OF_RGBA[..., :1], 255)], -1)
GREY_OPAQUE = np.stack([noise()[..., 0], np.full_like(noise()[..., 0], 255)], -1)
TWELVE_BITS = b"P5 # a comment\n51 37\n# another\n4095\n" + (noise("uint16")[..., 0] >> 4).astype(">u2").tobytes()


@pytest.mark.parametrize(("name", "dtype"), [("a.png", "uint8"), ("a.tif", "uint8"), ("a.tif", "uint16")])
def test_what_skimage_writes_is_read_exactly(tmp_path: Path, name: str, dtype: str) -> None:
    skimage_io.imsave(tmp_path / name, noise(dtype), check_contrast=False)
    np.testing.assert_array_equal(read_frame(tmp_path / name), noise(dtype))


@pytest.mark.parametrize(
    ("name", "data", "expected"),
    [
        ("a.bmp", encoded(noise(), "BMP"), noise()),
        ("grey.bmp", encoded(noise()[..., 0], "BMP"), noise()[..., :1]),
        ("a.webp", encoded(noise(), "WebP", lossless=True), noise()),
        ("alpha.webp", encoded(OPAQUE, "WebP", lossless=True, exact=True), RGB_OF_RGBA),
        ("a.ppm", encoded(noise(), "PPM"), noise()),
        ("a.pgm", encoded(noise("uint16")[..., 0], "PPM"), noise("uint16")[..., :1]),
        ("12_bits.pgm", TWELVE_BITS, noise("uint16")[..., :1] >> 4),
        ("grey.png", encoded(noise()[..., 0], "PNG"), noise()[..., :1]),
        ("grey16.png", encoded(noise("uint16")[..., 0], "PNG"), noise("uint16")[..., :1]),
        ("rgb16.png", png16(noise("uint16")), noise("uint16")),
        ("alpha.png", encoded(OPAQUE, "PNG"), RGB_OF_RGBA),
        ("grey_alpha.png", encoded(GREY_OPAQUE, "PNG"), noise()[..., :1]),
        ("named_wrongly.jpg", encoded(noise(), "PNG"), noise()),
        ("trailer.png", encoded(noise(), "PNG") + b"maker's notes", noise()),
        ("planar.tif", tiff(noise().transpose(2, 0, 1), photometric="rgb", planarconfig="separate"), noise()),
        ("imagej.tif", tiff(noise().transpose(2, 0, 1), imagej=True), noise()),
        ("alpha.tif", tiff(OPAQUE, photometric="rgb", extrasamples=["unassalpha"]), RGB_OF_RGBA),
        ("alpha_lzw.tif", encoded(OPAQUE, "TIFF", compression="tiff_lzw"), RGB_OF_RGBA),
        ("big_endian.tif", tiff(noise(">u2"), photometric="rgb", byteorder=">"), noise("uint16")),
        ("big.tif", tiff(noise(), photometric="rgb", bigtiff=True), noise()),
        ("deflated.tif", tiff(noise(), photometric="rgb", compression="zlib", tile=(16, 16)), noise()),
        ("one_page.tif", tiff(noise("float32")[None, ..., 0]), noise("float32")[..., :1]),
        ("rows.tif", encoded(noise(), "TIFF"), noise()),
        ("grey.npy", npy(noise()[..., 0]), noise()[..., :1]),
        ("alpha.npy", npy(OPAQUE), RGB_OF_RGBA),
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


@pytest.mark.parametrize("compression", ["tiff_lzw", "tiff_adobe_deflate", "packbits"])
def test_compressed_tiff_is_read_exactly(tmp_path: Path, compression: str) -> None:
    """The paper's PSF is LZW, which tifffile leaves to another package and OpenCV reads."""
    path = put(tmp_path / "a.tif", encoded(noise(), "TIFF", compression=compression))
    np.testing.assert_array_equal(read_frame(path), noise())


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
        entry = next(entry for entry in entries if entry in data)
        data = data.replace(entry, struct.pack("<HHII", tag, 4, 1, 2**15))
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
    "text.npy": (b"1 2 3\n", "must be PNG.* raw file"),
    "pickle.npy": (b"\x80\x04\x95\x05\x00\x00\x00\x00\x00\x00\x00]\x94.", "must be PNG"),
    "half.png": (half(encoded(noise(), "PNG")), "is cut off.* no end"),
    "tail.png": (encoded(noise(), "PNG")[:-12], "is cut off.* no end"),
    "header.png": (encoded(noise(), "PNG")[:11], "is cut off"),
    "damaged.png": (damaged_png(), "is damaged: the checksum of b'IDAT'"),
    "half.jpg": (half(encoded(noise(), "JPEG")), "is cut off.* no end"),
    "tail.jpg": (encoded(noise(), "JPEG")[:-2], "is cut off.* no end"),
    "scans.jpg": (half(encoded(noise(), "JPEG", progressive=True)), "is cut off"),
    "nothing.jpg": (b"\xff\xd8\xff\xd9", r"shape \(0 x 0\)"),
    "half.bmp": (half(encoded(noise(), "BMP")), "is cut off: this BMP has"),
    "header.bmp": (encoded(noise(), "BMP")[:20], "is cut off"),
    "text.bmp": (b"BM is also how a text may begin, so that this reads as a picture.", "BMP with compression"),
    "half.webp": (half(encoded(noise(), "WebP")), "is cut off: this WebP has"),
    "header.webp": (encoded(noise(), "WebP")[:20], "is cut off"),
    "half.ppm": (half(encoded(noise(), "PPM")), "is cut off: this PGM or PPM has"),
    "header.pgm": (b"P5\n51", "is damaged"),
    "huge.pgm": (b"P5 32768 32768 255\n", "claims 32,768 x 32,768 pixels"),
    "half.tif": (half(tiff(noise(), photometric="rgb")), "is cut off: a strip"),
    "deflated.tif": (half(tiff(noise(), photometric="rgb", compression="zlib")), "is cut off: a strip"),
    "header.tif": (tiff(noise()[..., 0])[:8], "is cut off"),
    "tags.tif": (tiff(noise()[..., 0])[:100], "is cut off: its list of pages"),
    "end.tif": (encoded(noise(), "TIFF", compression="tiff_adobe_deflate")[:-200], "is cut off"),
    "planes.tif": (PLANES[: len(PLANES) // 2], "is cut off: its list of pages"),
    "palette.tif": (PALETTE, "stores its colours as PALETTE"),
    "half.npy": (half(npy(noise())), "NPY"),
    "header.npy": (npy(noise())[:20], "NPY"),
    "objects.npy": (npy(np.array([[None]]), allow_pickle=True), "NPY.*[Oo]bject"),
    "huge.png": (huge_png(), "claims 32,768 x 32,768 pixels"),
    "huge.jpg": (huge_jpeg(), "claims 32,768 x 32,768 pixels"),
    "huge.bmp": (huge_bmp(), "is a BMP with compression"),
    "huge.tif": (huge_tiff(), "claims 32,768 x 32,768 pixels"),
    "complex.npy": (npy(noise("complex64")), "holds complex64"),
    "bool.npy": (npy(noise("bool")), "holds bool"),
    "int64.npy": (npy(noise("int64")), "holds int64; a frame has uint8, uint16 or floats"),
    "record.npy": (npy(np.zeros((2, 2), "u1,u1")), "a frame has uint8"),
    "bits.tif": (tiff(noise("bool")[..., 0]), "holds bool"),
    "complex.tif": (tiff(noise("complex64")[..., 0]), "holds complex64"),
    "line.npy": (npy(np.zeros(5, np.uint8)), r"shape \(5\)"),
    "stack.npy": (npy(np.zeros((2, 5, 6, 3), np.uint8)), r"shape \(2 x 5 x 6 x 3\)"),
    "planar.npy": (npy(np.zeros((3, 5, 6), np.uint8)), "channels first"),
    "two.npy": (npy(noise(channels=2)), r"shape \(37 x 51 x 2\)"),
    "five.npy": (npy(noise(channels=5)), r"shape \(37 x 51 x 5\)"),
    "pages.tif": (tiff(np.zeros((2, 5, 6), np.uint8)), "is a stack of 2 pictures"),
    "two.tif": (tiff(noise(channels=2), planarconfig="contig"), r"shape \(37 x 51 x 2\)"),
    "nothing.npy": (npy(np.zeros((0, 4, 3), np.uint8)), "shape \\(0 x 4 x 3\\)|NPY"),
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


TRANSPARENT = {
    "a.png": encoded(noise(channels=4), "PNG"),
    "grey.png": encoded(noise(channels=2), "PNG"),
    "a.webp": encoded(noise(channels=4), "WebP", lossless=True, exact=True),
    "a.tif": tiff(noise(channels=4), photometric="rgb", extrasamples=["unassalpha"]),
    "lzw.tif": encoded(noise(channels=4), "TIFF", compression="tiff_lzw"),
    "a.npy": npy(noise(channels=4)),
}


@pytest.mark.parametrize("name", TRANSPARENT)
def test_transparent_pixels_are_refused_in_frames_and_dropped_in_photographs(tmp_path: Path, name: str) -> None:
    path = put(tmp_path / name, TRANSPARENT[name])
    with pytest.raises(ImageError, match=r"is transparent in \d.*% of its pixels"):
        read_frame(path)
    assert read_picture(path).shape == (1, 3, *noise().shape[:2])


def test_white_of_a_photograph_is_the_largest_number_of_its_pgm(tmp_path: Path) -> None:
    """A photograph of 12 bits was sixteen times too dark. Frames stay as they are stored."""
    path = tmp_path / "12_bits.pgm"
    path.write_bytes(b"P5 3 1 4095\n" + np.array([0, 2048, 4095], ">u2").tobytes())
    light = srgb_decode(torch.tensor([0, 2048 / 4095, 1]))
    torch.testing.assert_close(read_picture(path), light.expand(1, 3, 1, 3), rtol=1e-4, atol=0)
    assert read_frame(path).ravel().tolist() == [0, 2048, 4095]


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
        "a.webp": encoded(noise(), "WebP"),
        "a.ppm": encoded(noise(), "PPM"),
    }
    files |= {"a.npy": npy(noise()), "a.tif": tiff(noise(), photometric="rgb"), "b.tif": PLANES}
    for name, data in files.items():
        for length in range(0, len(data) - 24, 199):  # ImageJ files end in 20 bytes that nobody needs
            with pytest.raises(ImageError, match=name):
                read_frame(put(tmp_path / name, data[:length]))

"""A frame is whole or refused: files whose damage decoders pass over in silence, and files made to fill the memory."""

import struct
import threading
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
import tifffile

from image_files import HEIGHT, WIDTH, chunk, encoded, noise, put, tiff
from mwdn.errors import ImageError
from mwdn.io.decoder_messages import decoder_messages
from mwdn.io.images import read_frame
from mwdn.io.tiff_codecs import lzw_size


def refusal(path: Path, data: bytes) -> str:
    with pytest.raises(ImageError) as caught:
        read_frame(put(path, data))
    message = str(caught.value)
    assert message.startswith(f"`{path}` ")
    assert message.isprintable()
    assert len(message.replace(str(path), "")) < 300
    return message


def changed(data: bytes, position: int, *numbers: int) -> bytes:
    return data[:position] + bytes(numbers) + data[position + len(numbers) :]


def with_tag(data: bytes, tag: int, value: int) -> bytes:
    """A little-endian TIFF with another value of one of its tags of 16 or 32 bits."""
    start, count = struct.unpack_from("<I", data, 4)[0], 0
    (count,) = struct.unpack_from("<H", data, start)
    entry = next(
        at for at in range(start + 2, start + 2 + 12 * count, 12) if data[at : at + 2] == struct.pack("<H", tag)
    )
    return data[: entry + 8] + struct.pack("<I", value) + data[entry + 12 :]


def test_damaged_pixels_of_a_jpeg_are_refused_and_libjpeg_prints_nothing(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """79 of 320 damaged JPEGs read as good while libjpeg printed `Corrupt JPEG data`."""
    data = encoded(noise(), "JPEG")
    assert "is damaged: Corrupt JPEG data" in refusal(tmp_path / "a.jpg", data[: len(data) // 2] + b"\xff\xd9")
    assert "is damaged" in refusal(tmp_path / "a.jpg", changed(data, len(data) // 2, 0xFF, 0xD3))
    read_frame(put(tmp_path / "a.jpg", data))
    assert capfd.readouterr() == ("", "")


def test_decoders_in_threads_keep_their_messages_apart(tmp_path: Path) -> None:
    good, bad = encoded(noise(), "JPEG"), encoded(noise(), "JPEG")[:-400] + b"\xff\xd9"
    wrong: list[str] = []

    def read(name: str, data: bytes, whole: bool) -> None:
        path = put(tmp_path / name, data)
        for _ in range(20):
            try:
                read_frame(path)
                wrong.extend([name] * (not whole))
            except ImageError:
                wrong.extend([name] * whole)

    threads = [threading.Thread(target=read, args=(f"{n}.jpg", bad if n % 2 else good, n % 2 == 0)) for n in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert wrong == []


def test_messages_end_with_the_decoder(capfd: pytest.CaptureFixture[str]) -> None:
    bad = np.frombuffer(encoded(noise(), "JPEG")[:-400] + b"\xff\xd9", np.uint8)
    for _ in range(3):
        with decoder_messages() as lines:
            cv2.imdecode(bad, cv2.IMREAD_UNCHANGED)
        assert len(lines) == 1
    cv2.imdecode(bad, cv2.IMREAD_UNCHANGED)
    assert "Corrupt JPEG data" in capfd.readouterr().err


def test_a_jpeg_claims_no_more_than_it_holds(tmp_path: Path) -> None:
    data = encoded(noise(), "JPEG")
    size = data.index(b"\xff\xc0") + 5
    message = refusal(tmp_path / "a.jpg", data[:size] + struct.pack(">HH", 8192, 8192) + data[size + 4 :])
    assert "JPEG of 8,192 x 8,192 has" in message


def test_a_jpeg_of_many_scans_is_refused(tmp_path: Path) -> None:
    """41 kB took 87 s: each scan passes over all pixels."""
    data = encoded(np.zeros((1024, 1024), np.uint8), "JPEG", progressive=True)
    scan = data[data.rindex(b"\xff\xda") : -2]
    assert "scans, which would take long" in refusal(tmp_path / "a.jpg", data[:-2] + 400 * scan + b"\xff\xd9")
    assert read_frame(put(tmp_path / "a.jpg", data)).shape == (1024, 1024, 1)


@pytest.mark.parametrize("compression", ["tiff_lzw", "packbits", "tiff_adobe_deflate"])
def test_a_damaged_strip_of_a_tiff_is_refused(tmp_path: Path, compression: str) -> None:
    """LZW and PackBits came back with black rows."""
    data = encoded(noise(), "TIFF", compression=compression)
    for position in (200, 1000, 2000):
        assert "is damaged" in refusal(tmp_path / "a.tif", changed(data, position, *[255] * 200))


@pytest.mark.parametrize("compression", [0, 7, 999, 33003, 34712, 50002])
def test_an_unknown_compression_of_a_tiff_is_refused(tmp_path: Path, compression: int) -> None:
    """These came back all black."""
    message = refusal(tmp_path / "a.tif", with_tag(tiff(noise(), photometric="rgb"), 259, compression))
    assert f"({compression}), which is not read" in message or "damaged" in message


@pytest.mark.parametrize("predictor", [True, False])
@pytest.mark.parametrize("dtype", ["uint8", ">u2", "float32"])
@pytest.mark.parametrize("layout", [{}, {"tile": (16, 32)}, {"rowsperstrip": 5}, {"planarconfig": "separate"}])
def test_strips_tiles_and_predictors_are_exact(tmp_path: Path, predictor: bool, dtype: str, layout: dict) -> None:
    predictor &= dtype != "float32"
    options = {"photometric": "rgb", "compression": "zlib", "predictor": predictor, **layout}
    picture = noise(dtype).transpose(2, 0, 1) if "planarconfig" in layout else noise(dtype)
    path = put(tmp_path / "a.tif", tiff(picture, **options))
    np.testing.assert_array_equal(read_frame(path), noise(dtype))


@pytest.mark.parametrize("compression", [5, 32773])
@pytest.mark.parametrize("shape", [(400, 300), (1, 1), (3, 5000), (700, 700, 3)])
def test_what_opencv_compresses_is_exact(tmp_path: Path, compression: int, shape: tuple[int, ...]) -> None:
    """Runs and noise: short and long strings, full tables of LZW, 9 to 12 bits."""
    random = np.random.default_rng(0)
    picture = random.integers(0, 2**16, shape) >> random.integers(8, 17, shape[0]).reshape(-1, *[1] * (len(shape) - 1))
    picture = picture.astype(np.uint8)
    data = cv2.imencode(".tif", picture, [cv2.IMWRITE_TIFF_COMPRESSION, compression])[1].tobytes()
    expected = picture[..., ::-1] if picture.ndim == 3 else picture[..., None]
    np.testing.assert_array_equal(read_frame(put(tmp_path / "a.tif", data)), expected)


def test_a_float_tiff_with_a_predictor_is_exact(tmp_path: Path) -> None:
    """Made by hand from Adobe's technical note 3: tifffile writes none without imagecodecs."""
    picture = noise("float32", 1)[..., 0] / 7
    highest_first = picture.astype(">f4").view(np.uint8).reshape(HEIGHT, WIDTH, 4).swapaxes(1, 2).reshape(HEIGHT, -1)
    packed = zlib.compress(np.diff(highest_first, axis=1, prepend=np.zeros((HEIGHT, 1), np.uint8)).tobytes())
    data = tiff(picture.view(np.int32), compression="zlib", predictor=True, metadata=None)
    offset, stored, predictor, floats = (273, len(data)), (279, len(packed)), (317, 3), (339, 3)
    for tag, value in (offset, stored, predictor, floats):
        data = with_tag(data, tag, value)
    np.testing.assert_array_equal(read_frame(put(tmp_path / "a.tif", data + packed)), picture[..., None])


def test_a_tiff_whose_picture_is_elsewhere_is_refused(tmp_path: Path) -> None:
    """OME-TIFF reached any readable file, and a pipe hung."""
    put(tmp_path / "secret.tif", tiff(noise(), photometric="rgb"))
    description = '<OME><Image><Pixels><TiffData><UUID FileName="secret.tif"/></TiffData></Pixels></Image></OME>'
    data = tiff(noise()[..., 0], description=description, metadata=None)
    assert "OME-TIFF that names other files" in refusal(tmp_path / "a.tif", data)


def test_pages_in_a_circle_are_refused(tmp_path: Path) -> None:
    data = tiff(noise()[..., 0])
    start = struct.unpack_from("<I", data, 4)[0]
    link = start + 2 + 12 * struct.unpack_from("<H", data, start)[0]
    assert "circle" in refusal(tmp_path / "a.tif", changed(data, link, *struct.pack("<I", start)))


@pytest.mark.parametrize("steps", [(1, 4), (4, 1), (4, 1, 2)])
def test_thumbnails_beside_the_picture_are_ignored(tmp_path: Path, steps: tuple[int, ...]) -> None:
    """Cameras put them first or last."""
    with tifffile.TiffWriter(tmp_path / "a.tif") as file:
        for step in steps:
            file.write(noise()[::step, ::step], photometric="rgb", subfiletype=int(step > 1), metadata=None)
    np.testing.assert_array_equal(read_frame(tmp_path / "a.tif"), noise())


def test_a_picture_that_would_fill_the_memory_is_refused(tmp_path: Path) -> None:
    """A float64 TIFF of 6.3 MB took 12.2 GB and 56 s, a PNG of 2 MB 4.2 GB."""
    data = with_tag(with_tag(tiff(noise("float64"), photometric="rgb"), 256, 16384), 257, 16384)
    assert "at most 1,073,741,824" in refusal(tmp_path / "a.tif", data)
    header = chunk(b"IHDR", struct.pack(">IIBBBBB", 12000, 12000, 16, 2, 0, 0, 0))
    png = b"\x89PNG\r\n\x1a\n" + header + chunk(b"IDAT", bytes(2**20)) + chunk(b"IEND", b"")
    assert "made to fill the memory" in refusal(tmp_path / "a.png", png)


def test_an_lzw_code_that_is_its_own_beginning_is_refused():
    """The first code after a clear code was entry 258, which it would make itself: its links were followed forever."""
    with pytest.raises(ImageError, match="code is not in its table"):
        lzw_size(bytes([0b10000000, 0b01000000, 0b10000000]) + bytes(20), 100)  # codes 256 and 258 of 9 bits

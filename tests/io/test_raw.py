"""Raw files: the sensor's numbers, scaled from black to white, and the order of its colours."""

import sys
from pathlib import Path
from typing import get_args

import numpy as np
import pytest

from image_files import dng, put
from mwdn import Calibration, FrameFormat
from mwdn.errors import ImageError, MissingPackageError, ParameterError
from mwdn.io.images import read_frame, read_picture, write_frame
from mwdn.io.raw import Mosaic, read_raw

BLACK, WHITE = 64, 1023


@pytest.fixture(autouse=True)
def _rawpy():
    pytest.importorskip("rawpy")


@pytest.fixture
def mosaic():
    """36 x 48 numbers of 10 bits."""
    return np.random.default_rng(0).integers(0, WHITE + 1, (36, 48), dtype=np.uint16)


def light(mosaic: np.ndarray) -> np.ndarray:
    """0 at black, 65,535 at white."""
    return (mosaic.astype(float) - BLACK).clip(0) * 65535 / (WHITE - BLACK)


@pytest.mark.parametrize("colours", get_args(Mosaic))
def test_mosaic_is_read_exactly(tmp_path: Path, mosaic: np.ndarray, colours: str) -> None:
    path = put(tmp_path / "a.dng", dng(mosaic, colours, turn=6))
    raw = read_raw(path)
    assert raw.mosaic == colours
    np.testing.assert_allclose(raw.frame[..., 0], light(mosaic), atol=1)  # not turned
    np.testing.assert_array_equal(read_frame(path), raw.frame)


@pytest.mark.parametrize("colours", get_args(Mosaic))
def test_a_raw_file_needs_no_options(tmp_path: Path, colours: str) -> None:
    """Red, green and blue of 100, 200 and 300 above black, in whichever order the sensor has them."""
    levels = {"r": 100, "g": 200, "b": 300}
    cell = np.array([levels[letter] for letter in colours], np.uint16).reshape(2, 2)
    path = put(tmp_path / "a.dng", dng(np.tile(cell, (18, 24)) + np.uint16(BLACK), colours))
    measurement = FrameFormat().to_measurement(FrameFormat().read(path))
    assert measurement.shape == (1, 3, 18, 24)
    expected = np.array([100, 200, 300]) / (WHITE - BLACK)
    np.testing.assert_allclose(measurement.mean((0, 2, 3)), expected, atol=1e-5)


def test_another_mosaic_than_the_files_is_refused(tmp_path: Path, mosaic: np.ndarray) -> None:
    """A flipped sensor exchanged red and blue without a word."""
    psf, flipped = put(tmp_path / "psf.dng", dng(mosaic, "grbg")), put(tmp_path / "flipped.dng", dng(mosaic, "gbrg"))
    camera = Calibration.from_file(psf)
    assert camera.frames.mosaic == "grbg"
    np.testing.assert_array_equal(camera.frames.read(psf), read_frame(psf))
    for refused in (lambda: camera.frames.read(flipped), lambda: Calibration.from_file(flipped, mosaic="grbg")):
        with pytest.raises(ParameterError, match=r"grbg.*flipped\.dng.*gbrg"):
            refused()


def test_crop_counts_the_pixels_of_the_sensor(tmp_path: Path, mosaic: np.ndarray) -> None:
    """It counted cells, so the same numbers cropped a raw file and the TIFF made of it differently."""
    path, tiff = put(tmp_path / "psf.dng", dng(mosaic, "gbrg")), tmp_path / "psf.tif"
    write_frame(tiff, read_raw(path).frame)
    raw = Calibration.from_file(path, crop=(20, 24), background=0.0)
    plain = Calibration.from_file(tiff, crop=(20, 24), background=0.0, mosaic="gbrg")
    assert raw.size == (10, 12)
    assert raw.frames == plain.frames
    np.testing.assert_array_equal(raw.psf, plain.psf)
    np.testing.assert_array_equal(raw.correct(raw.frames.read(path)), plain.correct(plain.frames.read(tiff)))
    with pytest.raises(ParameterError, match=r"`crop` \(20 x 24\) counts raw pixels.*\(gbrg\)"):
        FrameFormat(crop=(20, 24)).read(path)  # of a PSF that is no raw file
    assert FrameFormat(crop=(20, 24)).read(tiff).shape == (36, 48, 1)


def test_a_grey_sensor_has_no_cells(tmp_path: Path, mosaic: np.ndarray) -> None:
    path = put(tmp_path / "a.dng", dng(mosaic, ""))
    assert read_raw(path).mosaic is None
    np.testing.assert_allclose(FrameFormat().read(path)[..., 0], light(mosaic), atol=1)


def test_a_linear_dng_has_colours(tmp_path: Path) -> None:
    picture = np.random.default_rng(0).integers(0, WHITE + 1, (36, 48, 3), dtype=np.uint16)
    path = put(tmp_path / "a.dng", dng(picture, ""))
    np.testing.assert_allclose(FrameFormat().read(path), light(picture), atol=1)


def test_other_mosaics_are_refused(tmp_path: Path) -> None:
    mosaic = np.zeros((36, 48), np.uint16)
    with pytest.raises(ImageError, match=r"a\.dng` has a mosaic"):
        read_raw(put(tmp_path / "a.dng", dng(mosaic, "rgbrgbrgb" * 4)))


def test_a_raw_file_under_the_name_of_a_tiff_is_refused(tmp_path: Path, mosaic: np.ndarray) -> None:
    """Its numbers are without black level and mosaic there. An upload to `mwdn preview` has no suffix at all."""
    for name in ("a.tif", "capture"):
        with pytest.raises(ImageError, match=r"raw file \(DNG\).*\.dng"):
            read_frame(put(tmp_path / name, dng(mosaic)))


def test_saturation_is_known(tmp_path: Path, mosaic: np.ndarray) -> None:
    mosaic[:] = 500
    mosaic[:2, :4] = WHITE
    frame = FrameFormat().read(put(tmp_path / "a.dng", dng(mosaic)))
    assert FrameFormat().saturated(frame) == (2, 65535)


def test_odd_sides_lose_a_row_and_a_column(tmp_path: Path, mosaic: np.ndarray) -> None:
    path = put(tmp_path / "a.dng", dng(mosaic[:35, :47]))
    assert FrameFormat().read(path).shape == (17, 23, 3)


@pytest.mark.parametrize(
    ("name", "data", "message"),
    [
        ("text.dng", b"no raw file", "text.dng` cannot be read as a raw file"),
        ("empty.nef", b"", "empty.nef` cannot be read as a raw file"),
        ("white.dng", dng(np.zeros((36, 48), np.uint16), white=64), r"white level \(64\).* black level \(64\)"),
    ],
)
def test_bad_files_are_named(tmp_path: Path, name: str, data: bytes, message: str) -> None:
    with pytest.raises(ImageError, match=message):
        read_frame(put(tmp_path / name, data))


def test_other_files_and_uses_are_named(tmp_path: Path, mosaic: np.ndarray) -> None:
    with pytest.raises(ImageError, match=r"none\.dng` does not exist"):
        read_raw(tmp_path / "none.dng")
    path = put(tmp_path / "a.dng", dng(mosaic))
    with pytest.raises(ImageError, match=r"a\.dng` is a camera's raw file, not a photograph"):
        read_picture(path)


def test_without_rawpy_the_extra_is_named(tmp_path: Path, mosaic: np.ndarray, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "rawpy", None)
    with pytest.raises(MissingPackageError, match=r"a\.dng`.*pip install 'mwdn\[raw\]'"):
        read_frame(put(tmp_path / "a.dng", dng(mosaic)))

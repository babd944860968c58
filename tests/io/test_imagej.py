"""TIFFs for ImageJ: channels, scale and display range, by tifffile, Pillow and ImageJ itself."""

import os
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
import tifffile
import torch
from PIL import Image

import mwdn
from mwdn.errors import ImageError, ParameterError
from mwdn.io import write_imagej

SIZE = (5, 7)
PROGRAM = """
import ij.*;
public class Check {
  public static void main(String[] arguments) {
    ImagePlus image = IJ.openImage(arguments[0]);
    System.out.println(image.getWidth() + " " + image.getHeight() + " " + image.getNChannels()
      + " " + image.getBitDepth() + " " + image.getCalibration().pixelWidth + " "
      + image.getCalibration().getUnit());
    for (int c = 1; c <= image.getStackSize(); c++)
      System.out.println(image.getStack().getProcessor(c).getf(1, 2) + " " + image.getLuts()[c - 1].min
        + " " + image.getLuts()[c - 1].max + " " + Integer.toHexString(image.getLuts()[c - 1].getRGB(255)));
  }
}
"""


@pytest.fixture
def scene(generator):
    return 3 * torch.rand(1, 3, *SIZE, generator=generator) - 0.1


@pytest.mark.parametrize("channels", [1, 3])
def test_the_numbers_return(channels, scene, tmp_path):
    write_imagej(tmp_path / "scene.tif", scene[:, :channels], pixel_um=2.4)
    frame = mwdn.read_frame(tmp_path / "scene.tif")
    np.testing.assert_array_equal(frame, scene[0, :channels].movedim(0, -1).numpy())


@pytest.mark.parametrize("shape", [(7, 1), (7, 1, 3), (1, 1, 3), (1, 7, 3)])
def test_frames_of_one_row_or_column_return(shape, tmp_path):
    frame = np.random.default_rng(0).random(shape, np.float32)
    write_imagej(tmp_path / "scene.tif", frame)
    np.testing.assert_array_equal(mwdn.read_frame(tmp_path / "scene.tif"), np.atleast_3d(frame))


def test_without_light_the_display_range_ends_at_1(tmp_path):
    write_imagej(tmp_path / "scene.tif", np.full((5, 7), -0.1, np.float32))
    with tifffile.TiffFile(tmp_path / "scene.tif") as file:
        assert (file.imagej_metadata["min"], file.imagej_metadata["max"]) == (0, 1)


@pytest.mark.parametrize("channels", [1, 3])
def test_tifffile_finds_channels_scale_and_range(channels, scene, tmp_path):
    write_imagej(tmp_path / "scene.tif", scene[:, :channels], pixel_um=2.5)
    with tifffile.TiffFile(tmp_path / "scene.tif") as file:
        about, page = file.imagej_metadata, file.pages[0]
        assert file.is_imagej
        assert file.series[0].axes == ("CYX" if channels == 3 else "YX")
        assert about["unit"] == "um"
        assert [np.divide(*page.tags[tag].value) for tag in ("XResolution", "YResolution")] == pytest.approx([0.4, 0.4])
        white = np.quantile(scene[:, :channels].numpy(), 0.997)
        shown = about["Ranges"] if channels == 3 else (about["min"], about["max"])
        assert shown == pytest.approx((0, white) * channels)


def test_pillow_reads_the_first_channel(scene, tmp_path):
    write_imagej(tmp_path / "scene.tif", scene)
    with Image.open(tmp_path / "scene.tif") as image:
        assert image.mode == "F"
        np.testing.assert_array_equal(np.asarray(image), scene[0, 0].numpy())


def test_without_a_pitch_there_is_no_scale(scene, tmp_path):
    write_imagej(tmp_path / "scene.tif", scene)
    with tifffile.TiffFile(tmp_path / "scene.tif") as file:
        assert "unit" not in file.imagej_metadata


def test_impossible_files_are_refused(scene, tmp_path):
    with pytest.raises(ParameterError, match=r"`pixel_um` \(0\.0\)"):
        write_imagej(tmp_path / "scene.tif", scene, pixel_um=0.0)
    for pixel_um in (1e-300, 1e10):  # no fraction of a TIFF
        with pytest.raises(ParameterError, match="1e-9 to 1e9"):
            write_imagej(tmp_path / "scene.tif", scene, pixel_um=pixel_um)
    with pytest.raises(ImageError, match="NaN"):
        write_imagej(tmp_path / "scene.tif", scene / 0 * 0)
    with pytest.raises(ImageError, match=r"\.png"):
        write_imagej(tmp_path / "scene.png", scene)
    assert not list(tmp_path.iterdir())


@pytest.mark.acceptance
def test_imagej_opens_it(scene, tmp_path):
    """Debian's `libij-java` with a JDK, or the jar that `MWDN_IMAGEJ` names."""
    jar = Path(os.environ.get("MWDN_IMAGEJ", "/usr/share/java/ij.jar"))
    if not (shutil.which("javac") and jar.is_file()):
        pytest.skip(f"No Java compiler, or no ImageJ at {jar}.")
    write_imagej(tmp_path / "scene.tif", scene, pixel_um=2.5)
    (tmp_path / "Check.java").write_text(PROGRAM)
    line = ["java", "-Djava.awt.headless=true", "-cp", jar, "Check.java", "scene.tif"]
    process = subprocess.run(line, cwd=tmp_path, capture_output=True, encoding="utf-8", check=True)
    about, *channels = process.stdout.splitlines()
    assert about == "7 5 3 32 2.5 µm"
    white = float(np.quantile(scene.numpy(), 0.997))
    for channel, value, colour in zip(channels, scene[0, :, 2, 1], ("ffff0000", "ff00ff00", "ff0000ff"), strict=True):
        *numbers, lut = channel.split()
        assert list(map(float, numbers)) == pytest.approx([float(value), 0, white])
        assert lut == colour

"""Camera files: what is written is read, what is wrong is named."""

import os
import shutil
import sys
from contextlib import suppress
from pathlib import Path
from typing import get_args

import cv2
import numpy as np
import pytest
import torch

from cameras import contour_psf
from mwdn import Calibration
from mwdn.calibration import FrameFormat, PsfFormat
from mwdn.calibration.camera_file import KEYS, named_files, read_camera, write_camera
from mwdn.calibration.camera_parts import draft_of, write_camera_with_parts
from mwdn.calibration.corrections import Corrections
from mwdn.errors import ImageError, MwdnError, ParameterError, PsfError, UnknownNameError
from mwdn.io.images import read_frame, write_frame
from mwdn.io.toml import read_toml
from mwdn.optics.orientation import Orientation

SIZE = 32, 40


@pytest.fixture
def folder(tmp_path, generator):
    """`psf.png`, a coloured source in `lab`, and `lab/dark.png`, `lab/ambient.png`."""
    (tmp_path / "lab").mkdir()
    psf = contour_psf(SIZE, cell=10, generator=generator)
    light = (0.9 * psf / psf.max())[0].expand(3, -1, -1).movedim(0, -1) * torch.tensor([0.5, 1.0, 0.8])
    for name, image in (("psf", light), ("dark", torch.full_like(light, 0.01)), ("ambient", torch.rand_like(light))):
        assert cv2.imwrite(str(tmp_path / f"lab/{name}.png"), (image.flip(-1) * 65535).numpy().astype(np.uint16))
    return tmp_path


def everything(folder):
    """A value for each key."""
    return {
        "psf": folder / "lab/psf.png",
        "dark": folder / "lab/dark.png",
        "ambient": folder / "lab/ambient.png",
        "background": 0.01,
        "psf_bin": 2,
        "psf_bit_depth": 8,
        "psf_gamma": "srgb",
        "psf_orientation": "rotate-180",
        "bgr": True,
        "bit_depth": 16,
        "gamma": 2.2,
        "crop": (16, 20),
        "mosaic": "rggb",
        "grey": True,
        "bin": 2,
        "upside_down": True,
        "white_balance": (1.5, 1.0, 2.0),
        "pitch_um": 4.8,
        "distance_mm": 200.0,
        "flat_field": folder / "lab/flat.tif",
        "hot_pixels": folder / "lab/hot.png",
        "psf_corrected": True,
        "distance_psfs": (folder / "lab/near.tif", folder / "lab/far.tif"),
        "distances_mm": (100.0, 400.0),
        "field_psfs": (folder / "lab/left.tif",),
        "field_positions": ((0.0, -40.0),),
        "electrons_per_count": 3.7,
        "read_noise_electrons": 3.0,
        "dark_exposure": 64.0,
        "full_well_electrons": 15000.0,
        "black_level": 0.01,
        "psf_gain": ((1.0, 0.1, -0.1),),
        "envelope_shift": (0.02, 0.0),
        "sensor_field": ((1.0, 0.1, -0.1),),
        "stray_light": ((0.0, 0.01, 0.0),),
    }


def test_what_is_written_is_read(folder):
    write_camera(folder / "camera.toml", everything(folder))
    read = read_camera(folder / "camera.toml")
    assert len(read.pop("psf_sha256")) == 64
    assert read == everything(folder)


def test_every_option_has_a_key_and_a_line_of_explanation(folder):
    write_camera(folder / "camera.toml", {"psf": folder / "lab/psf.png"})
    assert KEYS.keys() == everything(folder).keys() | {"psf_sha256"}
    assert KEYS.keys() > vars(FrameFormat()).keys() | vars(PsfFormat()).keys()
    lines = (folder / "camera.toml").read_text().splitlines()
    for key, (meaning, _) in KEYS.items():
        at = lines.index(f"# {meaning}")
        assert lines[at + 1].removeprefix("# ").startswith(f"{key} = ")
    assert read_toml(folder / "camera.toml").keys() == {"psf", "psf_sha256"}


def test_examples_in_the_file_can_be_used(folder):
    """With each # of an example removed, the file still has a value of the right type for each key."""
    write_camera(folder / "camera.toml", {"psf": folder / "lab/psf.png"})
    lines = (folder / "camera.toml").read_text().splitlines()
    (folder / "camera.toml").write_text("\n".join(line.removeprefix("# ") if " = " in line else line for line in lines))
    assert read_camera(folder / "camera.toml").keys() == KEYS.keys()


def test_calibration_of_a_camera_file(folder):
    """Paths are relative to the file, which may move with its pictures; keywords replace its values."""
    frames = {"crop": (24, 32), "bin": 2}
    write_camera(
        folder / "lab/camera.toml",
        {"psf": folder / "lab/psf.png", "dark": folder / "lab/dark.png", **frames, "distance_mm": 200.0},
    )
    shutil.move(folder / "lab", folder / "field")
    path, files = folder / "field/camera.toml", {"dark": folder / "field/dark.png"}
    calibration = Calibration.load(path)
    expected = Calibration.from_file(folder / "field/psf.png", **files, **frames)
    assert (calibration.psf_hash, calibration.frames) == (expected.psf_hash, FrameFormat(**frames))
    assert torch.equal(calibration.dark, expected.dark)
    assert calibration.distance_mm == 200
    other = Calibration.from_file(path, bin=4, ambient=folder / "field/ambient.png")
    assert (other.size, other.frames.bin, other.ambient is None) == ((6, 8), 4, False)
    with pytest.raises(ParameterError, match="`bin=4`"):
        Calibration.from_file(path, FrameFormat(bin=4))


def test_formats_and_corrections_besides_those_of_the_file_are_refused(folder):
    path = folder / "camera.toml"
    write_camera(path, {"psf": folder / "lab/psf.png"})
    given = {"frames": FrameFormat(bin=2), "psf_format": PsfFormat(psf_bin=2)}
    given |= {"corrections": Corrections(defects=torch.zeros(1, 1, *SIZE) > 0)}
    for name, value in given.items():
        with pytest.raises(ParameterError, match="its own"):
            Calibration.from_file(path, **{name: value})


def test_pitch_follows_the_bin(folder):
    """It is that of the pixels after binning."""
    path = folder / "camera.toml"
    write_camera(path, {"psf": folder / "lab/psf.png", "bin": 2, "pitch_um": 4.0})
    pitches = [Calibration.load(path, **options).pitch_um for options in ({}, {"bin": 4}, {"bin": 4, "pitch_um": 5.0})]
    with pytest.warns(DeprecationWarning, match="`bin`"):
        assert Calibration.load(path, binning=4).pitch_um == 8.0
    assert pitches == [4.0, 8.0, 5.0]


def test_a_bin_of_0_is_named_also_with_a_pitch(folder):
    (folder / "camera.toml").write_text('psf = "lab/psf.png"\nbin = 0\npitch_um = 2.4\n')
    with pytest.raises(ParameterError, match=r"`bin` \(0\)"):
        Calibration.load(folder / "camera.toml")


def test_a_picture_is_no_camera_file(folder):
    with pytest.raises(ParameterError, match=r"psf\.png` is a picture.*`--psf`"):
        Calibration.load(folder / "lab/psf.png")


def test_named_files_are_all_that_belong_to_the_camera(folder):
    lab = {name: folder / "lab" / f"{name}.png" for name in ("psf", "dark", "ambient")}
    write_camera(folder / "camera.toml", {**lab, "distance_psfs": (lab["psf"],), "distances_mm": (100.0,)})
    assert named_files(folder / "camera.toml") == {**lab, "distance_psfs 1": lab["psf"]}


def test_changed_psf_is_refused_unless_it_is_given(folder):
    write_camera(folder / "camera.toml", {"psf": folder / "lab/psf.png"})
    cv2.imwrite(str(folder / "lab/psf.png"), cv2.imread(str(folder / "lab/psf.png"), -1) // 2)
    with pytest.raises(PsfError, match=r"psf.png` has changed .*`mwdn calibrate --camera .*camera.toml"):
        Calibration.load(folder / "camera.toml")
    shutil.copy(folder / "lab/psf.png", folder / "new.png")
    assert Calibration.load(folder / "camera.toml", psf=folder / "new.png").size == SIZE


@pytest.mark.parametrize(
    ("line", "error", "message"),
    [
        ("gama = 2.2", UnknownNameError, "'gama'.* 'gamma'"),
        ("psf-bin = 2", UnknownNameError, "'psf-bin'.* 'psf_bin'"),
        ("gamma = [2.2]", ParameterError, r"`gamma` \(\[2.2\]\)"),
        ('bit_depth = "12"', ParameterError, r"`bit_depth` \('12'\).*`bit_depth = 12`"),
        ("bin = true", ParameterError, r"`bin` \(True\).*`bin = 4`"),
        ("crop = [10]", ParameterError, r"`crop` \(\[10\]\)"),
        ('psf_orientation = "rotate-45"', ParameterError, r"`psf_orientation` \('rotate-45'\)"),
        ('white_balance = "gray"', ParameterError, r"`white_balance` \('gray'\)"),
        ("bin = ", ParameterError, "cannot be read as a camera file"),
        ('dark = "a\\u0000.png"', ParameterError, "zero byte"),
    ],
)
def test_wrong_lines_are_named(tmp_path, line, error, message):
    (tmp_path / "camera.toml").write_text(f'psf = "psf.png"\n{line}\n')
    with pytest.raises(error, match=message):
        read_camera(tmp_path / "camera.toml")


@pytest.mark.parametrize("name", ["camera.toml", "other.TOML", "\\u0000"])
def test_the_psf_is_a_picture(tmp_path, name):
    """A file that named itself ended in a `RecursionError`, a zero byte in a `ValueError`."""
    (tmp_path / "camera.toml").write_text(f'psf = "{name}"\n')
    with pytest.raises(ParameterError, match=r"must be a picture|zero byte"):
        Calibration.load(tmp_path / "camera.toml")


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize(
    "line",
    [
        *(f"{key} = {value}" for key in ("pitch_um", "distance_mm") for value in ("nan", "inf", "-1", "0", "1e300")),
        *(f"white_balance = [{gain}, 1, 1]" for gain in ("nan", "0", "1e-300", "1e300", "9" * 400)),
        *(f"{key} = {'9' * 400}" for key in ("pitch_um", "gamma", "background", "bin", "bit_depth")),
        *(f"{key} = '{'x' * 10_000}'" for key in ("mosaic", "gamma", "dark", "crop")),
        *(
            f"{key} = {value}"
            for key in ("electrons_per_count", "full_well_electrons")
            for value in ("nan", "0", "1e300")
        ),
        *("read_noise_electrons = -1", "black_level = 1", "distances_mm = [nan]", "field_positions = [[inf, 0.0]]"),
        *(f"{key} = [[]]" for key in ("psf_gain", "sensor_field", "stray_light")),
    ],
)
def test_values_out_of_any_range_are_named_on_one_short_line(folder, monkeypatch, line):
    """A gain of 1e300 gave pictures of infinity; a pitch of NaN was taken; 100 kB of a value filled the terminal."""
    monkeypatch.chdir(folder)
    Path("camera.toml").write_text(f'psf = "lab/psf.png"\n{line}\n')
    with pytest.raises(MwdnError) as caught:
        Calibration.load("camera.toml")
    assert len(str(caught.value)) <= 300


@pytest.mark.parametrize("pitch", [float("nan"), -1.0, float("inf")])
def test_a_file_that_could_not_be_read_is_not_written(folder, pitch):
    """`--pitch-um nan` replaced a camera file by one that no command could read, nor replace."""
    camera = {"psf": folder / "lab/psf.png", "pitch_um": 2.0}
    write_camera(folder / "camera.toml", camera)
    with pytest.raises(ParameterError, match="`pitch_um`"):
        write_camera(folder / "camera.toml", {**camera, "pitch_um": pitch})
    assert read_camera(folder / "camera.toml")["pitch_um"] == 2.0


def test_a_name_that_no_file_can_have(folder):
    (folder / "camera.toml").write_text(f'psf = "{5000 * "x"}"\npsf_sha256 = "0"\n')
    with pytest.raises(ImageError, match="File name too long"):
        Calibration.load(folder / "camera.toml")


def test_the_hash_of_a_huge_file_is_not_computed(folder):
    """A camera file may name any file as its PSF; a sparse one of 1 TB needs no disk, and an hour to hash."""
    (folder / "camera.toml").write_text(f'psf = "huge.png"\npsf_sha256 = "{64 * "0"}"\n')
    (folder / "huge.png").touch()
    os.truncate(folder / "huge.png", 2**40)
    with pytest.raises(ImageError, match=r"huge\.png` "):
        Calibration.load(folder / "camera.toml")


@pytest.mark.skipif(sys.platform != "linux", reason="other systems allow fewer characters in file names")
def test_names_of_any_characters_are_written_so_that_they_can_be_read(folder):
    for name in ("a\nbin = 3.toml", "a\x7f.toml"):
        shutil.copy(folder / "lab/psf.png", psf := folder / f"{name}.png")
        write_camera(folder / name, {"psf": psf})
        assert read_camera(folder / name).keys() == {"psf", "psf_sha256"}
        assert read_camera(folder / name)["psf"] == psf
    shutil.copy(folder / "lab/psf.png", psf := folder / "\udcff.png")
    with pytest.raises(ParameterError, match="Rename it"):
        write_camera(folder / "camera.toml", {"psf": psf})
    assert not (folder / "camera.toml").exists()


@pytest.mark.skipif(sys.platform == "win32", reason="links need a privilege on Windows")
def test_a_camera_file_in_a_folder_that_is_a_link_names_its_files(folder, monkeypatch):
    """The system follows `..` from the folder that the link leads to: `link/../lab/psf.png` was another file."""
    monkeypatch.chdir(folder)
    Path("disk/deep").mkdir(parents=True)
    Path("link").symlink_to("disk/deep")
    write_camera("link/camera.toml", {"psf": Path("lab/psf.png"), "dark": Path("lab/dark.png")})
    assert Calibration.load("link/camera.toml").size == SIZE
    assert Calibration.load("disk/deep/camera.toml").size == SIZE
    shutil.copytree("lab", "link/lab")
    Path("inner").symlink_to("disk/deep/lab")  # a link beside the camera file stays: both can be moved together
    write_camera("beside.toml", {"psf": Path("inner/psf.png")})
    assert read_toml("beside.toml", "camera file")["psf"] == "inner/psf.png"


@pytest.mark.skipif(sys.platform == "win32", reason="links need a privilege on Windows")
def test_a_link_to_a_camera_file_is_the_camera_file(folder):
    write_camera(folder / "lab/camera.toml", {"psf": folder / "lab/psf.png"})
    (folder / "link.toml").symlink_to("lab/camera.toml")
    assert read_camera(folder / "link.toml")["psf"].samefile(folder / "lab/psf.png")
    shutil.copy(folder / "lab/dark.png", folder / "psf.png")  # one beside the link comes first
    assert read_camera(folder / "link.toml")["psf"] == folder / "psf.png"


def test_a_camera_has_a_psf(tmp_path):
    (tmp_path / "camera.toml").write_text("bin = 2\n")
    with pytest.raises(ParameterError, match=r'`psf = "psf\.png"`'):
        read_camera(tmp_path / "camera.toml")


def test_only_camera_files_are_replaced(folder):
    for name in ("recipe.toml", "camera.txt", "lab"):
        if name != "lab":
            (folder / name).write_text("[network]\n")
        with pytest.raises(ParameterError, match=r"is not a camera file|must end in \.toml"):
            write_camera(folder / name, {"psf": folder / "lab/psf.png"})
    assert (folder / "recipe.toml").read_text() == "[network]\n"
    for orientation in get_args(Orientation)[:2]:
        write_camera(folder / "camera.toml", {"psf": folder / "lab/psf.png", "psf_orientation": orientation})
    assert read_camera(folder / "camera.toml")["psf_orientation"] == "flip-top-bottom"


@pytest.mark.parametrize("fails", [False, True])
def test_a_draft_takes_the_place_of_a_camera_file_with_its_pictures_at_the_end(tmp_path, fails):
    path, (old, new) = tmp_path / "camera.toml", np.arange(2 * 16, dtype=np.uint16).reshape(2, 4, 4, 1)
    write_camera_with_parts(path, {}, {"psf": old})
    before = {file.name for file in tmp_path.iterdir()}
    with suppress(OSError), draft_of(path) as draft:
        write_camera_with_parts(draft, {"bit_depth": 12}, {"psf": new, "dark": old})
        assert (read_frame(read_camera(path)["psf"]) == old).all()
        if fails:
            raise OSError
    if fails:
        assert {file.name for file in tmp_path.iterdir()} == before
        return
    camera = read_camera(path)
    assert (read_frame(camera["psf"]) == new).all()
    assert (read_frame(camera["dark"]) == old).all()
    assert {file.name for file in tmp_path.iterdir()} == {path.name, camera["psf"].name, camera["dark"].name}
    assert camera["bit_depth"] == 12


@pytest.mark.parametrize("other", ["other.toml", "folder/camera.toml", "new-psf-of-camera.toml"])
def test_a_camera_file_does_not_name_the_pictures_of_another_one(tmp_path, other):
    """The other one removes them when it is calibrated again: the new file could not be read any more."""
    path, new = tmp_path / "camera.toml", tmp_path / other
    new.parent.mkdir(exist_ok=True)
    pictures = np.arange(4 * 16, dtype=np.uint16).reshape(4, 4, 4, 1)
    write_camera_with_parts(path, {}, {"psf": pictures[0], "dark": pictures[1], "field_psfs": list(pictures[2:])})
    write_frame(tmp_path / "ambient.png", pictures[0])
    camera = {key: value for key, value in read_camera(path).items() if key != "psf_sha256"}
    write_camera_with_parts(new, {**camera, "ambient": tmp_path / "ambient.png"}, {})
    with draft_of(tmp_path / "drafted.toml") as draft:
        write_camera_with_parts(draft, camera, {})
    write_camera_with_parts(path, {}, {"psf": pictures[3]})
    assert len(list(tmp_path.glob("camera-*"))) == 1
    for file in (new, tmp_path / "drafted.toml"):
        kept = read_camera(file)
        assert (read_frame(kept["psf"]) == pictures[0]).all()
        assert (read_frame(kept["dark"]) == pictures[1]).all()
        assert [read_frame(each)[0, 0, 0] for each in kept["field_psfs"]] == [32, 48]
    assert read_camera(new)["ambient"].samefile(tmp_path / "ambient.png")

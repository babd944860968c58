"""`mwdn calibrate FRAMES`: from photographs on the bench to a camera file that other commands take."""

import json
import math
import shutil
from contextlib import chdir
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from mwdn import Calibration, Camera
from mwdn.calibration import FrameFormat
from mwdn.calibration.camera_file import read_camera
from mwdn.calibration.camera_parts import write_camera_with_parts
from mwdn.calibration.watching import guide_exposure, watch_folder
from mwdn.cli.app import main
from mwdn.errors import ImageError, PsfError
from mwdn.io.images import read_frame
from mwdn.optics.displacement import displacement, shifted
from photographed_camera import STEPS, Bench, save

FORMAT = FrameFormat(bit_depth=12)


@pytest.fixture(scope="module")
def photographs(tmp_path_factory):
    """A bench, and the folder with its photographs."""
    bench, folder = Bench(), tmp_path_factory.mktemp("bench")
    for exposure in (1, 8, 64):
        save(folder / f"psf_{exposure}", [bench.point(exposure, (3, -5)) for _ in range(4)])
    save(folder / "dark", [bench.dark() for _ in range(6)])
    save(folder / "flat", [bench.flat(level) for level in (0.3, 0.3, 0.7, 0.7)])
    capture = Camera(bench.light).forward(square())
    save(folder / "captures", [bench.frame(0.8 * capture / capture.max())])
    return bench, folder


def square():
    scene = torch.zeros(1, 1, 128, 160)
    scene[..., 40:80, 60:110] = 1
    return scene


def link(photographs, folder):
    for path in photographs[1].iterdir():
        (folder / path.name).symlink_to(path)
    return folder


@pytest.fixture
def folder(photographs, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    return link(photographs, tmp_path)


EVERYTHING = "calibrate psf_1 psf_8 psf_64 --exposures 1 8 64 --dark dark --flat flat --bit-depth 12"


@pytest.fixture(scope="module")
def calibrated(photographs, tmp_path_factory):
    """Files of a camera that `EVERYTHING` has made."""
    folder = link(photographs, tmp_path_factory.mktemp("calibrated"))
    with chdir(folder), pytest.raises(SystemExit) as ended:
        main(EVERYTHING.split())
    assert ended.value.code == 0
    return list(folder.glob("camera*"))


@pytest.fixture
def camera(calibrated, folder):
    """The current folder has `camera.toml`."""
    for path in calibrated:
        shutil.copy(path, folder)


def test_frames_become_a_camera_that_other_commands_take(run, folder, photographs):
    bench, _ = photographs
    code, out, err = run(EVERYTHING)
    assert (code, err) == (0, "")
    assert "12 frames averaged at 3 exposures" in out
    calibration = Calibration.load("camera.toml")
    found = displacement(calibration.psf, bench.light)
    assert found.correlation > 0.99
    truth = bench.light / bench.light.sum()
    centroid = [float((truth[0, 0].sum(1 - axis) * torch.arange(n)).sum()) for axis, n in ((0, 128), (1, 160))]
    assert found[:2] == pytest.approx((64 - centroid[0], 80 - centroid[1]), abs=1)
    assert calibration.corrections.count == 20
    assert calibration.sensor.full_well == pytest.approx(15_000, rel=0.03)
    assert calibration.sensor.read_noise == pytest.approx(3, rel=0.05)
    assert calibration.background == (0.0,)
    code, out, err = run("inspect camera.toml --json -o report")
    report = json.loads(out)
    assert (code, err) == (0, "")
    assert report["file"].startswith("camera-psf-")
    texts = " ".join(finding["text"] for finding in report["verdict"])
    assert "20 hot or dead pixels" in texts
    assert "electrons" in texts
    decades = float(texts.split("Averaged and corrected: ")[1].split(" ")[0])
    assert 4 < decades < 6  # 1 : 64 of three exposures, and 3.5 for the peak over the read noise
    line = "reconstruct captures --psf camera.toml --method wiener --format npy --no-trust --device cpu --bin 1 -o out"
    code, _, err = run(line)
    assert (code, err) == (0, "")
    picture = np.load("out/frame_1.npy")[..., 0]
    truth = np.roll(square()[0, 0].numpy(), [-round(step) for step in found[:2]], (0, 1))
    assert np.corrcoef(picture.ravel(), truth.ravel())[0, 1] > 0.8


@pytest.mark.usefixtures("camera")
def test_dark_flat_and_hot_pixels_are_corrected_in_captures(photographs):
    bench, _ = photographs
    calibration = Calibration.load("camera.toml")
    uneven = calibration.correct(bench.flat(0.5))
    # Light that falls off towards the corners by 30 % becomes even; hot pixels are gone.
    assert float(uneven.std() / uneven.mean()) < 0.02
    assert float(uneven.max() / uneven.mean()) < 1.1
    assert float(calibration.correct(bench.dark()).mean()) == pytest.approx(0, abs=2e-5)


@pytest.mark.usefixtures("camera")
def test_the_bits_of_a_camera_file_stay_if_it_is_changed(run, folder):
    before = read_camera("camera.toml")
    assert run("calibrate --camera camera.toml --pitch-um 4.8 --white-balance 1 1 1")[0] == 0
    after = read_camera("camera.toml")
    assert after == {**before, "pitch_um": 4.8, "white_balance": (1.0, 1.0, 1.0)}
    code, _, err = run("calibrate --camera camera.toml --bit-depth 14")  # levels are fractions of the full scale
    assert (code, "`--bit-depth` (14) must be 12" in err) == (2, True)
    code, _, err = run("calibrate --camera camera.toml --bit-depth none")
    assert (code, "`--bit-depth` (none) must be 12" in err) == (2, True)
    first = {path.name for path in folder.glob("camera-*")}
    # New frames of the point source keep what is known of the sensor; the replaced PSF's file is removed.
    assert run("calibrate psf_1 --camera camera.toml")[0] == 0
    again = read_camera("camera.toml")
    assert again["flat_field"] == before["flat_field"]
    assert again["hot_pixels"] == before["hot_pixels"]
    assert again["psf"] != before["psf"]
    assert (again["bit_depth"], again["pitch_um"], again["read_noise_electrons"]) == (
        12,
        4.8,
        before["read_noise_electrons"],
    )
    second = {path.name for path in folder.glob("camera-*")}
    assert first - second == {before["psf"].name}
    assert run("calibrate psf_1 --camera camera.toml --psf-bin 2")[0] == 2
    # The PSF's file is corrected already: it is no frame of the point source, which would be corrected twice.
    code, _, err = run("calibrate --camera camera.toml --dark dark")
    assert (code, "corrected already" in err) == (2, True)
    assert {path.name for path in folder.glob("camera-*")} == second


def test_a_copy_of_a_camera_file_keeps_its_pictures(folder):
    psf = np.ones((4, 5, 1), np.float32)
    for name in ("camera.toml", "camera.TOML"):
        first = write_camera_with_parts(Path(name), {}, {"psf": psf})["psf"]
        Path("backup.toml").write_bytes(Path(name).read_bytes())
        second = write_camera_with_parts(Path(name), {}, {"psf": 2 * psf})["psf"]
        assert (first.exists(), second.exists()) == (True, True)
        Path("backup.toml").write_text("pitch_um = \n")  # being edited: it may name any of them
        third = write_camera_with_parts(Path(name), {}, {"psf": 3 * psf})["psf"]
        assert (first.exists(), second.exists(), third.exists()) == (True, True, True)
        Path("backup.toml").unlink()
        write_camera_with_parts(Path(name), {"pitch_um": 2.0}, {"psf": 3 * psf})
        assert third.exists()
        write_camera_with_parts(Path(name), {}, {"psf": 4 * psf})
        assert not third.exists()


def test_a_background_that_is_given_is_kept(run, folder):
    for options, background in (
        ("", None),
        ("--background 0", 0.0),
        ("--dark dark", 0.0),
        ("--dark dark --background estimate", "estimate"),
        ("--camera camera.toml", "estimate"),
        ("--dark dark", 0.0),
        ("--camera camera.toml --dark none", None),  # 0 was for the dark frame
        ("--camera camera.toml --background 0", 0.0),
        ("--camera camera.toml", 0.0),
        ("--dark dark --background 0.02", 0.02),
        ("--camera camera.toml --dark none", 0.02),
    ):
        assert run(f"calibrate psf_1 --bit-depth 12 {options}")[0] == 0
        assert read_camera("camera.toml").get("background") == background


def test_new_distances_replace_those_of_the_camera_file(run, folder):
    assert run("calibrate psf_1 --bit-depth 12 --distance-mm 50")[0] == 0
    assert run("calibrate psf_1 --camera camera.toml --distances 100")[0] == 0
    assert read_camera("camera.toml")["distance_mm"] == 100


def test_a_camera_file_appears_with_all_its_pictures_or_not_at_all(folder, monkeypatch):
    parts = {"psf": np.ones((4, 5, 1), np.float32), "dark": np.zeros((4, 5, 1), np.float32)}
    write_camera_with_parts(Path("camera.toml"), {}, parts)
    old = {path.name: path.read_bytes() for path in folder.glob("camera*")}
    assert len(old) == 3
    with pytest.raises(ImageError):
        write_camera_with_parts(
            Path("camera.toml"), {}, {"psf": 2 * parts["psf"], "dark": np.zeros((4, 5, 2), np.uint8)}
        )
    monkeypatch.setattr("mwdn.calibration.camera_parts.write_camera", lambda *_: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        write_camera_with_parts(Path("camera.toml"), {}, {"psf": 3 * parts["psf"]})
    assert {path.name: path.read_bytes() for path in folder.glob("camera*")} == old


@pytest.mark.usefixtures("camera")
def test_a_calibration_that_fails_leaves_the_camera_as_it_was(run, folder):
    """The new file was written before it was checked, and no command could read it."""
    old = {path.name: path.read_bytes() for path in folder.glob("camera*")}
    code, out, err = run(f"{EVERYTHING} --white-balance psf")
    assert (code, out, "needs a PSF in colour" in err) == (2, "", True)
    assert {path.name: path.read_bytes() for path in folder.glob("camera*")} == old
    assert not list(folder.glob(".*"))


def test_saturated_frames_are_refused_with_the_exposure_to_use(run, folder, photographs):
    bench, _ = photographs
    save("bright", [bench.point(3) for _ in range(3)])
    code, _, err = run("calibrate bright --dark dark --exposures 12 --bit-depth 12")
    assert code == 2
    assert "PSF is saturated" in err
    assert " ms instead of 12 ms" in err
    used = float(err.split("Use ")[1].split(" ms")[0])
    assert 0.12 < used / 12 < 0.6  # 0.27 is right
    assert not Path("camera.toml").exists()
    bits = "--bit-depth 12"
    code, _, err = run(f"calibrate bright/frame_1.png {bits}")
    assert (code, "use 0." in err, "times this exposure" in err) == (2, True, True)
    save("dim", [bench.point(0.1) for _ in range(3)])
    code, _, err = run(f"calibrate dim --dark dark {bits}")
    assert (code, "of the full scale: use" in err) == (0, True)


def test_outlying_frames_are_named(run, folder, photographs):
    bench, _ = photographs
    save("moved", [bench.point(move=(0, 4) if number == 2 else (0, 0)) for number in range(5)])
    code, out, err = run("calibrate moved --dark dark --bit-depth 12")
    assert (code, "4 frames averaged" in out) == (0, True)
    assert "`frame_3.png` is displaced by (0.0, 4.0) px" in err.replace("-0.0", "0.0")


def test_frames_of_another_pattern_are_named(run, folder, photographs):
    """A scene of the same light: its pattern is the PSF's convolved with it."""
    bench, _ = photographs
    capture = Camera(bench.light).forward(square())
    above = [float((light - light.quantile(0.05)).mean()) for light in (bench.light, capture)]
    save("scene", [bench.frame(capture * above[0] / above[1])])
    code, _, err = run("calibrate psf_1/frame_1.png scene/frame_1.png --dark dark --bit-depth 12")
    assert (code, "disagree" in err, "another pattern" in err) == (2, True, True)
    code, _, err = run("calibrate psf_1 scene --dark dark --bit-depth 12")
    assert (code, err.count("another pattern")) == (0, 1)


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("psf_1 psf_1/frame_2.png --dark dark", "`psf_1/frame_2.png` is named twice"),
        ("psf_1 --field psf_1/frame_2.png --dark dark", "`psf_1/frame_2.png` is named twice"),
        ("psf_1 --dark psf_1", "named twice"),
        ("psf_8 --dark dark --flat psf_1 --bit-depth 12", "pixels of the flat frames are unlike their neighbours"),
        ("psf_1 --dark dark dark/frame_2.png", "`dark/frame_2.png` is named twice"),
        ("psf_1 --dark dark --flat flat --flat-dark dark dark", "is named twice"),
        ("psf_1 --psf psf_8/frame_1.png", "`--psf` (`psf_8/frame_1.png`) is instead of FILES"),
        ("psf_1 psf_8 --exposures 1 8 64", "cannot be divided into 3"),
        ("psf_1 psf_8 --exposures 8 8", "`--exposures` (8, 8) must be positive and differ"),
        ("psf_8 psf_1 --exposures 1 8 --dark dark --bit-depth 12", "saturated"),
        ("psf_1 --flat flat/frame_1.png flat/frame_3.png --dark dark --bit-depth 12", "must have the same light"),
        ("psf_1 --dark dark --white-balance flat", "needs flat frames"),
        ("psf_1 --dark-exposures 1 2 --exposures 1", r"`--dark-exposures` (1, 2) needs dark frames"),
        ("psf_1 --dark dark --capture-exposure 5", "`--capture-exposure` (5) must be one of `--dark-exposures` (none)"),
        ("psf_1/frame_1.png --capture-exposure 5", "`--capture-exposure` (5) must be one of `--dark-exposures` (none)"),
        ("psf_1 --dark dark dark --dark-exposures 1 2 --exposures 1 --flat flat", "`--flat-dark` must name"),
        ("psf_1 --dark dark --dark-exposures 1 2 --exposures 4", "must have one for each of `--exposures`"),
        ("psf_1 --dark dark/frame_1.png dark/frame_2.png --dark-exposures 1 2 --bit-depth 12", "Give `--exposures`"),
        ("psf_1/frame_1.png --flat-dark dark --bit-depth 12", "`--flat-dark` needs flat frames: `--flat`"),
        ("psf_1 --flat-through-mask --bit-depth 12", "`--flat-through-mask` needs flat frames: `--flat`"),
        ("psf_1 --flat small --bit-depth 12", "Frames of the point source, as `frame_"),
        ("empty --dark dark", "holds no frame"),
        ("psf_1 --dark dark --psf-gamma srgb", "`--psf-gamma` is for one picture"),
        ("psf_1 --dark dark --distances 100 --distance-mm 50", "`--distance-mm` (50) must be the first"),
        ("psf_1 --watch dark", "leave out `psf_1`"),
        ("--watch dark --pairs pairs.h5", "leave out `--pairs`"),
        ("old.toml --pitch-um 2", "`old.toml` is a camera file, not a picture. To change it, give it as `--camera`"),
    ],
)
def test_photographs_that_do_not_fit(run, folder, line, message):
    (folder / "empty").mkdir()
    save(folder / "small", [np.full((96, 128, 1), level, np.uint16) for level in (1500, 1502)])
    code, _, err = run(f"calibrate {line}")
    assert code == 2
    assert message in err
    assert not Path("camera.toml").exists()


def test_flat_frames_of_another_size_are_named(run, folder, photographs):
    """They ended in a traceback if they had dark frames of their own."""
    bench, _ = photographs
    save(folder / "small", [bench.flat(0.5)[:100, :120]] * 2)
    save(folder / "small_dark", [bench.dark()[:100, :120]] * 2)
    code, _, err = run("calibrate psf_1 --dark dark --flat small --flat-dark small_dark --bit-depth 12")
    assert code == 2
    assert "(100 x 120)" in err
    assert "(128 x 160)" in err


def test_each_folder_of_dark_frames_has_its_exposure(run, folder, photographs):
    """Folders of unequal size were divided evenly, and frames of one exposure were averaged with the other's."""
    bench, _ = photographs
    save(folder / "dark_64", [bench.dark() + np.uint16(400)] * 2)
    options = "--exposures 1 64 --dark dark dark_64 --dark-exposures 1 64 --bit-depth 12"
    assert run(f"calibrate psf_1 psf_64 {options}")[0] == 0
    lighter = float(Calibration.load("camera.toml").dark.mean())
    assert read_camera("camera.toml")["dark_exposure"] == 64
    # It was subtracted from new frames of the point source, whatever their exposure.
    before = Path("camera.toml").read_bytes()
    for new, given in (("psf_1", "not given"), ("psf_1 --exposures 1", "1"), ("psf_1/frame_1.png", "not given")):
        code, _, err = run(f"calibrate {new} --camera camera.toml")
        assert code == 2
        assert f"`--exposures` of the PSF ({given}) must be that of the dark frame of `camera.toml` (64)" in err
        assert Path("camera.toml").read_bytes() == before
    assert run("calibrate --camera camera.toml --pitch-um 3")[0] == 0
    assert run("calibrate psf_1 --exposures 64 --camera camera.toml")[0] == 0  # said to be of that exposure
    assert read_camera("camera.toml")["dark_exposure"] == 64
    assert run("calibrate psf_1 --dark dark --camera camera.toml")[0] == 0
    assert "dark_exposure" not in read_camera("camera.toml")
    assert run(f"calibrate psf_1 psf_64 {options} --capture-exposure 1")[0] == 0
    assert read_camera("camera.toml")["dark_exposure"] == 1
    assert lighter - float(Calibration.load("camera.toml").dark.mean()) == pytest.approx(400 / STEPS, rel=0.01)


def test_watching_guides_the_exposure(folder, photographs):
    """The program writes frames while one turns the knobs; a half-written file is read when it is whole."""
    bench, _ = photographs
    watched = folder / "live"
    save(watched, [bench.point(0.1)], "old")

    def frames():
        for number, exposure in enumerate((0.25, 1.0, 4.0)):
            yield lambda n=number, e=exposure: save(watched, [bench.point(e)], f"shot{n}")
        yield lambda: (watched / "z.png").write_bytes((watched / "shot1_1.png").read_bytes()[:3000])
        yield lambda: (watched / "z.png").write_bytes((watched / "shot1_1.png").read_bytes())

    script = frames()

    def wait():
        step = next(script, None)
        if step is None:
            return False
        step()
        return True

    seen = list(guide_exposure(watch_folder(watched, FORMAT, wait), FORMAT, exposure_ms=10.0))
    assert [sentence.split(":")[0] for sentence, _ in seen] == [
        "old_1.png",
        "shot0_1.png",
        "shot1_1.png",
        "shot2_1.png",
        "z.png",
    ]
    assert "well exposed" in seen[2][0]
    assert seen[3][1].saturated > 20
    assert seen[3][1].factor < 0.5 < 2 < seen[1][1].factor
    assert "ms instead of 10 ms" in seen[1][0]
    with pytest.raises(ImageError, match="must be a folder"):
        next(watch_folder(folder / "nothing", FORMAT, wait))


def test_a_colour_camera_with_a_mosaic(run, folder):
    """Dark, flat and hot pixels are those of single pixels; the PSF is moved by whole cells."""
    bench = Bench(hot=5)
    tint = torch.tensor([[0.5, 1.0], [1.0, 0.7]]).repeat(64, 80)
    bench.light = bench.light * tint
    save("point", [bench.point() for _ in range(3)])
    save("flats", [bench.frame(0.6 * tint.expand_as(bench.light)) for _ in range(2)])
    line = "calibrate point --dark dark --flat flats --flat-dark dark --mosaic rggb --bit-depth 12"
    assert run(f"{line} --white-balance flat")[0] == 0
    camera = read_camera("camera.toml")
    assert camera["white_balance"] == pytest.approx((2.0, 1.0, 1 / 0.7), rel=0.02)
    calibration = Calibration.load("camera.toml")
    assert calibration.psf.shape == (1, 3, 64, 80)
    flat = calibration.correct(bench.frame(0.6 * tint.expand_as(bench.light)))
    assert float(flat.std((-2, -1)).max() / flat.mean()) < 0.03
    # The flat field keeps the colours: it is 1 on average for each kind of pixel.
    red, green, blue = flat.mean((0, 2, 3)).tolist()
    assert (red / green, blue / green) == pytest.approx((0.5, 0.7), rel=0.02)


def test_several_distances(run, folder):
    """Shadows of a point at z are magnified by 1 + d / z; a scene in between gets a PSF in between."""
    size, gap = (128, 160), 8.0
    bench = Bench(size, hot=0)
    flat = bench.light.clone()

    def light(distance):
        from mwdn.optics.warp import warp

        return warp(flat, (1 + gap / distance) / (1 + gap / 100) * torch.eye(2))

    for distance in (100, 400):
        bench.light = light(distance)
        save(f"at_{distance}", [bench.point() for _ in range(3)])
    save("darks", [bench.dark() for _ in range(3)])
    line = "calibrate at_100 at_400 --distances 100 400 --dark darks --bit-depth 12"
    assert run(line)[0] == 0
    camera = read_camera("camera.toml")
    assert (camera["distance_mm"], camera["distances_mm"]) == (100.0, (400.0,))
    from mwdn.calibration.places import at_distance

    calibration = Calibration.load("camera.toml")
    between, sentence = at_distance(calibration, 160.0)
    expected = light(160)
    alike = displacement(between.psf, expected).correlation
    others = [at_distance(calibration, z)[0] for z in (100.0, 400.0)]
    assert alike > 0.97
    assert alike > 0.05 + max(displacement(other.psf, expected).correlation for other in others)
    assert "that of 160" not in sentence
    assert "magnified by" in sentence
    assert at_distance(calibration, 400.0)[0].psf_hash != calibration.psf_hash
    assert "the nearest one" in at_distance(calibration, 50.0)[1]
    wrong = run(line.replace("100 400", "400 100").replace("camera.toml", "wrong.toml") + " -o wrong.toml")
    assert (wrong[0], "Give `--distances` in the order of the frames" in wrong[2]) == (0, True)
    save("scene", [bench.point()])
    code, _, err = run("reconstruct scene --psf camera.toml --distance 160 --method wiener --no-trust --device cpu")
    assert (code, err.count("magnified by")) == (0, 1)
    for camera in ("", "--camera camera.toml"):  # the camera file's other PSFs do not belong to another one
        code, _, err = run(f"reconstruct scene {camera} --psf at_100/frame_1.png --distance 160 --method wiener")
        assert (code, "`--distance`" in err, "several distances" in err) == (2, True, True)


def test_several_positions_make_a_field_of_psfs(run, folder):
    from mwdn.calibration.places import field_camera
    from mwdn.optics.field import gaussian_blur

    bench = Bench(hot=0)
    axis = bench.light.clone()
    save("axis", [bench.point() for _ in range(3)])
    bench.light = 0.8 * gaussian_blur(axis, 1.5)  # blurred and darker off the axis
    save("right", [bench.point(move=(0, 20)) for _ in range(3)])
    save("darks", [bench.dark() for _ in range(3)])
    assert run("calibrate axis --field right --dark darks --bit-depth 12")[0] == 0
    camera = read_camera("camera.toml")
    assert camera["field_positions"][0] == pytest.approx((0, 20), abs=0.6)
    field = field_camera(Calibration.load("camera.toml"))
    assert field.rank == 2
    centre, right = field.psf_at(64, 80), field.psf_at(64, 159)
    assert displacement(centre, axis).correlation > 0.99
    assert float(right.sum() / centre.sum()) == pytest.approx(0.8, abs=0.05)
    assert math.isclose(float(field.weights.sum(0).mean()), 1, rel_tol=1e-3)
    assert float(field.weights[1, 0, 64, 100]) > 0.99  # its own place, in whichever crop
    assert STEPS == 4095
    # The point to the right of a PSF that is mirrored lies to the left.
    mirrored = field_camera(Calibration.load("camera.toml", psf_orientation="flip-left-right"))
    sums = [float(mirrored.psf_at(64, column).sum()) for column in (0, 80)]
    assert sums[0] / sums[1] == pytest.approx(0.8, abs=0.05)


def test_points_of_the_field_keep_their_light_behind_a_weak_sensor(run, folder):
    """Each corrected PSF that exceeded 1 was divided by its own peak: 0.97 of the light instead of 0.8."""
    bench = Bench(hot=0)
    y, x = (torch.linspace(-1, 1, n) for n in bench.light.shape[-2:])
    middle = torch.exp(-3 * (y[:, None].square() + x.square()))
    response = 1 - 0.7 * middle
    light = bench.light * middle
    light = 0.9 * light / (response * light).max()
    assert light.max() * response.mean() > 1.1  # a flat field has the mean 1
    save("axis", [bench.frame(response * light) for _ in range(8)])
    save("right", [bench.frame(0.8 * response * shifted(light, 0, 20)) for _ in range(8)])
    save("darks", [bench.dark() for _ in range(8)])
    save("flats", [bench.frame((0.6 * response).expand_as(bench.light)) for _ in range(4)])
    assert run("calibrate axis --field right --dark darks --flat flats --bit-depth 12")[0] == 0
    camera = read_camera("camera.toml")
    axis, right = (float(read_frame(file).sum()) for file in (camera["psf"], camera["field_psfs"][0]))
    assert right / axis == pytest.approx(0.8 * float(shifted(light, 0, 20).sum() / light.sum()), abs=0.02)


def test_watching_goes_on_after_a_file_that_does_not_fit(folder, photographs):
    watched, bench = folder / "live", photographs[0]
    watched.mkdir()
    cv2.imwrite(str(watched / "thumbnail.jpg"), np.zeros((8, 8, 3), np.uint8))
    times = iter(range(10))

    def wait():
        time = next(times, None)
        if time == 0:
            (watched / "half.png").write_bytes(b"\x89PNG\r\n\x1a\n")
        if time == 7:
            save(watched, [bench.point()], "good")
        return time is not None

    seen = dict(sentence.split(": ", 1) for sentence, _ in guide_exposure(watch_folder(watched, FORMAT, wait), FORMAT))
    assert [*seen] == ["thumbnail.jpg", "half.png", "good_1.png"]
    assert "left out. `bit_depth` (12)" in seen["thumbnail.jpg"]
    assert "left out. `" in seen["half.png"]
    assert "well exposed" in seen["good_1.png"]


def test_saturation_of_an_averaged_frame_is_an_error_of_the_psf(photographs):
    _, folder = photographs
    from mwdn.calibration.photographs import CalibrationFrames, calibrate_frames

    with pytest.raises(PsfError, match="maximum, 4,095"):
        calibrate_frames(CalibrationFrames((tuple(sorted((folder / "psf_64").iterdir())),)), FORMAT)


def test_white_flats_need_colour(run, folder):
    code, _, err = run(f"{EVERYTHING} --white-balance flat")
    assert (code, "needs flat frames in colour" in err) == (2, True)
    assert cv2.imread("dark/frame_1.png", -1).ndim == 2


@pytest.mark.acceptance
def test_another_shot_of_the_papers_camera_agrees_with_its_psf(run, data, tmp_path, monkeypatch):
    """A full frame of 1920 x 1920 pixels, binned and centred; docs/calibrate.md says what each step explains."""
    monkeypatch.chdir(tmp_path)
    assert run("calibrate", data / "mwdn-camera/psf_raw_1920.png", "--centre", "--bin", 4)[0] == 0
    published = Calibration.from_file(data / "mwdn-camera/psf_480.tif").psf
    found = displacement(Calibration.load("camera.toml").psf, published)
    assert max(map(abs, found[:2])) < 6
    assert found.correlation > 0.94
    theirs = (published / published.max()).mean((0, 1)).numpy()
    ours = _resampled(cv2.imread(str(data / "mwdn-camera/psf_raw_1920.png")).mean(-1).astype(np.float32) / 255, theirs)
    lines = (slice(100, 380), slice(110, 370))
    assert np.corrcoef(ours[lines].ravel(), theirs[lines].ravel())[0, 1] > 0.98
    agreement = {power: _with_halo(ours**power, theirs) for power in (0.8, 1.0, 1.2)}
    assert agreement[1.0] > 0.98
    assert max(agreement, key=lambda power: agreement[power]) == 1.0  # one tone curve
    assert max(_with_halo(np.roll(ours, 1, axis), theirs) for axis in (0, 1)) < 0.9  # what one pixel costs


def _resampled(frame, other):
    """The unbinned frame, displaced and turned onto another PSF by the best affine map (ECC), then binned by 4."""
    binned = cv2.resize(frame, other.shape, interpolation=cv2.INTER_AREA)
    start, _ = cv2.phaseCorrelate(other.astype(float), binned.astype(float))
    turn = np.column_stack([np.eye(2), start]).astype(np.float32)
    _, turn = cv2.findTransformECC(other, binned, turn, cv2.MOTION_AFFINE, (3, 500, 1e-8), None, 3)
    linear, shift = turn[:, :2], turn[:, 2]
    assert np.abs(linear - np.eye(2)).max() < 0.002  # 0.1 degrees, 0.2 %
    middle = np.array([1.5, 1.5])  # of four pixels
    fine = np.column_stack([linear, 4 * shift + middle - linear @ middle])
    turned = cv2.warpAffine(frame, fine, frame.shape, flags=cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP)
    return cv2.resize(turned, other.shape, interpolation=cv2.INTER_AREA).clip(0)


def _with_halo(psf, other):
    """Correlation of a PSF with another one, after the best gain, level and halo (the PSF blurred by 32 pixels)."""
    terms = np.stack([psf, cv2.GaussianBlur(psf, (0, 0), 32), np.ones_like(psf)], -1).reshape(-1, 3)
    fitted = terms @ np.linalg.lstsq(terms, other.ravel(), rcond=None)[0]
    return np.corrcoef(fitted, other.ravel())[0, 1]


def test_flat_none_does_without_the_flat_field_of_the_camera_file(run, folder):
    assert run(EVERYTHING)[0] == 0
    assert run("calibrate psf_1 --camera camera.toml --flat none")[0] == 0
    camera = read_camera("camera.toml")
    assert ("flat_field" in camera, "hot_pixels" in camera) == (False, True)

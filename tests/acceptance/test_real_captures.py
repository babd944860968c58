"""Real captures through the command line. Pictures go to results/acceptance; look at them."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from torch.nn import functional as F

from mwdn import Calibration, Reconstructor, convolve, read_frame
from mwdn.calibration.isolated_pixels import find_isolated_pixels
from mwdn.cli.app import main
from mwdn.inference.room_light import find_room_light
from mwdn.networks.checkerboard import remove_checkerboard

pytestmark = pytest.mark.acceptance
OUT = Path("results/acceptance")


def reconstruct(*arguments: str | Path) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["reconstruct", *map(str, arguments), "--method", "admm", "--format", "npy"])
    assert ended.value.code == 0


def explained(scene: np.ndarray, psf: torch.Tensor, measurement: torch.Tensor) -> float:
    """Correlation of the reconstruction, blurred again, with the measurement."""
    again = convolve(torch.from_numpy(scene).movedim(-1, 0)[None], psf)
    return float(np.corrcoef(again.flatten().numpy(), measurement.flatten().numpy())[0, 1])


@pytest.mark.parametrize(("pattern", "psf", "count"), [("object_*", "psf_320.png", 4), ("scene*", "psf_480.tif", 6)])
def test_objects_of_the_papers_camera(data: Path, pattern: str, psf: str, count: int) -> None:
    camera = data / "mwdn-camera"
    captures = sorted((camera / "real-objects").glob(pattern))
    assert len(captures) == count
    out = OUT / Path(psf).stem
    reconstruct(*captures, "--psf", camera / psf, "--out", out)
    calibration = Calibration.from_file(camera / psf)
    for capture in captures:
        scene = np.load(out / f"{capture.stem}.npy")
        assert explained(scene, calibration.psf, calibration.correct(read_frame(capture))) > 0.97
        # An object in a dark room: its middle is bright, the border of the field is not.
        border = np.r_[scene[:20].ravel(), scene[-20:].ravel()].mean()
        middle = scene.shape[0] // 2
        assert scene[middle - 40 : middle + 40, middle - 40 : middle + 40].mean() > 3 * border


def test_room_light_in_real_captures(data: Path) -> None:
    """Only the four objects have some, and as much where the brightest tenth of a capture is cut off.

    Their darkest pixel has 0.07 to 0.15 of the mean; that of the same camera's scenes is black.
    """
    camera, diffusercam, tutorial = data / "mwdn-camera", data / "diffusercam", data / "diffusercam-tutorial"
    small, large = (Calibration.from_file(camera / name) for name in ("psf_320.png", "psf_480.tif"))
    other = Calibration.from_file(tutorial / "psf_sample.tif", bin=4)
    options = {"background": 0.0, "upside_down": True, "bgr": True}
    pairs = Calibration.from_file(diffusercam / "psf_recovered_270x480.npy", **options)
    captures = [
        *((small, file) for file in sorted((camera / "real-objects").glob("object_*"))),
        *((large, file) for file in sorted((camera / "real-objects").glob("scene*"))),
        (large, camera / "display_capture.tif"),
        (other, tutorial / "rawdata_hand_sample.tif"),
        *((pairs, file) for file in sorted((diffusercam / "diffuser_images").glob("*.npy"))),
    ]
    assert len(captures) == 20
    for calibration, file in captures:
        measurement = calibration.correct(calibration.frames.read(file))
        for b in (measurement, measurement.clamp(max=float(measurement.quantile(0.9)))):
            share = float(find_room_light(b, calibration.psf).share)
            assert (0.1 < share < 0.2) if calibration is small else share == 0.0, file.stem


def checkerboard(scene: torch.Tensor) -> float:
    """Root mean square over the brightest pixel, where the scene (1, C, H, W) varies by less than 2 % in 9 pixels."""
    image = (scene / scene.amax()).movedim(1, 0)
    binomial = torch.tensor([[1.0, 2, 1], [2, 4, 2], [1, 2, 1]])[None, None] / 16
    smooth = F.conv2d(image, binomial)
    is_flat = F.max_pool2d(smooth, 9, stride=4) + F.max_pool2d(-smooth, 9, stride=4) < 0.02
    signs = 1 - 2 * (torch.arange(image.shape[-1]) % 2)
    columns, rows = (F.avg_pool2d(F.conv2d(image * sign, binomial), 9, stride=4) for sign in (signs, signs[:, None]))
    return float((columns.square() + rows.square())[is_flat].mean().sqrt())


def test_the_denoisers_checkerboard_is_removed(data: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It hardly changes the picture otherwise."""
    calibration = Calibration.from_file(data / "mwdn-camera" / "psf_320.png")
    removed = []

    def remove(scene: torch.Tensor) -> torch.Tensor:
        removed.append((scene, remove_checkerboard(scene)))
        return removed[-1][1]

    monkeypatch.setattr("mwdn.networks.wiener_bank.remove_checkerboard", remove)
    reconstructor = Reconstructor("universal", calibration, device="cpu")
    for number in (0, 1, 3, 4):
        reconstructor(calibration.frames.read(data / "mwdn-camera" / "real-objects" / f"object_{number}.png"))
        before, after = removed[-1]
        shown = [
            checkerboard(before),
            checkerboard(after),
            float((after - before).square().mean().sqrt() / before.max()),
        ]
        print(f"object_{number}: {shown[0]:.1e} to {shown[1]:.1e}, change {shown[2]:.1e}")
        assert shown[1] < 0.7 * shown[0]
        assert shown[2] < 5e-4


def test_one_pixel_of_all_real_captures_is_hot(data: Path) -> None:
    """Captures are sharp, but no light in them is taken for a hot pixel."""
    camera = data / "mwdn-camera"
    files = [
        *sorted((camera / "real-objects").glob("*.png")),
        camera / "display_capture.tif",
        data / "diffusercam-tutorial" / "rawdata_hand_sample.tif",
        *sorted((data / "diffusercam" / "diffuser_images").glob("*.npy")),
    ]
    found = {}
    for file in files:
        frame = torch.from_numpy(read_frame(file).astype(np.float32)).movedim(-1, 0)[None]
        found[file.stem] = int(find_isolated_pixels(frame).sum())
    assert len(files) == 20
    assert {name: count for name, count in found.items() if count} == {"scene2": 1}


def test_hand_at_full_size(data: Path) -> None:
    folder = data / "diffusercam-tutorial"
    reconstruct(
        folder / "rawdata_hand_sample.tif", "--psf", folder / "psf_sample.tif", "--bin", "1", "--out", OUT / "hand"
    )
    scene = np.load(OUT / "hand" / "rawdata_hand_sample.npy")
    assert scene.shape == (1200, 1600, 1)
    calibration = Calibration.from_file(folder / "psf_sample.tif")
    measurement = calibration.correct(read_frame(folder / "rawdata_hand_sample.tif"))
    assert explained(scene, calibration.psf, measurement) > 0.99


@pytest.mark.parametrize(
    ("captures", "psf", "options"),
    [
        ("mwdn-camera/real-objects/object_*", "mwdn-camera/psf_320.png", ()),
        ("mwdn-camera/real-objects/scene*", "mwdn-camera/psf_480.tif", ()),
        ("mwdn-camera/display_capture.tif", "mwdn-camera/psf_480.tif", ()),
        (
            "diffusercam/diffuser_images/*",
            "diffusercam/psf_recovered_270x480.npy",
            ("--upside-down", "--bgr", "--background", "0"),
        ),
        ("diffusercam-tutorial/rawdata_*", "diffusercam-tutorial/psf_sample.tif", ("--bin", "4")),
    ],
)
@pytest.mark.parametrize("method", ["universal", "universal-small"])
def test_right_psfs_are_trusted(data: Path, tmp_path: Path, captures: str, psf: str, options: tuple, method: str):
    """By the networks that come with the package."""
    files = sorted(data.glob(captures))
    assert files
    with pytest.raises(SystemExit) as ended:
        main([*map(str, ("reconstruct", *files, "--psf", data / psf, *options, "--method", method, "--out", tmp_path))])
    assert ended.value.code == 0
    reports = {path.stem: json.loads(path.read_text()) for path in tmp_path.glob("*.json")}
    assert len(reports) == len(files)
    assert not [name for name, report in reports.items() if report["doubtful"]]


def best_psnr(result: np.ndarray, truth: np.ndarray) -> float:
    """PSNR in dB after one gain and one offset by least squares, rows 60:270, columns 60:440."""
    x, y = (picture[60:270, 60:440].ravel().astype(np.float64) for picture in (result, truth))
    design = np.stack([x, np.ones_like(x)], axis=1)
    misfit = design @ np.linalg.lstsq(design, y, rcond=None)[0] - y
    return float(-10 * np.log10((misfit**2).mean()))


def test_diffusercam_pairs(data: Path) -> None:
    """A textbook ADMM of 100 iterations reaches 16.16 dB on the mean of the eight pairs."""
    folder, out = data / "diffusercam", OUT / "diffusercam"
    options = ("--psf", folder / "psf_recovered_270x480.npy", "--upside-down", "--bgr", "--background", "0")
    reconstruct(folder / "diffuser_images", *options, "--out", out)
    scores = {}
    for truth in sorted((folder / "ground_truth_lensed").glob("*.npy")):
        picture = read_frame(truth, bgr=True, upside_down=True)
        scores[truth.stem] = best_psnr(np.load(out / truth.name), picture)
    scores["mean"] = float(np.mean(list(scores.values())))
    (out / "psnr.json").write_text(json.dumps(scores, indent=2))
    print({name: round(score, 2) for name, score in scores.items()})
    assert len(scores) == 9
    assert scores["mean"] >= 16.5
    # The right way up and with its own colours: any other orientation scores worse.
    scene, picture = np.load(out / "im326.npy"), read_frame(folder / "ground_truth_lensed/im326.npy", bgr=True)
    assert best_psnr(scene, picture[::-1]) > max(best_psnr(scene, picture), best_psnr(scene[..., ::-1], picture[::-1]))

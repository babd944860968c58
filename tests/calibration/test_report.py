"""The report of a PSF: levels of its file, and a verdict that is true."""

import json
import math

import cv2
import numpy as np
import pytest
import torch

from cameras import contour_psf
from mwdn.calibration import Calibration
from mwdn.calibration.place_files import PlaceFiles
from mwdn.calibration.places import psfs_elsewhere
from mwdn.calibration.report import inspect_psf
from mwdn.calibration.verdict import headline, verdict
from mwdn.errors import ImageError, PsfError
from mwdn.io.files import write_json
from mwdn.io.images import read_frame
from mwdn.optics import psf_measures, psf_spectrum, sample_camera
from mwdn.optics.random_psf import Variety

SIZE = 96, 80
CLEAN = Variety(support=(0.6, 0.6), offset=0.0, halo=(0.0, 0.0), glow=(0.0, 0.0), background=(0.0, 0.0))


def said(report, *words):
    """Findings that contain all of these words."""
    return [finding for finding in verdict(report) if all(word in finding.text for word in words)]


def frame_of(psf, *, level=0.0, peak=0.9, bits=16, noise=0.0, generator=None):
    """(H, W, C) integers: the PSF over a uniform level, its brightest pixel at ``peak`` of the full scale."""
    light = (peak - level) * psf / psf.max() + level
    light = light + noise * torch.randn(light.shape, generator=generator)
    top = 2**bits - 1
    return (light.clamp(0, 1) * top).round().numpy()[0].transpose(1, 2, 0).astype("u1" if bits == 8 else "u2")


def report_of(tmp_path, frame, **options):
    path = tmp_path / "psf.png"
    assert cv2.imwrite(str(path), frame[..., ::-1])
    return inspect_psf(Calibration.from_file(path, **options), read_frame(path))


@pytest.fixture
def psf():
    return sample_camera(5, SIZE, family="contours", variety=CLEAN)


def test_a_good_psf_has_nothing_to_mind(tmp_path, psf):
    report = report_of(tmp_path, frame_of(psf))
    assert headline(report).startswith("A good PSF")
    assert {finding.weight for finding in verdict(report)} == {"good"}
    assert report.levels.peak == pytest.approx(0.9, abs=1e-4)
    assert report.levels.saturated == 0
    assert report.size == SIZE


@pytest.mark.parametrize("sides", ["ab", "ba"])
def test_of_two_points_as_far_from_the_axis_the_less_alike_counts(tmp_path, psf, sides):
    """Only the last one was compared."""
    others = {"a": psf, "b": sample_camera(6, SIZE, family="contours", variety=CLEAN)}
    for name, other in others.items():
        np.save(tmp_path / f"{name}.npy", other[0].movedim(0, -1).numpy())
    field = PlaceFiles(
        field_positions=((0.0, -20.0), (0.0, 20.0)), field_psfs=tuple(tmp_path / f"{name}.npy" for name in sides)
    )
    _, beside = psfs_elsewhere(Calibration(psf, places=field))
    worst = psf_measures.likeness(others["b"], psf)
    assert inspect_psf(Calibration(psf), off_axis=beside).off_axis == {20.0: pytest.approx(worst, abs=0.02)}
    assert worst < 0.9


def test_background_is_reported(tmp_path, psf):
    """A uniform level of 0.1 of the full scale, as the file of the paper's camera has between its lines."""
    frame = frame_of(psf, level=0.1)
    report = report_of(tmp_path, frame)
    assert report.levels.background == pytest.approx((0.1,) * 3, abs=2e-3)
    share = 0.1 * SIZE[0] * SIZE[1] / (frame / 65535).sum((0, 1)).min()
    assert report.levels.pedestal == pytest.approx(share, rel=0.02)
    assert [finding.weight for finding in said(report, "0.100", "was subtracted")] == ["weak"]
    assert said(report_of(tmp_path, frame, background=0.05), "0.100", "found, and 0.050, 0.050, 0.050 subtracted")
    kept = report_of(tmp_path, frame, background=0.0)
    assert said(kept, "0.100", "was kept", "--background 0")
    assert said(kept, "at 0.10 of the full scale", "--dark")
    assert kept.support.glow > report.support.glow + 0.3


def test_a_background_that_is_too_high(tmp_path, psf):
    """The verdict was "A usable PSF", with advice to do the same in other programs."""
    frame = frame_of(psf, level=0.1)
    for background, weights in ((0.1, []), (0.12, []), (0.18, ["weak"]), (0.4, ["bad"])):
        report = report_of(tmp_path, frame, background=background)
        assert [finding.weight for finding in said(report, "faint parts", "--background")] == weights


def test_a_psf_from_which_too_much_was_subtracted(tmp_path, psf):
    frame = (psf / psf.max())[0].movedim(0, -1).numpy()
    noise = 0.002 * np.random.default_rng(0).standard_normal(frame.shape)
    for level, weights in ((0.0, []), (0.3, ["bad"])):
        np.save(tmp_path / "psf.npy", (frame + noise - level).astype("f4"))
        report = inspect_psf(Calibration.from_file(tmp_path / "psf.npy"), read_frame(tmp_path / "psf.npy"))
        assert [finding.weight for finding in said(report, "below 0", "more was subtracted")] == weights


def test_light_between_the_lines_that_the_estimate_leaves(tmp_path, psf):
    """The level lies only where the mask is lit, so the darkest 5 % of the frame do not show it."""
    lit = torch.zeros(SIZE)
    lit[16:80, 12:68] = 0.1
    light = 0.8 * psf / psf.max() + lit
    frame = (light * 65535).round().numpy()[0].transpose(1, 2, 0).astype("u2")
    report = report_of(tmp_path, frame)
    assert max(report.levels.background) == 0
    assert report.levels.between == pytest.approx(0.1, abs=0.005)
    assert said(report, "at 0.10 of the full scale", "no background was subtracted", "--dark")


def test_noise_of_the_file(tmp_path, psf, generator):
    """In the frame as drawn, and in |H|^2: white noise s of N pixels over the light L is N s^2 / L^2 everywhere."""
    frame = frame_of(psf, noise=0.01, level=0.1, generator=generator)
    report = report_of(tmp_path, frame, background=0.1)
    assert report.levels.noise == pytest.approx(0.01, rel=0.3)
    light = (0.8 * psf / psf.max()).sum((-2, -1)).min().item()
    # The dark half of the noise is cut with the background, so that a little light is left over.
    expected = SIZE[0] * SIZE[1] * 0.01**2 / light**2
    assert 0.3 * expected < report.levels.noise_floor < 1.7 * expected
    clean = report_of(tmp_path, frame_of(psf))
    assert clean.levels.noise_floor < 1e-3 * report.levels.noise_floor


def test_a_noisy_picture_of_a_blurred_psf_says_how_far_it_is_known(tmp_path, generator):
    y, x = torch.arange(96.0)[:, None] - 48, torch.arange(80.0) - 40
    blurred = torch.exp(-0.5 * (y.square() + x.square()) / 3.0**2)[None, None]
    report = report_of(tmp_path, frame_of(blurred, noise=0.02, level=0.1, generator=generator), background=0.1)
    # exp(-4 pi^2 9 f^2) meets twice the floor at f of sqrt(-ln(2 floor) / (36 pi^2)).
    expected = math.sqrt(-math.log(2 * report.levels.noise_floor) / (36 * math.pi**2))
    assert report.known_frequency == pytest.approx(expected, abs=0.02)
    assert said(report, "mostly noise")


def test_exposure(tmp_path, psf):
    assert said(report_of(tmp_path, frame_of(psf, peak=0.2)), "20 % of the full scale", "Expose longer")
    # A well exposed 12-bit PSF in a 16-bit file: longer exposures would saturate it.
    assert said(report_of(tmp_path, frame_of(psf, peak=0.05)), "Expose longer, unless", "`--bit-depth 12`")
    assert said(report_of(tmp_path, frame_of(psf, bits=8)), "230 levels", "16 bits")
    frame = frame_of(psf)
    frame.reshape(-1, 3)[np.argsort(frame[..., 1].ravel())[-5:]] = 65535
    report = report_of(tmp_path, frame)
    assert report.levels.saturated == 5
    assert said(report, "5 pixels are at the sensor's maximum")


def test_floats_have_no_full_scale(tmp_path, psf):
    np.save(tmp_path / "psf.npy", psf[0].movedim(0, -1).numpy())
    report = inspect_psf(Calibration.from_file(tmp_path / "psf.npy"), read_frame(tmp_path / "psf.npy"))
    assert report.levels.largest == 0
    assert said(report, "floats", "saturation")
    level = 0.05 * psf.max() + psf
    np.save(tmp_path / "psf.npy", level[0].movedim(0, -1).numpy())
    report = inspect_psf(Calibration.from_file(tmp_path / "psf.npy"), read_frame(tmp_path / "psf.npy"))
    assert said(report, f"{0.05 / 1.05:.3f}", "of the brightest pixel")


def test_without_a_frame_nothing_is_said_about_levels(psf):
    report = inspect_psf(Calibration(psf))
    assert report.levels is None
    assert not said(report, "exposed")
    assert not said(report, "full scale")


def test_cut_psf(psf):
    assert said(inspect_psf(Calibration(psf)), "all within the frame")
    cut = psf[..., 30:66, 24:56]
    assert said(inspect_psf(Calibration(cut / cut.sum((-2, -1), keepdim=True))), "is cut")


def test_a_mask_that_repeats_itself(generator):
    tile = (torch.rand(16, 16, generator=generator) < 0.05).float()
    psf = tile.repeat(6, 5)[None, None]
    report = inspect_psf(Calibration(psf / psf.sum()))
    assert report.side_lobe[0] > 0.6
    assert all(place % 16 == 0 for place in report.side_lobe[1])
    assert [finding.weight for finding in said(report, "ghosts")] == ["bad"]
    assert headline(report).startswith("A poor PSF")


def test_defocused_pinhole():
    y, x = torch.arange(96)[:, None] - 48, torch.arange(96) - 48
    disc = ((y.square() + x.square()) <= 12**2).float()[None, None]
    report = inspect_psf(Calibration(disc / disc.sum()))
    assert said(report, f"{report.dark_rings[0]:.3f}", "cycles per pixel in any direction")


def test_blurred_psf_can_be_binned():
    y, x = torch.arange(300.0)[:, None] - 150, torch.arange(300.0) - 150
    blurred = torch.exp(-0.5 * (y.square() + x.square()) / 5.0**2)[None, None]
    assert said(inspect_psf(Calibration(blurred / blurred.sum())), "px wide", "`--bin 2`")


def test_colours_that_differ():
    planes = [contour_psf((64, 64), cell=10, generator=torch.Generator().manual_seed(seed)) for seed in range(3)]
    report = inspect_psf(Calibration(torch.cat(planes, 1)))
    assert report.colour_likeness < 0.5
    assert [finding.weight for finding in said(report, "colours differ")] == ["bad"]


def test_centroid_beside_the_centre(psf):
    moved = psf.roll((12, -8), (-2, -1))
    before, after = (inspect_psf(Calibration(image)).support.offset for image in (psf, moved))
    assert [b - a for a, b in zip(before, after, strict=True)] == pytest.approx([12, -8], abs=0.5)
    assert said(inspect_psf(Calibration(moved)), "px below", "to the left")


def test_distance_and_angle(psf):
    others = {10.0: psf, 20.0: psf.flip(-1)}
    report = inspect_psf(Calibration(psf), depth=others, angle={5.0: psf})
    assert report.depth[10.0] == pytest.approx(1, abs=1e-4)
    assert report.depth[20.0] == psf_measures.likeness(psf.flip(-1), psf)
    assert said(report, "distance", "at 20 mm the camera needs another PSF")
    assert said(report, "every angle", "1.00")


def test_numbers_are_those_of_the_measures(psf):
    report = inspect_psf(Calibration(psf))
    assert report.noise_gain[1e-3] == max(psf_spectrum.noise_gain(psf, 1e-3))
    gains, kept = list(report.noise_gain.values()), list(report.detail_kept.values())
    assert gains == sorted(gains, reverse=True)
    assert kept == sorted(kept, reverse=True)
    worst = min(psf_spectrum.resolved_frequency(psf[:, [c]], 0.003) for c in range(3))
    assert report.resolution_px[0.003] == 0.5 / worst


def test_json(tmp_path, psf):
    report = inspect_psf(Calibration(psf))
    write_json(tmp_path / "new" / "report.json", report.content())
    content = json.loads((tmp_path / "new" / "report.json").read_text())
    assert content["size"] == list(SIZE)
    assert content["noise_gain"]["0.001"] == report.noise_gain[1e-3]
    assert content["psf_hash"] == report.psf_hash
    with pytest.raises(ImageError, match="another folder"):
        write_json(tmp_path, content)


@pytest.mark.parametrize("size", [(8, 8), (9, 31)])
def test_small_psfs(size):
    """`mwdn reconstruct` refuses them; they counted as usable."""
    for seed in range(5):
        report = inspect_psf(Calibration(sample_camera(seed, size)))
        json.dumps(report.content(), allow_nan=False)
        assert said(report, f"{size[0]} x {size[1]} pixels", "needs 15")[0].weight == "bad"


@pytest.mark.parametrize(
    ("file", "options", "findings"),
    [
        ("mwdn-camera/psf_480.tif", {}, [("at 0.10 of the full scale", "--dark")]),
        ("mwdn-camera/psf_320.png", {}, [("at 0.10 of the full scale", "but only"), ("is cut",)]),
        ("mwdn-camera/psf_raw_1920.png", {"bin": 6}, [("all within the frame",)]),
        ("diffusercam-tutorial/psf_sample.tif", {"bin": 4}, [("192 pixels", "maximum")]),
        ("diffusercam/psf_recovered_270x480.npy", {"upside_down": True, "bgr": True}, [("floats",)]),
        ("phlatcam/psf_384x640.npy", {}, [("Sharp",)]),
    ],
)
def test_measured_psfs(file, options, findings, data):
    calibration = Calibration.from_file(data / file, **options)
    report = inspect_psf(calibration, calibration.frames.read(data / file))
    assert all(said(report, *words) for words in findings)
    assert not [finding for finding in verdict(report) if finding.weight == "bad"]
    assert report.side_lobe[0] < 0.2
    assert 1 < report.resolution_px[0.001] < 6


@pytest.mark.parametrize("at", [(32, 32), (0, 0)])
def test_a_spot_has_no_light_between_its_lines(at):
    """All light of a pinhole's PSF is in one pixel; it was called even light without detail."""
    psf = torch.zeros(1, 1, 64, 64)
    psf[0, 0, at[0], at[1]] = 1
    report = inspect_psf(Calibration(psf))
    assert (report.support.glow, report.support.contrast) == (0, 1)
    assert not [text for _, text in verdict(report) if "no detail" in text]


def test_a_psf_that_shows_nothing():
    with pytest.raises(PsfError, match="single pixel"):
        inspect_psf(Calibration(torch.ones(1, 1, 1, 1)))
    text = " ".join(text for _, text in verdict(inspect_psf(Calibration(torch.ones(1, 1, 64, 64)))))
    assert "none at 1.0 %" in text
    assert "inf" not in text


def test_light_that_is_left_after_a_dark_frame_is_the_psfs(tmp_path, psf):
    """The camera file had `background = 0` from `mwdn calibrate`, and the advice was not to give that."""
    frame = (60000 * (0.99 * psf / psf.max() + 0.002)).clamp(max=65535)[0].movedim(0, -1).numpy().astype(np.uint16)
    for dark, weight, said in ((None, "weak", "Leave out"), (np.zeros_like(frame), "good", "which belongs to the PSF")):
        calibration = Calibration.from_array(frame, background=0.0, dark=dark)
        (found,) = [each for each in verdict(inspect_psf(calibration, frame)) if "A uniform background" in each.text]
        assert said in found.text
        assert found.weight == weight

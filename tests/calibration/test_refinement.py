"""Terms that known pictures tell of a camera: found again where they are true, and not taken where they are not."""

import json
import math
import re
from dataclasses import replace
from pathlib import Path

import h5py
import pytest
import torch

from cameras import contour_psf
from mwdn import Calibration, convolve
from mwdn.calibration.camera_file import write_camera
from mwdn.calibration.pair_model import PairModel, Terms
from mwdn.calibration.places import at_distance
from mwdn.calibration.psf_identity import psf_identity
from mwdn.calibration.refinement import Refinement, smooth_field
from mwdn.calibration.term_selection import MAX_FOLDS, left_out, select_terms
from mwdn.data.pair_checks import other_camera
from mwdn.data.pairs import PairFile
from mwdn.errors import ParameterError
from mwdn.inference.methods import psf_warning
from mwdn.io.images import write_frame
from mwdn.networks import build
from mwdn.optics.polynomials import polynomials
from mwdn.weights.checkpoint import save_network

SIZE = 64, 80
FIELD = ((1.0, 0.1, -0.15, -0.2, 0.05, -0.1),)
GAIN = ((1.0, 0.3, -0.2), (1.0, 0.1, 0.2), (1.0, -0.2, 0.0))
LIGHT = ((0.0, 0.02, 0.01), (0.0, 0.02, 0.01), (0.0, 0.01, 0.0))


@pytest.fixture
def psf(generator):
    return contour_psf(SIZE, cell=14, generator=generator).expand(1, 3, -1, -1).contiguous()


def pairs(psf, truth, generator, count=4, noise=0.0):
    """Random scenes of a few coloured squares in units of their own, through the true camera."""
    made = []
    for number in range(count):
        scene = torch.nn.functional.interpolate(torch.rand(1, 3, 5, 6, generator=generator) ** 3, SIZE)
        light = convolve(scene, truth.psf(psf))
        if truth.sensor_field:
            light = light * truth.field_map(SIZE)
        if truth.stray_light:
            light = light + truth.stray_map(SIZE)
        light = light + noise * torch.randn(light.shape, generator=generator)
        made.append((light, scene * (0.5 + 0.2 * number) + 0.1))
    return made


def test_polynomials_by_hand():
    corner = polynomials(2, (3, 5))[:, 2, 0].tolist()  # y = 1, x = -1: 1, y, x, y^2, yx, x^2
    assert corner == [1, 1, -1, 1, -1, 1]
    assert torch.equal(smooth_field(((2.0, 0.0, 1.0),), (3, 5))[0, 0, 1], torch.tensor([1.0, 1.5, 2.0, 2.5, 3.0]))


def test_a_measurement_is_corrected_back(psf, generator):
    truth = Refinement(sensor_field=FIELD, stray_light=LIGHT)
    even = torch.rand(1, 3, *SIZE, generator=generator)
    seen = even * truth.field_map(SIZE) + truth.stray_map(SIZE)
    torch.testing.assert_close(truth.measurement(seen), even)


@pytest.mark.parametrize(
    ("truth", "terms"),
    [
        (Refinement(sensor_field=FIELD), Terms(sensor_field=2)),
        (Refinement(psf_gain=GAIN), Terms(psf_gain=1)),
        (Refinement(stray_light=LIGHT), Terms(stray_light=1)),
        (Refinement(psf_gain=GAIN, sensor_field=FIELD), Terms(psf_gain=1, sensor_field=2)),
    ],
)
def test_true_terms_are_found(psf, generator, truth, terms):
    made = pairs(psf, truth, generator)
    model = PairModel(psf, made, kernels=terms.kernels)
    fit = model.fit(terms, range(4), steps=8)
    found = fit.refinement()
    assert max(model.unexplained(fit, pair) for pair in range(4)) < 0.01 < model.unexplained(model.start(Terms()), 0)
    if truth.sensor_field:
        torch.testing.assert_close(found.field_map(SIZE), truth.field_map(SIZE), rtol=0, atol=0.02)
    if truth.stray_light:
        torch.testing.assert_close(found.stray_map(SIZE), truth.stray_map(SIZE), rtol=0, atol=1e-3)
    if truth.psf_gain:
        error = (found.psf(psf) - truth.psf(psf)).norm() / (truth.psf(psf) - psf).norm()
        assert error < 0.1


def test_the_displacement_of_the_envelope_is_found(psf, generator):
    truth = Refinement(envelope_shift=(0.02, -0.01))
    model = PairModel(psf, pairs(psf, truth, generator))
    down, right = model.fit(Terms(envelope=1), range(4)).displacement
    assert (down, right) == (pytest.approx(0.02, abs=0.007), pytest.approx(-0.01, abs=0.007))  # half a pixel


def test_only_terms_that_explain_left_out_pairs_are_taken(psf, generator):
    exact = select_terms(psf, lambda: pairs(psf, Refinement(), torch.Generator().manual_seed(1), 3, noise=0.01))
    assert [step.term for step in exact.taken] == [""]
    uneven = select_terms(
        psf, lambda: pairs(psf, Refinement(sensor_field=FIELD), torch.Generator().manual_seed(1), 3, noise=0.003)
    )
    assert uneven.taken[1].term == "sensor_field"
    assert not uneven.fit(uneven.taken[0].terms).refinement()


def test_with_a_displaced_envelope_the_calibration_as_it_was_stays(psf):
    truth = Refinement(envelope_shift=(0.05, 0.0))
    made = pairs(psf, truth, torch.Generator().manual_seed(1), 3, noise=0.003)
    selection = select_terms(psf, lambda: made)
    assert not selection.fit(selection.taken[0].terms).refinement()
    with_it = next(step for step in selection.taken if step.term == "envelope")
    assert selection.fit(with_it.terms).refinement().envelope_shift[0] == pytest.approx(0.05, abs=0.015)


@pytest.mark.parametrize("count", [2, MAX_FOLDS, 23])
def test_each_pair_is_left_out_once_and_some_are_kept(count):
    parts = left_out(count)
    assert sorted(pair for part in parts for pair in part) == list(range(count))
    assert len(parts) == min(count, MAX_FOLDS)
    assert max(map(len, parts)) < count


def test_one_pair_is_too_few(psf, generator):
    with pytest.raises(ParameterError, match=r"`pairs` \(1\)"):
        select_terms(psf, lambda: pairs(psf, Refinement(), generator, count=1))


@pytest.mark.parametrize("rows", [((1.0, 2.0),), ((1.0,), (1.0,)), ((1.0,), (1.0, 0.0, 0.0), (1.0,))])
def test_rows_that_are_no_polynomials(rows):
    with pytest.raises(ParameterError, match="`sensor_field`"):
        Refinement(sensor_field=rows)


def test_calibrate_with_pairs(psf, generator, run, tmp_path, monkeypatch):
    """The camera file holds the field; a calibration read from it divides by it; the PSF's hash stays."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("mwdn.calibration.term_selection.HIGHEST", {"sensor_field": 2})  # others take 20 times as long
    write_frame("psf.npy", (psf / psf.max())[0].movedim(0, -1).contiguous().numpy())
    with PairFile.create("pairs.h5", measurement_shape=(*SIZE, 3), scene_shape=(*SIZE, 3)) as file:
        for light, scene in pairs(psf, Refinement(sensor_field=FIELD), generator, count=3, noise=0.002):
            file.append(light[0], scene[0])
    (tmp_path / "camera.toml").write_text('psf = "psf.npy"\npsf_sha256 = "of an earlier one"\n')

    def killed_before_the_end(*arguments, **options):
        assert "earlier" in (tmp_path / "camera.toml").read_text()
        return select_terms(*arguments, **options)

    monkeypatch.setattr("mwdn.cli.refine.select_terms", killed_before_the_end)
    code, out, err = run("calibrate psf.npy --background 0 --pairs pairs.h5 -o camera.toml")
    assert code == 0, err
    assert not list(tmp_path.glob(".*"))
    assert "sensor field of order 2" in out
    report = json.loads((tmp_path / "camera-refinement.json").read_text())
    assert report["tried"][0]["term"] == ""
    assert len(report["tried"][0]["unexplained"]) == 3
    assert report["scene_gamma"][0]["gamma"] == 1
    assert "--scene-gamma" not in out
    assert (tmp_path / "camera-refinement.png").exists()
    calibration = Calibration.load("camera.toml")
    assert bool(calibration.refinement) == bool(report["kept"])


@pytest.mark.parametrize(
    ("name", "value", "said"),
    [("scene", 0.0, "scene of pair 1, counted from 0, is black"), ("measurement", math.nan, "holds NaN")],
)
def test_pairs_that_cannot_be_fitted_are_named(psf, generator, run, tmp_path, monkeypatch, name, value, said):
    """They ended in a traceback, after minutes."""
    monkeypatch.chdir(tmp_path)
    write_frame("psf.npy", (psf / psf.max())[0].movedim(0, -1).contiguous().numpy())
    shape = (*SIZE, 3)
    with PairFile.create("pairs.h5", measurement_shape=shape, scene_shape=shape, dtype="float32") as file:
        for light, scene in pairs(psf, Refinement(), generator, count=3):
            file.append(light[0], scene[0])
    with h5py.File("pairs.h5", "a") as file:
        file[name][1] = value
    code, _, err = run("calibrate psf.npy --background 0 --pairs pairs.h5 -o camera.toml")
    assert (code, said in " ".join(err.split())) == (2, True), err
    assert not (tmp_path / "camera.toml").exists()


def test_pairs_and_weights_of_a_camera_stay_its_own_when_it_is_refined(psf, tmp_path):
    """Of the calibrated PSF, of a refined one, and refined in another way; those of another PSF are told apart."""
    plain, other = Calibration(psf), Calibration(psf.flip(-1))
    first, second = plain.refined(Refinement(GAIN)), plain.refined(Refinement(GAIN[::-1]))
    assert first.psf_hash != plain.psf_hash == first.unrefined_hash
    for made in (plain, first):
        path = tmp_path / f"{made.psf_hash}.h5"
        shape = (*SIZE, 3)
        attributes = psf_identity(made)
        with PairFile.create(path, measurement_shape=shape, scene_shape=shape, attributes=attributes) as file:
            file.append(psf[0], psf[0])
        weights = path.with_suffix(".safetensors")
        save_network(weights, build("wiener"), "wiener", {}, **attributes)
        with PairFile(path) as file:
            for used in (plain, first, second):
                assert other_camera(file, used) is None
                assert psf_warning(weights, used) is None
            for warning in (other_camera(file, other), psf_warning(weights, other)):
                assert {made.psf_hash, other.psf_hash} <= set(re.findall(r"\b[0-9a-f]{16}\b", warning))


def test_camera_file_holds_the_terms(psf, generator, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_frame("psf.npy", (psf / psf.max())[0].movedim(0, -1).contiguous().numpy())
    plain = Calibration.from_file("psf.npy", background=0.0)
    terms = Refinement(GAIN, (0.02, 0.0), FIELD, LIGHT)
    write_camera("camera.toml", {"psf": Path("psf.npy"), "background": 0.0, **vars(terms)})
    calibration = Calibration.load("camera.toml")
    assert calibration.refinement == terms
    torch.testing.assert_close(calibration.psf, terms.psf(plain.psf))
    frame = torch.rand(*SIZE, 3, generator=generator).numpy()
    torch.testing.assert_close(calibration.correct(frame), terms.measurement(plain.correct(frame)))
    other = Calibration.load("camera.toml", bin=2)  # polynomials fit any size
    assert other.size == (32, 40)
    write_frame("other.npy", psf.flip(-1)[0].movedim(0, -1).contiguous().numpy())
    assert Calibration.load("camera.toml", psf="other.npy").refinement == replace(
        terms, psf_gain=(), envelope_shift=None
    )


def test_terms_of_the_psf_are_those_of_its_distance(psf, tmp_path):
    """PSFs at other distances were used without them and without a word."""
    for name in ("own", "far"):
        write_frame(tmp_path / f"{name}.tif", (psf / psf.max())[0].movedim(0, -1).numpy())
    content = {"psf": tmp_path / "own.tif", "distance_mm": 100.0, "background": 0.0, "psf_gain": GAIN}
    content |= {"distance_psfs": (tmp_path / "far.tif",), "distances_mm": (300.0,)}
    write_camera(tmp_path / "camera.toml", content)
    calibration = Calibration.load(tmp_path / "camera.toml")
    (near, said_near), (far, said_far) = (at_distance(calibration, distance) for distance in (100.0, 300.0))
    assert torch.equal(near.psf, calibration.psf)
    assert torch.allclose(far.psf, psf / psf.sum((-2, -1), keepdim=True), atol=1e-6)
    assert "psf_gain" not in said_near
    assert said_far.endswith("Without `psf_gain`, found for the PSF of 100 mm.")


def test_terms_of_the_sensor_leave_the_psf_as_it_is(psf, generator):
    """It was normalised again, and rounding gave it another hash."""
    calibration = Calibration(psf + torch.rand(psf.shape, generator=generator) / psf[0, 0].numel())
    refined = calibration.refined(Refinement(stray_light=LIGHT, sensor_field=FIELD))
    assert refined.psf_hash == refined.unrefined_hash == calibration.psf_hash

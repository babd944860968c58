"""The comparison from end to end, on a small simulated camera."""

import io
import json
import math
import re
import sys

import h5py
import numpy as np
import pytest
import torch
from rich.console import Console
from torch import nn

from cameras import contour_psf
from mwdn.calibration import Calibration
from mwdn.cli import app, weights
from mwdn.cli import evaluate as command
from mwdn.data.pairs import PairFile
from mwdn.errors import CheckpointError, ParameterError, PluginError, ShapeError, UnknownNameError
from mwdn.evaluation import First, Perceptual, Protocol, Report, Scores, alexnet, evaluate, learnable_numbers, measure
from mwdn.inference.reconstructor import Reconstructor
from mwdn.io.images import read_frame, write_linear
from mwdn.networks import build
from mwdn.optics import Camera
from mwdn.solvers import Admm

SIZE = 40, 48


@pytest.fixture
def camera(generator):
    return Camera(contour_psf(SIZE, cell=10, generator=generator))


@pytest.fixture
def pairs(camera, generator):
    """Three pairs (measurement, scene), as from a `PairFile`."""
    seeds = torch.rand(3, 3, 5, 6, generator=generator)
    scenes = nn.functional.interpolate(seeds, SIZE, mode="bicubic").clamp(0, 1)
    return list(zip(camera.simulate(scenes, generator=generator), scenes, strict=True))


@pytest.fixture
def perceptual(data):
    return Perceptual.load(data / "lpips" / "alexnet_features_torchvision.pth")


def printed(table, width=200):
    file = io.StringIO()
    Console(file=file, width=width).print(table)
    return file.getvalue()


def test_solvers_from_end_to_end(camera, pairs, perceptual, tmp_path):
    calibration = Calibration(camera.psf)
    methods = {
        "wiener": Reconstructor("wiener", calibration, device="cpu"),
        "admm": Reconstructor(Admm(iterations=20), calibration, device="cpu"),
    }
    done = []
    report = evaluate(
        methods, pairs, Protocol(), perceptual=perceptual, shown=2, progress=lambda name, i: done.append((name, i))
    )
    assert done == [(name, i) for name in methods for i in range(3)]
    assert (report.protocol, report.variant, report.pictures, report.missing) == ("full", "clipped", 3, {})
    for name, scores in report.methods.items():
        for i, (measurement, scene) in enumerate(pairs):
            expected = measure(methods[name](measurement[None]), scene[None], Protocol(), perceptual=perceptual)
            result = {metric: values[i] for metric, values in scores.values.items()}
            assert result == pytest.approx({metric: value.item() for metric, value in expected.items()})
        mean, low, high = scores.summary("psnr")
        assert 8 < low <= mean <= high
        assert len(scores.seconds) == 3
        assert scores.median_seconds > 0
        assert scores.learnable == 0
        assert scores.device == "cpu"
        assert scores.peak_bytes is None or scores.peak_bytes >= 0
    text = printed(report.table())
    assert "3 pictures, protocol full, clipped" in text
    for word in ("wiener", "admm", "PSNR / dB", "LPIPS", f"{report.methods['admm'].summary('psnr')[0]:.2f} ["):
        assert word in text
    report.write(tmp_path / "out")
    content = json.loads((tmp_path / "out" / "report.json").read_text())
    assert content["methods"]["admm"]["values"]["psnr"] == list(report.methods["admm"].values["psnr"])
    assert content["methods"]["wiener"]["mean_low_high"]["ssim"] == list(report.methods["wiener"].summary("ssim"))
    sheet = read_frame(tmp_path / "out" / "comparison.png")
    # Two rows of four pictures, 240 high, each with a gap of 6, under a heading of 26.
    assert sheet.shape == (26 + 2 * 246, 4 * (240 * 48 // 40 + 6), 3)


def test_missing_metrics_are_named_and_not_averaged(pairs):
    reason = "No weights of AlexNet at [here]."
    report = evaluate({"a[b].pt": lambda b: b}, pairs, Protocol.parse("centre-32"), perceptual=Perceptual.none(reason))
    assert report.variant == "raw"
    text = printed(report.table())
    assert "a[b].pt" in text
    assert f"Without LPIPS and feature MSE: {reason}" in text
    assert text.count(reason) == 1
    content = json.loads(report.json())
    assert content["missing"] == {"lpips": reason, "feature_mse": reason}
    assert content["methods"]["a[b].pt"]["values"]["lpips"] == [None] * 3
    assert content["methods"]["a[b].pt"]["mean_low_high"]["lpips"] == [None] * 3
    with pytest.raises(UnknownNameError, match="Did you mean 'psnr'"):
        report.methods["a[b].pt"].summary("psn")


def test_missing_weights_are_reported(pairs, monkeypatch):
    def unreachable(path=None, *, download):
        assert not download
        raise CheckpointError("no network")

    monkeypatch.setattr("mwdn.evaluation.metrics.load_alexnet", unreachable)
    report = evaluate({"same": lambda b: b}, pairs[:1], Protocol())
    assert report.missing == {"lpips": "no network", "feature_mse": "no network"}


def test_the_best_method_is_bold(pairs):
    scenes = {measurement.sum().item(): scene for measurement, scene in pairs}
    methods = {"perfect": lambda b: scenes[b.sum().item()][None].clone(), "dark": torch.zeros_like}
    report = evaluate(methods, pairs, Protocol(), perceptual=Perceptual.none())
    psnr, ssim, mse = (list(report.table().columns[i].cells) for i in (1, 2, 3))
    assert psnr[0].startswith("[bold]inf")
    assert ssim[0].startswith("[bold]1.000")
    assert mse[0].startswith("[bold]0")
    assert not any("bold" in column[1] for column in (psnr, ssim, mse))
    assert json.loads(report.json())["methods"]["perfect"]["values"]["psnr"] == [None] * 3


def test_methods_are_called_one_picture_at_a_time_after_a_warm_up(pairs):
    measurements = []

    def method(measurement):
        measurements.append(measurement)
        return measurement

    evaluate({"method": method}, pairs, Protocol(), perceptual=Perceptual.none())
    timed = measurements[-3:]
    assert len(measurements) > 3
    assert [b.shape[0] for b in timed] == [1, 1, 1]
    assert all(torch.equal(b[0], measurement) for b, (measurement, _) in zip(timed, pairs, strict=True))


def test_learnable_numbers_of_the_network_in_a_method(camera):
    network = build("wiener")
    assert learnable_numbers(Reconstructor(network, Calibration(camera.psf), device="cpu")) == 2
    assert learnable_numbers(nn.Conv2d(3, 3, 1)) == 12
    assert learnable_numbers(torch.zeros_like) == 0


@pytest.mark.usefixtures("unchecked")
def test_wrong_calls_are_refused(pairs):
    same = {"same": lambda b: b}
    for methods, some, what in (({}, pairs, "methods"), (same, [], "pairs")):
        with pytest.raises(ParameterError, match=f"`{what}` must not be empty"):
            evaluate(methods, some, Protocol(), perceptual=Perceptual.none())
    with pytest.raises(ShapeError, match="must have the same shape"):
        evaluate({"small": lambda b: b[:, :1]}, pairs, Protocol(), perceptual=Perceptual.none())
    with pytest.raises(ParameterError, match=r"`protocol` \('full'\) of `evaluate` must be"):
        evaluate(same, pairs, "full")


@pytest.mark.parametrize(("part", "what"), [(0, "measurement"), (1, "scene")])
def test_a_pair_that_is_not_finite_is_named_before_any_work(pairs, part, what):
    pairs[2][part][0, 3, 4] = math.nan
    with pytest.raises(ParameterError, match=f"The {what} of pair 2, counted from 0, holds NaN or infinity"):
        evaluate({"method": pytest.fail}, pairs, Protocol(), perceptual=Perceptual.none())


def test_a_part_too_small_for_alexnet_is_measured_without_it(pairs, monkeypatch):
    monkeypatch.setattr("mwdn.evaluation.metrics.load_alexnet", pytest.fail)
    report = evaluate({"same": lambda b: b}, pairs, Protocol.parse("0:30,0:48"))
    reason = "the part 0:30,0:48 has less than 31 pixels a side, for AlexNet"
    assert report.missing == {"lpips": reason, "feature_mse": reason}
    assert math.isfinite(report.methods["same"].summary("psnr")[0])


def test_table_for_80_columns():
    low = {"psnr": 33.1, "ssim": 0.85, "lpips": 0.0046, "feature_mse": 0.02341, "mse": 0.000487}
    values = {metric: (mean, 1.1 * mean) for metric, mean in low.items()}
    name = "runs/mine/best.safetensors"
    methods = {
        "wiener": Scores(values, (0.01, 0.02), 2**20, "cpu", 0),
        name: Scores(values, (12.3,), None, "cpu", 17345678),
    }
    report = Report("full", "clipped", methods, {}, [])
    text = printed(report.table(narrow=True), 80)
    assert "…" not in text
    assert max(map(len, text.splitlines())) <= 80
    words = set(re.sub(r"[\[\],]", " ", text).split())
    expected = report.methods["wiener"].summary("mse")
    assert {f"{number:.3g}" for number in expected} | {"33.10", "12300.0", "0.02341", "MiB"} <= words
    assert "17,345,678" in text
    assert name in "".join(line.split(" ")[0] for line in text.splitlines())


def test_first_reads_only_indexed_pairs(pairs):
    read = []

    class Watched(list):
        def __getitem__(self, index):
            read.append(index)
            return super().__getitem__(index)

    first = First(Watched(pairs), 2)
    assert len(first) == 2
    read.clear()
    assert torch.equal(first[1][0], pairs[1][0])
    assert read == [1]
    with pytest.raises(IndexError):
        first[2]
    assert len(First(pairs, 10)) == 3
    with pytest.raises(ParameterError, match="--first"):
        First(pairs, 0)


def run(*arguments):
    with pytest.raises(SystemExit) as left:
        app.main([str(argument) for argument in arguments])
    return left.value.code


@pytest.fixture
def common(camera, pairs, tmp_path, monkeypatch):
    """Options of a command, its pairs in pairs.h5; without perceptual networks."""
    shape = (*SIZE, 3)
    with PairFile.create(tmp_path / "pairs.h5", measurement_shape=shape, scene_shape=shape) as file:
        for measurement, scene in pairs:
            file.append(measurement, scene)
    monkeypatch.setattr(alexnet, "cache_folder", lambda: tmp_path / "cache")
    monkeypatch.delenv("MWDN_ALEXNET", raising=False)

    monkeypatch.setattr(alexnet, "urlopen", lambda *_, **__: pytest.fail("nobody asked for a download"))
    write_linear(tmp_path / "psf.npy", camera.psf)
    return ["--data", tmp_path / "pairs.h5", "--psf", tmp_path / "psf.npy", "--background", 0, "--device", "cpu"]


def test_command(common, tmp_path, capsys):
    options = ["--first", 2, "--protocol", "2:38,4:40", "--variant", "best-gain", "--out", tmp_path / "out"]
    assert run("evaluate", "wiener", "fista", *common, *options) == 0
    out = capsys.readouterr().out
    assert "Without LPIPS and feature MSE" in " ".join(out.split())
    assert out.count("--lpips") == 1
    content = json.loads((tmp_path / "out" / "report.json").read_text())
    assert list(content["methods"]) == ["wiener", "fista"]
    assert "`--lpips`" in content["missing"]["lpips"]
    assert (content["pictures"], content["protocol"], content["variant"]) == (2, "2:38,4:40", "best-gain")
    assert run("evaluate", *common) == 2
    assert run("evaluate", "wiener", *common, "--protocol", "centre") == 2
    assert run("evaluate", "wiener", *common, "--protocol", "0:5,0:5") == 2
    assert "`--protocol` (0:5,0:5) must leave at least 11 x 11 pixels" in capsys.readouterr().err
    assert run("evaluate", "winer", *common) == 2


def test_a_method_that_returns_nan_is_named_and_costs_no_other_its_scores(pairs):
    """The contact sheet was refused, with advice for programmers, and the table was not printed."""
    methods = {"good": lambda measurement: measurement, "bad": lambda measurement: measurement * math.nan}
    with pytest.warns(UserWarning, match=r"`bad` returned NaN or infinity for (\d+) of \1 pictures"):
        report = evaluate(methods, pairs, Protocol.parse("full"), perceptual=Perceptual.none())
    assert report.sheet().isfinite().all()
    (psnr,) = (column.cells for column in report.table().columns if "PSNR" in str(column.header))
    assert [(cell.startswith("[bold]"), cell.startswith("nan")) for cell in psnr] == [(True, False), (False, True)]


def test_a_method_that_fails_is_named_and_costs_no_other_its_scores(pairs):
    """Its error ended the comparison after the others had been measured."""
    calls = []

    def fail_late(measurement):
        calls.append(0)
        if len(calls) > 3:  # two calls warm up
            raise PluginError("The plugin `mine` failed.")
        return measurement

    def fail_at_once(measurement):
        raise ParameterError("`lambda_` must be positive.")

    methods = {"late": fail_late, "at once": fail_at_once, "same": lambda light: light}
    report = evaluate(methods, pairs, Protocol.parse("full"), perceptual=Perceptual.none())
    assert list(report.methods) == ["same"]
    assert report.failed.keys() == {"late", "at once"}
    assert json.loads(report.json())["failed"]["late"] == "The plugin `mine` failed."
    assert {len(row) for row in report.rows} == {3}, "a scene, a measurement and the picture of one method"
    del methods["same"]
    with pytest.raises(PluginError, match="`mine` failed"):
        evaluate(methods, pairs, Protocol.parse("full"), perceptual=Perceptual.none())


def test_scenes_of_another_scale_are_named(pairs):
    brighter = [(measurement, 100 * scene) for measurement, scene in pairs]
    with pytest.warns(UserWarning, match=r"scenes have values up to \d+, but scores are defined for 0 to 1"):
        evaluate(
            {"same": lambda measurement: measurement}, brighter, Protocol.parse("full"), perceptual=Perceptual.none()
        )


def test_one_picture_has_no_interval(pairs):
    def cells(pairs):
        report = evaluate({"same": lambda light: light}, pairs, Protocol.parse("full"), perceptual=Perceptual.none())
        return [cell for column in report.table().columns for cell in column.cells]

    assert any("[" in cell.replace("[bold]", "").replace("[/bold]", "") for cell in cells(pairs))
    assert not any("[" in cell.replace("[bold]", "").replace("[/bold]", "") for cell in cells(pairs[:1]))


@pytest.mark.parametrize(
    ("out", "message"), [("file", "must be a folder that can be written to"), ("mine", "would overwrite an input")]
)
def test_command_checks_its_folder_first(common, tmp_path, monkeypatch, capsys, out, message):
    monkeypatch.setattr("mwdn.evaluation.evaluate", pytest.fail)
    (tmp_path / "file").write_text("no folder")
    (tmp_path / "mine").mkdir()
    psf = tmp_path / "mine" / "comparison.png"  # by its content not a PNG
    (tmp_path / "psf.npy").rename(psf)
    line = [psf if option == tmp_path / "psf.npy" else option for option in common]
    assert run("evaluate", "wiener", *line, "--out", tmp_path / out) == 2
    assert message in capsys.readouterr().err


def test_json_is_the_report(common, tmp_path, capsys):
    assert run("evaluate", "wiener", *common, "--out", tmp_path / "out", "--json") == 0
    assert json.loads(capsys.readouterr().out) == json.loads((tmp_path / "out" / "report.json").read_text())


def test_a_folder_in_the_place_of_the_report_is_refused_before_anything_is_computed(common, tmp_path, capsys):
    (tmp_path / "out" / "report.json").mkdir(parents=True)
    assert run("evaluate", "wiener", *common, "--out", tmp_path / "out") == 2
    shown = capsys.readouterr()
    assert shown.out == ""
    assert "report.json` cannot be written" in shown.err


@pytest.mark.parametrize(
    ("count", "value", "scale", "message"),
    [
        (3, math.nan, 1, "The measurement of pair 1, counted from 0, holds NaN or infinity"),
        (0, 0, 1, "`pairs` must not be empty"),
        (3, 0, 2, "The PSF is 2 times as large: multiply `--bin`, which is 1 unless given, by 2."),
    ],
)
def test_command_on_unusable_pairs(common, tmp_path, capsys, count, value, scale, message):
    with h5py.File(tmp_path / "pairs.h5", "a") as file:
        file["measurement"][1, 5, 6, 0] = value
        for name in ("measurement", "scene"):
            file[name].resize(count, axis=0)
    np.save(tmp_path / "psf.npy", np.kron(np.load(tmp_path / "psf.npy"), np.ones((scale, scale, 1), np.float32)))
    assert run("evaluate", "wiener", *common, "--out", tmp_path / "out") == 2
    assert message in capsys.readouterr().err


def test_advice_for_pairs_of_another_bin_is_right(common, tmp_path, capsys):
    """The PSF's file is 4 times as large as the pairs, its camera file says 2: `--psf-bin 2` changed nothing."""
    np.save(tmp_path / "large.npy", np.kron(np.load(tmp_path / "psf.npy"), np.ones((4, 4, 1), np.float32)))
    camera = tmp_path / "camera.toml"
    camera.write_text('psf = "large.npy"\nbackground = 0.0\nbin = 2\n', encoding="utf-8")
    line = ("evaluate", "wiener", *common[:2], "--camera", camera, "--no-lpips", "--out", tmp_path / "out")
    assert run(*line) == 2
    assert "The PSF is 2 times as large: multiply `--bin`, which is 1 unless given, by 2" in capsys.readouterr().err
    assert run(*line, "--bin", "4") == 0


def test_command_warns_of_pairs_of_another_camera(common, tmp_path, capsys):
    own_hash = Calibration.from_file(tmp_path / "psf.npy", background=0.0).psf_hash
    for psf_hash in ("0" * 16, own_hash):
        with h5py.File(tmp_path / "pairs.h5", "a") as file:
            file.attrs["psf_hash"] = psf_hash
        assert run("evaluate", "wiener", *common, "--out", tmp_path / "out") == 0
        err = capsys.readouterr().err
        assert (psf_hash in err and own_hash in err) == (psf_hash != own_hash)


def test_a_download_is_asked_for(common, tmp_path, monkeypatch):
    """By --lpips, or by a yes on a terminal; --no-lpips asks nothing."""
    line = ["evaluate", "wiener", *common, "--first", 1, "--out", tmp_path / "out"]

    def unroutable(*_, **__):
        raise OSError("Network is unreachable")

    def missing(*options):
        assert run(*line, *options) == 0
        return json.loads((tmp_path / "out" / "report.json").read_text())["missing"]["lpips"]

    asked = []
    monkeypatch.setattr(weights.Confirm, "ask", lambda question, **_: asked.append(question))
    monkeypatch.setattr(sys.stdin, "isatty", lambda: True)
    monkeypatch.setattr(weights, "notes", Console(force_terminal=True, force_interactive=True))
    assert missing("--no-lpips") == "--no-lpips"
    with monkeypatch.context() as connected:
        connected.setattr(alexnet, "urlopen", unroutable)
        assert "Network is unreachable" in missing("--lpips")
    assert asked == []
    assert "`--lpips`" in missing()
    assert len(asked) == 1
    assert "234 MiB" in asked[0]


def test_options_go_to_the_methods_that_have_them(common, tmp_path, capsys, monkeypatch):
    made = {}

    def record(method, calibration, *, device, **options):
        made[method] = options
        return Reconstructor(method, calibration, device=device, **options)

    monkeypatch.setattr(command, "Reconstructor", record)
    line = ["evaluate", "admm", "wiener", "fista", *common, "--first", 1, "--no-lpips", "--out", tmp_path / "out"]
    assert run(*line, "--iterations", 2, "--regularisation", 1e-3) == 0
    regularisation = {"regularisation": 1e-3}
    assert made == {"admm": {"iterations": 2, **regularisation}, "wiener": regularisation, "fista": {"iterations": 2}}
    capsys.readouterr()
    assert run(*line, "--regularization", 1e-3) == 2
    said = " ".join(capsys.readouterr().err.split())
    assert "Unknown option: --regularization. Did you mean --regularisation?" in said
    assert "'admm', 'wiener', 'fista'" in said

"""What `mwdn interpret` says of a network, against the network itself and closed forms."""

import json
import math

import numpy as np
import pytest
import torch

from cameras import contour_psf
from made import trained
from mwdn.errors import ParameterError, ShapeError
from mwdn.inference.interpretation import Panel, interpret
from mwdn.inference.interpretation_page import display
from mwdn.networks import build
from mwdn.solvers import align
from mwdn.solvers.admm import Admm
from mwdn.weights.checkpoint import save_network

SIZE = 48
FAST = {"finest": 0, "align": False}


@pytest.fixture
def psf(generator):
    return contour_psf((SIZE, SIZE), cell=12, generator=generator).expand(1, 3, -1, -1).contiguous()


@pytest.fixture
def measurement(generator):
    return torch.rand(1, 3, SIZE, SIZE, generator=generator)


def panels(row):
    return {panel.name: panel.picture for panel in row.panels}


@pytest.mark.parametrize("name", ["mwdn", "mwdn-cpsf"])
def test_each_scale_of_mwdn(name, measurement, psf, generator):
    network = trained(build(name, width=4), generator, spread=0.5)
    result = interpret(network, measurement, psf)
    whole = network(measurement, psf)
    assert [row.name for row in result.rows] == ["input and output", "scale 1", "scale 1/2", "scale 1/4", "scale 1/8"]
    assert torch.equal(panels(result.rows[0])["reconstruction"], whole)
    # With all filters, nothing is left out.
    torch.testing.assert_close(panels(result.rows[1])["from here down"], whole)
    for i, (row, wiener) in enumerate(zip(result.rows[1:], network.filters, strict=True)):
        assert row.numbers["lambda"] == wiener.regularisation.item()
        assert row.numbers["w"] == (None if name == "mwdn-cpsf" else wiener.weight.item())
        assert 0 < row.numbers["largest_gain"] <= 1.0001 / (2 * math.sqrt(row.numbers["lambda"]))
        shown = panels(row)
        change = shown["adds to the picture"]
        assert row.numbers["share_of_picture"] == pytest.approx((change.std() / whole.std()).item(), rel=1e-4)
        assert shown["deconvolved"].shape[-2:] == (SIZE >> i, SIZE >> i)
    # Without the finest filter's change, the picture is that of the scales below it.
    without = whole - panels(result.rows[1])["adds to the picture"]
    torch.testing.assert_close(without, panels(result.rows[2])["from here down"], rtol=1e-4, atol=1e-5)


def test_a_filter_without_contrast_adds_nothing(measurement, psf, generator):
    network = trained(build("mwdn", width=4), generator)
    with torch.no_grad():
        network.filters[0].log_weight.fill_(-40)
    first = interpret(network, measurement, psf).rows[1]
    assert first.numbers["share_of_picture"] < 1e-6
    assert first.numbers["inverted"] == 0


def test_a_single_filter(measurement, psf, generator):
    """A PSF of one point with w = 1: |H| is 1 everywhere, the filter divides by 1 + lambda."""
    point = torch.zeros(1, 3, SIZE, SIZE)
    point[..., SIZE // 2, SIZE // 2] = 1
    network = build("wiener", weight=1.0, regularisation=0.25)
    row = interpret(network, measurement, point).rows[1]
    assert row.numbers["inverted"] == 1
    assert row.numbers["largest_gain"] == pytest.approx(0.8, rel=1e-5)
    torch.testing.assert_close(panels(row)["Wiener estimate"], measurement / 1.25)
    network = trained(build("wiener-unet", width=4), generator)
    row = interpret(network, measurement, psf).rows[1]
    total = panels(row)["Wiener estimate"] + panels(row)["U-Net's change"]
    torch.testing.assert_close(total, network(measurement, psf))


@pytest.mark.parametrize("options", [FAST, {"finest": 4, "align": False}])
def test_the_bank_and_its_unet(options, measurement, psf, generator):
    network = trained(build("wiener-bank", width=4, **options), generator)
    result = interpret(network, measurement, psf)
    rows = {row.name: row for row in result.rows}
    whole = network(measurement, psf)
    torch.testing.assert_close(panels(rows["U-Net"])["reconstruction"], whole)
    first = network.estimates(measurement, psf)[:, :3]
    torch.testing.assert_close(panels(rows["U-Net"])["U-Net's change"], whole - first)
    assert list(panels(rows["Wiener bank"])) == ["lambda 0.001", "lambda 0.0001", "lambda 2e-05"]
    assert ("iterations" in rows) == (options["finest"] > 0)


def test_a_share_of_an_even_picture_is_not_a_number(psf):
    """It was a million: the rounding of an even capture has a standard deviation, too."""
    bank = build("wiener-bank", width=2, finest=8, align=False, regularisations=(1e-3,)).eval()
    found = interpret(bank, torch.full((1, 3, *psf.shape[-2:]), 0.5), psf)
    assert next(part for part in found.content()["parts"] if part["name"] == "iterations")["residual"] is None


def test_alignment_is_reported(measurement, psf, generator):
    network = build("wiener-bank", width=4, finest=4)
    result = interpret(network, measurement, psf)
    assert result.content()["aligned"] == result.pose == align(measurement, psf).numbers()
    assert set(result.pose) == {"turn_degrees", "scale", "haze", "envelope_down", "envelope_right"}


def test_methods_without_filters_are_refused(measurement, psf):
    for method in (Admm(), build("unet", width=2)):
        with pytest.raises(ParameterError, match=r"has no learned Wiener filters.*universal-small, or the checkpoint"):
            interpret(method, measurement, psf)


def test_several_captures_are_refused(measurement, psf):
    with pytest.raises(ShapeError, match="one"):
        interpret(build("wiener"), torch.cat([measurement, measurement]), psf)


def test_panels_of_millions_of_pixels_are_drawn():
    """torch.quantile takes 2^24 numbers at most."""
    picture = torch.linspace(0, 1, 2**24 + 2**20).reshape(1, 1, 4096, -1)
    for kind in ("change", "features"):
        assert display(Panel("", picture, kind)).isfinite().all()


def test_the_command_writes_a_sheet_pictures_and_numbers(run, psf, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    save_network(tmp_path / "n.safetensors", build("wiener-unet", width=2), "wiener-unet", {"width": 2})
    np.save("psf.npy", (0.9 * psf / psf.max())[0].movedim(0, -1).numpy())
    np.save("capture.npy", np.random.default_rng(0).random((SIZE, SIZE, 3), np.float32))
    code, out, err = run("interpret n.safetensors capture.npy --psf psf.npy -o out --device cpu --json")
    assert code == 0, err
    content = json.loads(out)
    assert content == json.loads((tmp_path / "out/interpretation.json").read_text())
    assert [part["name"] for part in content["parts"]] == ["Wiener filter"]
    assert (tmp_path / "out/interpretation.png").stat().st_size > 10_000
    assert len(list((tmp_path / "out/pictures").glob("*.png"))) == 3 + 3
    assert run("interpret n.safetensors capture.npy --psf psf.npy -o out --device cpu")[0] == 0  # again
    code, _, err = run("interpret wiener capture.npy --psf psf.npy -o out")
    assert (code, "no learned Wiener filters" in " ".join(err.split())) == (2, True), err

"""Public weights: located, refused, downloaded once; the message without internet access."""

import hashlib
import io
import re
from dataclasses import replace
from urllib.error import URLError

import pytest
import torch

from mwdn.errors import CheckpointError, ShapeError
from mwdn.evaluation import alexnet
from mwdn.evaluation.alexnet import CHANNELS, AlexNet, Heads, load_alexnet, load_heads


@pytest.fixture(autouse=True)
def fetched(monkeypatch, tmp_path):
    """An empty home, no environment variables, no internet access; yields the requested addresses."""
    asked = []

    def unroutable(address, timeout):
        asked.append(address)
        raise URLError("Network is unreachable")

    monkeypatch.setattr(alexnet, "cache_folder", lambda: tmp_path / "cache")
    monkeypatch.setattr(alexnet, "urlopen", unroutable)
    monkeypatch.delenv("MWDN_ALEXNET", raising=False)
    monkeypatch.delenv("MWDN_LPIPS", raising=False)
    return asked


def serve(monkeypatch, name, network):
    """Serve a network's weights with their checksum as a download; returns the file's bytes."""
    file = io.BytesIO()
    torch.save(network.state_dict(), file)
    content = file.getvalue()
    public = replace(getattr(alexnet, name), sha256=hashlib.sha256(content).hexdigest()[:8])
    monkeypatch.setattr(alexnet, name, public)
    monkeypatch.setattr(alexnet, "urlopen", lambda *_, **__: io.BytesIO(content))
    return content


@pytest.mark.parametrize(("height", "width"), [(31, 31), (64, 47), (227, 227)])
def test_features_have_torchvisions_sizes(height, width):
    features = AlexNet()(torch.rand(2, 3, height, width))
    first = [(n + 4 - 11) // 4 + 1 for n in (height, width)]
    second = [(n - 3) // 2 + 1 for n in first]
    third = [(n - 3) // 2 + 1 for n in second]
    assert [feature.shape[1] for feature in features] == list(CHANNELS)
    assert [list(feature.shape[2:]) for feature in features] == [first, second, third, third, third]


def test_keys_are_torchvisions():
    names = [f"features.{i}.{kind}" for i in (0, 3, 6, 8, 10) for kind in ("weight", "bias")]
    assert list(AlexNet().state_dict()) == names
    assert list(Heads().state_dict()) == [f"lin{i}.model.1.weight" for i in range(5)]


def test_grey_is_repeated_and_later_layers_can_be_left_out():
    network, grey = AlexNet(), torch.rand(1, 1, 40, 40)
    whole, part = network(grey.expand(-1, 3, -1, -1)), network(grey, 4)
    assert len(part) == 4
    torch.testing.assert_close(part, whole[:4])


@pytest.mark.parametrize("shape", [(1, 3, 30, 64), (1, 3, 64, 30), (1, 2, 64, 64)])
def test_pictures_that_do_not_suit_alexnet_are_refused(shape):
    with pytest.raises(ShapeError, match="at least 31 x 31"):
        AlexNet()(torch.rand(shape))


def test_weights_are_read_frozen_in_evaluation_mode(data, fetched):
    network = load_alexnet(data / "lpips" / "alexnet_features_torchvision.pth")
    assert not network.training
    assert not any(parameter.requires_grad for parameter in network.parameters())
    assert network.features[0].bias.min().item() == pytest.approx(-2.80695844)
    assert not fetched


def test_environment_names_the_files_and_heads_lie_beside(data, fetched, monkeypatch):
    monkeypatch.setenv("MWDN_ALEXNET", str(data / "lpips" / "alexnet_features_torchvision.pth"))
    load_alexnet()
    beside = load_heads()
    monkeypatch.delenv("MWDN_ALEXNET")
    monkeypatch.setenv("MWDN_LPIPS", str(data / "lpips" / "lin_v0.1_alex.pth"))
    for a, b in zip(load_heads().parameters(), beside.parameters(), strict=True):
        assert torch.equal(a, b)
    assert not fetched


@pytest.mark.parametrize(("load", "variable"), [(load_alexnet, "MWDN_ALEXNET"), (load_heads, "MWDN_LPIPS")])
def test_offline_the_error_says_what_to_do(load, variable, fetched, tmp_path):
    with pytest.raises(CheckpointError) as raised:
        load()
    message = str(raised.value)
    assert "Network is unreachable" in message
    assert str(tmp_path / "cache") in message
    assert f"export {variable}=" in message
    assert re.search(r"`curl -fL -o \S+\.pth https://\S+\.pth`", message)
    assert len(fetched) == 1
    assert not list((tmp_path / "cache").iterdir())


def test_a_wrong_path_is_not_replaced_by_a_download(fetched, tmp_path, monkeypatch):
    with pytest.raises(CheckpointError, match="No weights of AlexNet"):
        load_alexnet(tmp_path / "absent.pth")
    monkeypatch.setenv("MWDN_LPIPS", str(tmp_path / "absent.pth"))
    with pytest.raises(CheckpointError, match="MWDN_LPIPS"):
        load_heads()
    assert not fetched


@pytest.mark.parametrize(
    ("name", "load", "network"), [("_ALEXNET", load_alexnet, AlexNet), ("_HEADS", load_heads, Heads)]
)
def test_downloads_once_and_keeps_the_file(name, load, network, monkeypatch, tmp_path, caplog):
    published = network()
    content = serve(monkeypatch, name, published)
    load()
    assert "Downloading" in caplog.text
    assert [file.read_bytes() for file in (tmp_path / "cache").iterdir()] == [content]
    monkeypatch.setattr(alexnet, "urlopen", None)
    for key, value in load().state_dict().items():
        assert torch.equal(value, published.state_dict()[key])


def test_a_whole_alexnet_is_accepted(monkeypatch, tmp_path):
    state = {**AlexNet().state_dict(), "classifier.1.weight": torch.rand(4, 4)}
    torch.save(state, tmp_path / "whole.pth")
    load_alexnet(tmp_path / "whole.pth")


def test_a_damaged_download_is_not_kept(monkeypatch, tmp_path):
    monkeypatch.setattr(alexnet, "urlopen", lambda *_, **__: io.BytesIO(b"a login page"))
    with pytest.raises(CheckpointError, match=r"SHA-256.*7be5be79"):
        load_alexnet()
    assert not list((tmp_path / "cache").iterdir())


def test_other_weights_and_damaged_files_are_refused(tmp_path):
    torch.save({"features.0.weight": torch.zeros(1)}, tmp_path / "other.pth")
    (tmp_path / "damaged.pth").write_bytes(b"\x80\x02}q\x00.")
    (tmp_path / "picture.png").write_bytes(b"\x89PNG\r\n\x1a\n" + bytes(50))
    torch.save([1, 2], tmp_path / "list.pth")
    other, damaged = "does not hold the weights of `AlexNet`", "cannot be read as plain weights: it is damaged"
    for file, message in (
        ("other.pth", other),
        ("list.pth", other),
        ("damaged.pth", damaged),
        ("picture.png", damaged),
    ):
        with pytest.raises(CheckpointError, match=message) as caught:
            load_alexnet(tmp_path / file)
        assert "\n" not in str(caught.value)
        assert "weights_only" not in str(caught.value)

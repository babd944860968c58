"""Checkpoints of this package and of the paper's authors; and other files."""

import inspect
import json
import os
import pickle
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file

from authors_code import authors, authors_output
from mwdn.calibration import Calibration
from mwdn.errors import CheckpointError
from mwdn.inference.reconstructor import Reconstructor
from mwdn.networks import NETWORKS, build
from mwdn.optics import unit_sum
from mwdn.weights.authors import load_authors
from mwdn.weights.checkpoint import load_checkpoint, read_metadata, save_network
from mwdn.weights.tensors import read_header, read_tensors


def small(name):
    small_options = {"width": 4, "pooling": "average", "size": (9, 9), **({"weight": 0.02} if name == "wiener" else {})}
    options = {
        key: small_options[key] for key in small_options.keys() & inspect.signature(NETWORKS[name]).parameters.keys()
    }
    return build(name, **options), options


def pair(generator, size=(32, 48)):
    return torch.rand(1, 3, *size, generator=generator), torch.rand(1, 3, *size, generator=generator) ** 4


# --- This package -------------------------------------------------------------------------------------


@torch.no_grad()
@pytest.mark.parametrize("name", NETWORKS)
def test_a_saved_network_is_loaded_unchanged(tmp_path, name, generator):
    network, options = small(name)
    b, h = pair(generator)
    network.train()(b, h)  # moves the running means
    path = tmp_path / "folder" / "net.safetensors"
    save_network(path, network, name, options)
    loaded = load_checkpoint(path)
    assert type(loaded) is type(network)
    assert not loaded.training
    assert torch.equal(loaded(b, h), network.eval()(b, h))
    assert {p.device.type for p in loaded.state_dict().values()} == {"cpu"}
    assert [file.name for file in path.parent.iterdir()] == ["net.safetensors"]


def test_metadata(tmp_path):
    network, options = small("mwdn")
    save_network(tmp_path / "a.safetensors", network, "mwdn", options, psf_hash="00ff", recipe={"lr": 1e-4})
    header = read_metadata(tmp_path / "a.safetensors")
    assert header.pop("version").count(".") == 2
    assert header == {"name": "mwdn", "options": options, "psf_hash": "00ff", "recipe": {"lr": 1e-4}}


def test_saving_replaces_and_a_failed_save_does_not(tmp_path):
    path = tmp_path / "a.safetensors"
    network, options = small("unet")
    save_network(path, network, "unet", options, epoch=1)
    save_network(path, network, "unet", options, epoch=2)
    with pytest.raises(TypeError):
        save_network(path, network, "unet", options, epoch=object())
    assert read_metadata(path)["epoch"] == 2
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("name", ["net.pt", "net"])
def test_only_safetensors_are_saved(tmp_path, name):
    network, options = small("unet")
    with pytest.raises(CheckpointError, match=rf"`.*{name}` must end in \.safetensors"):
        save_network(tmp_path / name, network, "unet", options)


def stored(path, header, tensors=None):
    save_file(tensors or {"a": torch.zeros(1)}, path, metadata={"mwdn": header} if header is not None else None)
    return path


@pytest.mark.parametrize(
    ("header", "message"),
    [
        (None, "was not written by mwdn"),
        ("{", "metadata of .* is damaged"),
        ("[]", "must hold a name and options"),
        ('{"name": "mwdn"}', "must hold a name and options"),
        ('{"name": "mwdm", "options": {}, "version": "9.1"}', "of mwdn 9.1, .* Did you mean 'mwdn'"),
        ('{"name": "mwdn", "options": {"depth": 3}}', "cannot be built: .*depth"),
        ('{"name": "mwdn", "options": {"pooling": "median"}}', "cannot be built: No pooling"),
        ('{"name": "wiener", "options": {}}', "does not fit the network 'wiener'"),
    ],
)
@pytest.mark.usefixtures("unchecked")
def test_foreign_and_damaged_metadata(tmp_path, header, message):
    path = stored(tmp_path / "a.safetensors", header)
    with pytest.raises(CheckpointError, match=message) as caught:
        load_checkpoint(path)
    assert str(path) in str(caught.value)


def test_weights_of_another_shape(tmp_path):
    network, options = small("mwdn")
    save_network(tmp_path / "a.safetensors", network, "mwdn", options | {"width": 8})
    with pytest.raises(CheckpointError, match="does not fit the network 'mwdn' it names: size mismatch for ") as caught:
        load_checkpoint(tmp_path / "a.safetensors")
    assert "\n" not in str(caught.value)


def test_weights_that_are_not_finite(tmp_path):
    network, options = small("mwdn")
    with torch.no_grad():
        next(network.parameters())[0] = torch.nan
    save_network(tmp_path / "a.safetensors", network, "mwdn", options)
    with pytest.raises(CheckpointError, match=r"holds NaN or infinity, `.*weight` first"):
        load_checkpoint(tmp_path / "a.safetensors")


def test_weights_have_the_permissions_of_any_new_file(tmp_path):
    network, options = small("mwdn")
    save_network(tmp_path / "a.safetensors", network, "mwdn", options)
    (tmp_path / "new").touch()
    assert (tmp_path / "a.safetensors").stat().st_mode == (tmp_path / "new").stat().st_mode


def test_missing_tensor(tmp_path):
    network, options = small("mwdn")
    save_network(tmp_path / "a.safetensors", network, "mwdn", options)
    tensors = load_file(tmp_path / "a.safetensors")
    del tensors["filters.2.log_weight"]
    stored(tmp_path / "a.safetensors", json.dumps({"name": "mwdn", "options": options}), tensors)
    with pytest.raises(CheckpointError, match=r"filters\.2\.log_weight"):
        load_checkpoint(tmp_path / "a.safetensors")


@pytest.mark.parametrize("kept", [0, 5, 100, -1])
def test_truncated_file(tmp_path, kept):
    network, options = small("unet")
    path = tmp_path / "a.safetensors"
    save_network(path, network, "unet", options)
    path.write_bytes(path.read_bytes()[:kept])
    with pytest.raises(CheckpointError, match=r"`.*a\.safetensors` cannot be read as safetensors"):
        load_checkpoint(path)


@pytest.mark.parametrize("name", ["no.safetensors", "no.tar", "."])
def test_missing_file(tmp_path, name):
    with pytest.raises(CheckpointError, match=r"No checkpoint at .*the current folder is"):
        load_checkpoint(tmp_path / name)


# --- The authors --------------------------------------------------------------------------------------


@torch.no_grad()
@pytest.mark.parametrize("prefix", ["", "module."])
@pytest.mark.parametrize("cpsf", [False, True], ids=["mwdn", "mwdn-cpsf"])
def test_authors_checkpoint_gives_their_output(tmp_path, cpsf, prefix, generator):
    state = authors(generator, cpsf=cpsf)
    wrapped = {"net_state_dict": {prefix + key: value for key, value in state.items()}, "epoch": 299}
    torch.save(wrapped, tmp_path / "best.tar")
    network = load_checkpoint(tmp_path / "best.tar")
    b, h = pair(generator, (32, 48))
    h = unit_sum(h)
    h = h / h.max()
    expected = authors_output(state, b, h, cpsf=cpsf)
    assert expected.std() > 0.01
    torch.testing.assert_close(network(b, h), expected, rtol=1e-3, atol=1e-3 * expected.abs().max().item())


@pytest.mark.parametrize(("cpsf", "count"), [(False, 17_267_531), (True, 21_956_745)])
def test_full_width_has_the_papers_count(cpsf, count, generator):
    network = load_authors(authors(generator, cpsf=cpsf, width=64))
    assert sum(parameter.numel() for parameter in network.parameters()) == count


def test_a_negative_lambda_is_refused(tmp_path, generator):
    state = authors(generator, cpsf=False)
    state["delta"][2] *= -1
    torch.save(state, tmp_path / "a.pt")
    with pytest.raises(CheckpointError, match=r"`delta` \(\[.*-0\.0.*\]\) must be positive"):
        load_checkpoint(tmp_path / "a.pt")


@torch.no_grad()
@pytest.mark.parametrize("cpsf", [False, True], ids=["mwdn", "mwdn-cpsf"])
def test_a_negative_w_gives_their_output(cpsf, generator):
    """With w < 0 the filter of eq. (2) turns negative, and the next convolution with it."""
    state = authors(generator, cpsf=cpsf)
    state["w"][0] *= -1
    b, h = pair(generator, (32, 32))
    h = h / h.max()
    expected = authors_output(state, b, h, cpsf=cpsf)
    torch.testing.assert_close(load_authors(state)(b, h), expected, rtol=1e-3, atol=1e-3 * expected.abs().max().item())


@pytest.mark.parametrize("cpsf", [False, True], ids=["mwdn", "mwdn-cpsf"])
def test_a_reconstructor_gives_the_psf_as_stored(tmp_path, cpsf, generator):
    """The brightness of the PSF's colours, its exposure and its background are those of the file."""
    state = authors(generator, cpsf=cpsf)
    torch.save(state, tmp_path / "theirs.pt")
    stored = torch.rand(32, 32, 3, generator=generator) ** 4 * torch.tensor([0.7, 0.5, 0.3]) + 0.05
    pixels = (255 * stored).to(torch.uint8).numpy()
    b = torch.rand(1, 3, 32, 32, generator=generator)
    psf = torch.from_numpy(pixels / np.float32(255)).movedim(-1, 0)[None]
    expected = authors_output(state, b, psf, cpsf=cpsf).detach()
    reconstruct = Reconstructor(
        tmp_path / "theirs.pt", Calibration.from_array(pixels, background=0.0), precision="exact", device="cpu"
    )
    torch.testing.assert_close(reconstruct(b), expected, rtol=1e-3, atol=1e-3 * expected.abs().max().item())
    assert reconstruct.warning is None
    subtracted = Reconstructor(tmp_path / "theirs.pt", Calibration.from_array(pixels), device="cpu")
    assert "background=0" in subtracted.warning


def test_the_unused_lambda_may_be_negative(generator):
    state = authors(generator, cpsf=True)
    state["delta"][4] = -1
    assert load_authors(state).unused_regularisation.item() == -1


@pytest.mark.parametrize("cpsf", [False, True])
@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("delta", torch.ones(3), "`delta` must have the shape"),
        ("w", torch.ones(2), "`w` must have the shape"),
        ("inc.double_conv.0.weight", torch.ones(4), "must have the shape"),
        ("down3.avgpool_conv.1.double_conv.3.bias", None, "Missing key.*encoder.scales.3.3.bias"),
        ("up2.conv.double_conv.3.bias", torch.ones(99), "size mismatch for decoder.scales.1.3.bias"),
        ("attention.weight", torch.ones(2), "Unexpected key.*attention.weight"),
        ("outc.conv.weight", None, "is neither a checkpoint of mwdn"),
        ("w", None, "is neither a checkpoint of mwdn"),
    ],
)
def test_wrong_tensors_under_the_authors_names(tmp_path, cpsf, key, value, message, generator):
    state = authors(generator, cpsf=cpsf)
    if value is None:
        del state[key]
    else:
        state[key] = value
    torch.save({"net_state_dict": state}, tmp_path / "a.tar")
    with pytest.raises(CheckpointError, match=f"(?s){message}"):
        load_checkpoint(tmp_path / "a.tar")


# --- Others -------------------------------------------------------------------------------------------


class Bomb:
    def __init__(self, target):
        self.target = target

    def __reduce__(self):
        return Path.touch, (self.target,)


@pytest.mark.parametrize("save", [torch.save, lambda what, path: path.write_bytes(pickle.dumps(what))])
def test_code_in_a_file_is_not_run(tmp_path, save):
    target = tmp_path / "exploded"
    save({"net_state_dict": Bomb(target)}, tmp_path / "a.pt")
    with pytest.raises(CheckpointError, match=r"`.*a\.pt` cannot be read as plain weights") as caught:
        load_checkpoint(tmp_path / "a.pt")
    assert not target.exists()
    assert "weights_only" not in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("content", [[1, 2], torch.zeros(3), {"net_state_dict": 5}, {3: torch.zeros(1)}, {}])
def test_other_content(tmp_path, content):
    torch.save(content, tmp_path / "a.pth")
    with pytest.raises(CheckpointError, match="is neither a checkpoint of mwdn"):
        load_checkpoint(tmp_path / "a.pth")


@pytest.mark.parametrize("data", [b"", b"hello", b"PK\x03\x04" + bytes(50)])
def test_no_weights_at_all(tmp_path, data):
    (tmp_path / "a.ckpt").write_bytes(data)
    with pytest.raises(CheckpointError, match="cannot be read as plain weights"):
        load_checkpoint(tmp_path / "a.ckpt")


def test_a_file_that_shrinks_while_it_is_read(tmp_path):
    """Mapped into memory it ended the process by SIGBUS."""
    network, options = small("unet")
    path = tmp_path / "a.safetensors"
    save_network(path, network, "unet", options)
    header = read_header(path)
    tensors = read_tensors(path, header)
    next(tensors)
    os.truncate(path, path.stat().st_size // 2)
    with pytest.raises(CheckpointError, match=r"`.*a\.safetensors` .* ends before its last tensor"):
        dict(tensors)

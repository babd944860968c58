"""Folders for the Hugging Face hub, by the hub's own parser of model cards."""

import json
import warnings

import pytest
import torch
from safetensors.torch import load_file

import mwdn
from mwdn.bridges import from_pretrained, save_pretrained
from mwdn.errors import CheckpointError, ParameterError
from mwdn.optics import sample_camera
from mwdn.weights import save_network


@pytest.fixture
def checkpoint(tmp_path):
    metadata = {"recipe": {"schedule": {"steps": 3}}, "psf_hash": "0123456789abcdef", "step": 3, "psnr": 24.5}
    network = mwdn.build("mwdn", width=2)
    save_network(tmp_path / "best.safetensors", network, "mwdn", {"width": 2}, **metadata)
    return tmp_path / "best.safetensors"


def test_a_network_returns_with_the_same_weights(checkpoint, tmp_path):
    folder = save_pretrained(checkpoint, tmp_path / "lensless")
    assert {path.name for path in folder.iterdir()} == {"config.json", "model.safetensors", "README.md"}
    config = json.loads((folder / "config.json").read_text())
    assert (config["model_type"], config["options"], config["psf_hash"]) == ("mwdn", {"width": 2}, "0123456789abcdef")
    expected, found = mwdn.load_network(checkpoint).state_dict(), from_pretrained(folder).state_dict()
    assert expected.keys() == found.keys()
    assert all(torch.equal(expected[key], found[key]) for key in expected)


def test_folders_of_the_author_are_not_published(tmp_path):
    """The paths of photographs and pairs, with the name of the user, were in all three files."""
    paths = {
        "photos": "/home/lovelace/secret/photos",
        "psf": r"C:\Users\lovelace\psf.png",
        "pairs": ["~/lovelace/pairs.h5"],
    }
    network = mwdn.build("mwdn", width=2).half()
    metadata = {"recipe": {"data": {**paths, "kind": "centre/128"}, "steps": 3}}
    save_network(tmp_path / "best.safetensors", network, "mwdn", {"width": 2}, **metadata)
    folder = save_pretrained(tmp_path / "best.safetensors", tmp_path / "lensless")
    assert not any(b"lovelace" in file.read_bytes() for file in folder.iterdir())
    data = json.loads((folder / "config.json").read_text())["recipe"]["data"]
    assert data == {"photos": "photos", "psf": "psf.png", "pairs": ["pairs.h5"], "kind": "centre/128"}
    before, after = (load_file(file) for file in (tmp_path / "best.safetensors", folder / "model.safetensors"))
    torch.testing.assert_close(after, before, rtol=0, atol=0)
    with warnings.catch_warnings(action="error"):
        save_pretrained(folder / "model.safetensors", folder, license="mit")


@pytest.mark.parametrize("is_run", [False, True])
def test_the_folder_is_a_method(checkpoint, tmp_path, is_run):
    """That of `save_pretrained`, or of a training run."""
    calibration = mwdn.Calibration(sample_camera(3, (32, 32)).expand(1, 3, -1, -1))
    measurement = torch.rand(1, 3, 32, 32)
    folder = checkpoint.parent if is_run else save_pretrained(checkpoint, tmp_path / "lensless")
    reconstruct = mwdn.Reconstructor(folder, calibration, device="cpu")
    assert "0123456789abcdef" in reconstruct.warning
    expected = mwdn.Reconstructor(checkpoint, calibration, device="cpu")(measurement)
    torch.testing.assert_close(reconstruct(measurement), expected)


def test_the_hub_reads_the_card(checkpoint, tmp_path):
    ModelCard = pytest.importorskip("huggingface_hub").ModelCard
    folder = save_pretrained(checkpoint, tmp_path / "lensless", license="mit")
    card = ModelCard.load(folder / "README.md")
    assert card.data.to_dict() == {
        "library_name": "mwdn",
        "license": "mit",
        "pipeline_tag": "image-to-image",
        "tags": ["lensless-imaging", "computational-imaging", "deconvolution", "image-reconstruction"],
    }
    assert card.text.strip().startswith("# lensless")
    assert "24.50 dB" in card.text
    assert '"steps": 3' in card.text


def test_an_edited_card_stays(checkpoint, tmp_path):
    folder = save_pretrained(checkpoint, tmp_path / "lensless")
    (folder / "README.md").write_text("mine")
    with pytest.warns(UserWarning, match="differs from what mwdn wrote, and stays"):
        save_pretrained(checkpoint, folder)
    assert (folder / "README.md").read_text() == "mine"


def test_a_card_that_was_not_edited_is_that_of_the_new_weights(checkpoint, tmp_path):
    folder = save_pretrained("universal-small", tmp_path / "lensless", license="mit")
    for license, stated in ((None, "mit"), ("apache-2.0", "apache-2.0")):
        save_pretrained(checkpoint, folder, license=license)
        text = (folder / "README.md").read_text()
        assert ("24.50 dB" in text, f'license: "{stated}"' in text, "universal" in text) == (True, True, False)


def test_files_of_others_stay(checkpoint, tmp_path):
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "config.json").write_text('{"model_type": "bert"}')
    with pytest.raises(ParameterError, match=r"config\.json"):
        save_pretrained(checkpoint, tmp_path / "other")
    assert [path.name for path in (tmp_path / "other").iterdir()] == ["config.json"]


def test_a_config_of_another_network_is_refused(checkpoint, tmp_path):
    folder = save_pretrained(checkpoint, tmp_path / "lensless")
    config = json.loads((folder / "config.json").read_text())
    (folder / "config.json").write_text(json.dumps(config | {"options": {"width": 3}}))
    with pytest.raises(CheckpointError, match="`options`"):
        from_pretrained(folder)
    (folder / "config.json").unlink()
    with pytest.raises(ParameterError, match=r"config\.json"):
        from_pretrained(folder)


def test_what_is_no_folder_is_a_name_on_the_hub(tmp_path):
    with pytest.raises(CheckpointError, match="`nothing` is no folder, and no `owner/name`"):
        from_pretrained("nothing")

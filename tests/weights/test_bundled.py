"""Bundled networks, and networks of a hub, here a file server on this machine."""

import hashlib
import json
import runpy
import subprocess
import sys
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib.resources import files
from pathlib import Path

import pytest
import torch

from mwdn.errors import CheckpointError
from mwdn.networks import build
from mwdn.weights.bundled import BUNDLED, bundle, find_weights
from mwdn.weights.checkpoint import load_checkpoint, read_metadata, save_network

CARD = files("mwdn") / "weights" / "README.md"


@pytest.mark.parametrize(("name", "most"), list(zip(BUNDLED, (5e6, 2e6), strict=True)))
def test_bundled_networks_are_intact_and_for_any_camera(name, most):
    path = find_weights(name)
    assert hashlib.sha256(path.read_bytes()).hexdigest() in CARD.read_text(encoding="utf-8")
    network, header = load_checkpoint(path), read_metadata(path)
    assert header["psf_hash"] is None
    assert header["recipe"]["cameras"]["sizes"]
    assert sum(parameter.numel() for parameter in network.parameters()) < most
    assert {parameter.dtype for parameter in network.parameters()} == {torch.float32}


def test_bundled_networks_are_small():
    assert sum(find_weights(name).stat().st_size for name in BUNDLED) < 14e6


def test_bundling_rounds_and_remembers(tmp_path):
    network = build("wiener-bank", width=2)
    save_network(tmp_path / "a.safetensors", network, "wiener-bank", {"width": 2}, recipe={"steps": 5})
    bundle(tmp_path / "a.safetensors", tmp_path / "b.safetensors")
    assert (tmp_path / "b.safetensors").stat().st_size < 0.7 * (tmp_path / "a.safetensors").stat().st_size
    assert read_metadata(tmp_path / "b.safetensors") == read_metadata(tmp_path / "a.safetensors")
    for one, other in zip(network.parameters(), load_checkpoint(tmp_path / "b.safetensors").parameters(), strict=True):
        torch.testing.assert_close(one, other, rtol=1e-3, atol=1e-6)
    with torch.no_grad():
        next(network.parameters()).fill_(1e6)
    save_network(tmp_path / "a.safetensors", network, "wiener-bank", {"width": 2})
    with pytest.raises(CheckpointError, match="range of float16"):
        bundle(tmp_path / "a.safetensors", tmp_path / "c.safetensors")
    assert not (tmp_path / "c.safetensors").exists()


def test_bundling_with_another_denoiser(tmp_path):
    """For example one trained on a user's own kind of scenes."""
    whole, denoiser, other, out = (tmp_path / f"{name}.safetensors" for name in ("whole", "denoiser", "other", "out"))
    networks = {}
    for path, name, options in (
        (whole, "wiener-bank", {"width": 2, "rounds": 1}),
        (denoiser, "drunet", {}),
        (other, "unet", {"width": 2}),
    ):
        networks[path] = build(name, **options)
        save_network(path, networks[path], name, options)
    for network, part in ((whole, other), (other, denoiser)):
        with pytest.raises(CheckpointError, match=f"{network.name}` has no denoiser .*{part.name}`"):
            bundle(network, out, part)
    assert not out.exists()
    bundle(whole, out, denoiser)
    bundled = load_checkpoint(out)
    for module, expected in ((bundled.denoiser, networks[denoiser]), (bundled.encoder, networks[whole].encoder)):
        for one, another in zip(module.parameters(), expected.parameters(), strict=True):
            torch.testing.assert_close(one, another, rtol=1e-3, atol=1e-6)


def test_bundling_with_a_denoiser_that_is_told_less(tmp_path):
    """`universal`'s own denoiser is also told what contradicts the PSF; the new one ignores it."""
    whole, denoiser = build("wiener-bank", width=2, rounds=1, evidence=True), build("drunet")
    save_network(tmp_path / "a.safetensors", whole, "wiener-bank", {"width": 2, "rounds": 1, "evidence": True})
    save_network(tmp_path / "b.safetensors", denoiser, "drunet", {})
    bundle(tmp_path / "a.safetensors", tmp_path / "c.safetensors", tmp_path / "b.safetensors")
    head = load_checkpoint(tmp_path / "c.safetensors").denoiser.head.weight
    torch.testing.assert_close(head[:, :16], denoiser.head.weight, rtol=1e-3, atol=1e-6)
    assert not head[:, 16:].any()


@pytest.mark.parametrize(("line", "message"), [("", "are required: checkpoint"), ("no.tar a.safetensors", "`no.tar`")])
def test_bundling_by_a_wrong_call_is_one_message(capsys, monkeypatch, line, message):
    """Both ended in a traceback."""
    monkeypatch.setattr("sys.argv", ["", *line.split()])
    with pytest.raises(SystemExit, match="2"):
        runpy.run_module("mwdn.weights", run_name="__main__")
    assert message in capsys.readouterr().err


def test_other_names_are_no_bundled_networks():
    assert find_weights("admm") is None
    with pytest.raises(CheckpointError, match="must be hub:owner/name"):
        find_weights("hub:alone")


FETCH = """
import sys
from mwdn.errors import CheckpointError
from mwdn.weights.bundled import find_weights
for name in sys.argv[1:]:
    try:
        print(find_weights(name))
    except CheckpointError as error:
        print(error)
"""


@pytest.fixture
def hub(tmp_path):
    """``hub(*names)`` gives paths or messages, and the names that a server of one file sent by `huggingface_hub`."""
    pytest.importorskip("huggingface_hub", reason="needs `pip install 'mwdn[hub]'`")
    content, sent = find_weights("universal-small").read_bytes(), []

    class Files(BaseHTTPRequestHandler):
        def do_HEAD(self):
            exists = self.path == "/some/camera/resolve/main/model.safetensors"
            self.send_response(200 if exists else 404)
            self.send_header("Content-Length", str(len(content) if exists else 0))
            self.send_header("ETag", '"1234"')
            self.send_header("X-Repo-Commit", "0" * 40)
            if not exists:
                self.send_header("X-Error-Code", "EntryNotFound")
            self.end_headers()

        def do_GET(self):
            self.do_HEAD()
            sent.append(self.path)
            self.wfile.write(content)

        def log_message(self, *_):
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), Files)
    threading.Thread(target=server.serve_forever, daemon=True).start()

    def fetch(*names):
        environment = {
            "HF_ENDPOINT": f"http://127.0.0.1:{server.server_port}",
            "HF_HOME": str(tmp_path / "cache"),
            "HF_HUB_DISABLE_TELEMETRY": "1",
            "HF_HUB_DISABLE_XET": "1",
            "PATH": "/usr/bin:/bin",
            "PYTHONPATH": json.dumps(sys.path)[1:-1].replace('", "', ":").strip('"'),
        }
        line = [sys.executable, "-c", FETCH, *names]
        done = subprocess.run(line, env=environment, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
        return done.stdout.splitlines(), sent

    yield fetch
    server.shutdown()
    server.server_close()


def test_a_network_of_the_hub_is_downloaded_once_and_the_error_names_what_is_not_there(hub):
    said, sent = hub("hub:some/camera", "hub:some/camera", "hub:some/camera/other.safetensors", "hub:some/camera/../a")
    assert sent == ["/some/camera/resolve/main/model.safetensors"]
    assert said[0] == said[1]
    assert Path(said[0]).read_bytes() == find_weights("universal-small").read_bytes()
    assert "`hub:some/camera/other.safetensors` cannot be fetched" in said[2]
    assert "`hub:some/camera/../a` cannot be fetched" in said[3]

"""Training with two processes: equal to one up to rounding, and exact after any interruption."""

import json
import os
import random
import select
import signal
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from safetensors.torch import load_file
from two_processes import double_precision, train_precisely

from cameras import contour_psf
from mwdn.calibration import Calibration
from mwdn.errors import ParameterError
from mwdn.networks import build
from mwdn.runtime import distributed
from mwdn.training.batch_norm import freeze_cancelled
from mwdn.training.experiment import prepare
from mwdn.training.recipe import read_recipe
from runs import log, same

STEPS = 8
# 3 samples for two processes: one has one, the other two. At this rate, with small first steps and without the
# pyramid's iterations, rounding does not grow into another path: no pool takes its maximum from another pixel.
RECIPE = f"""
[network]
name = "wiener-bank"
width = 4
fold = 1
finest = 0
[schedule]
steps = {STEPS}
batch = 3
learning_rate = 1e-4
warmup = 8
validate_every = 4
validation = 3
bfloat16 = false
"""
CPSF = """
network = { name = "mwdn-cpsf", width = 4 }
schedule = { steps = 4, batch = 5, lr_schedule = "plateau", validate_every = 2, validation = 3, bfloat16 = false }
loss = { l1 = 0.5, mse = 1.0 }
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Two recipes, psf.npy and photos."""
    path = tmp_path_factory.mktemp("distributed")
    psf = contour_psf((32, 40), cell=10, generator=torch.Generator().manual_seed(3)).expand(1, 3, -1, -1)
    np.save(path / "psf.npy", (0.9 * psf / psf.max())[0].movedim(0, -1).numpy())
    (path / "photos").mkdir()
    for number in range(3):
        small = np.random.default_rng(number).integers(0, 256, (4, 4, 3), np.uint8)
        cv2.imwrite(str(path / f"photos/{number}.png"), cv2.resize(small, (24, 24), interpolation=cv2.INTER_CUBIC))
    (path / "r.toml").write_text(RECIPE, encoding="utf-8")
    (path / "cpsf.toml").write_text(CPSF, encoding="utf-8")
    return path


def start(folder, *line, **environment):
    """Start Python in the folder."""
    options = {"cwd": folder, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    here = {"PYTHONFAULTHANDLER": "1"} | ({"GLOO_SOCKET_IFNAME": "lo"} if sys.platform == "linux" else {})
    return subprocess.Popen(
        [sys.executable, *line], env={**os.environ, **here, "OMP_NUM_THREADS": "1", **environment}, **options
    )


def torchrun(folder, *line):
    """Start a command in two processes on one machine."""
    return start(folder, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2", *line)


def machines(folder, port, *line):
    """Start a command as one process on each of two machines, as torchrun does on each of them."""
    common = {"WORLD_SIZE": "2", "LOCAL_RANK": "0", "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(port)}
    return [start(folder, *line, **common, RANK=rank) for rank in "01"]


def training(out):
    line = "train r.toml --psf psf.npy --background 0 --photos photos --device cpu --out"
    return [*line.split(), out]


def finish(process):
    out, err = process.communicate(timeout=300)
    assert process.returncode == 0, err
    return out, err


def alone(folder, out):
    """The run with one process."""
    calibration = Calibration.from_file(folder / "psf.npy", background=0.0)
    return prepare(
        read_recipe(folder / "r.toml"), calibration, photos=folder / "photos", out=folder / out, device="cpu"
    )


@pytest.mark.parametrize(
    ("environment", "message"),
    [
        ({"WORLD_SIZE": "abc"}, r"`WORLD_SIZE` \(abc\) .*`unset WORLD_SIZE`"),
        ({"WORLD_SIZE": "2"}, r"`RANK` \(not set\) must be set"),
        ({"WORLD_SIZE": "2", "RANK": "0", "LOCAL_RANK": "x"}, r"`LOCAL_RANK` \(x\) must be set"),
        ({"WORLD_SIZE": "2", "RANK": "0", "LOCAL_RANK": "0"}, r"`MASTER_ADDR` \(not set\) must be set"),
    ],
)
def test_environment_without_torchrun(monkeypatch, environment, message):
    for name in ("WORLD_SIZE", "RANK", "LOCAL_RANK", "MASTER_ADDR", "MASTER_PORT"):
        monkeypatch.delenv(name, raising=False)
    for name, value in environment.items():
        monkeypatch.setenv(name, value)
    with pytest.raises(ParameterError, match=message), distributed.process_group():
        pass


@pytest.fixture(scope="module")
def one(folder):
    alone(folder, "one").run()
    return folder / "one"


@pytest.fixture(scope="module")
def worked(folder):
    """Folder with the results of `two_processes.py`, which begins with `mwdn train` into `two`."""
    stop = InterruptedError

    def after_four(report):
        if report.step == 5:
            raise stop

    with pytest.raises(stop):
        alone(folder, "mixed").run(after_four)
    out, err = finish(torchrun(folder, str(Path(__file__).with_name("two_processes.py")), *training("two")))
    assert out.split() == ["Weights", "in", "two/best.safetensors"]  # printed once
    assert err.count(f"step {STEPS}: validation") == 1
    return folder


@pytest.fixture(scope="module")
def two(worked):
    return worked / "two"


def assert_alike(found, expected):
    """Parameters moved from their initial values alike, within 1 %; BatchNorm's moments are equal up to rounding."""
    found, expected = load_file(found / "state.safetensors"), load_file(expected / "state.safetensors")
    assert found.keys() == expected.keys()
    torch.manual_seed(0)
    start = build("wiener-bank", width=4, fold=1, finest=0)
    names = [name for name, _ in start.named_parameters()]
    moved = torch.cat([(expected[f"network.{n}"] - start.state_dict()[n]).flatten() for n in names])
    apart = torch.cat([(expected[f"network.{n}"] - found[f"network.{n}"]).flatten() for n in names])
    assert moved.abs().max() > 3e-4
    assert apart.norm() < 0.01 * moved.norm()
    for key in expected:
        if "running" in key:
            torch.testing.assert_close(found[key], expected[key], rtol=1e-3, atol=1e-4)


# --- Results --------------------------------------------------------------------------------------------


def test_two_processes_end_as_one(one, two):
    assert_alike(two, one)
    logs = log(one), log(two)
    assert [line["step"] for line in logs[1]] == list(range(1, STEPS + 1))
    for alone, together in zip(*logs, strict=True):
        assert together["loss"] == pytest.approx(alone["loss"], rel=1e-3)
        assert together["psnr"] == pytest.approx(alone["psnr"], abs=1e-2)
    assert logs[1][0]["loss"] == pytest.approx(logs[0][0]["loss"], rel=1e-6)
    assert sorted(path.name for path in two.iterdir()) == sorted(path.name for path in one.iterdir())


@pytest.mark.acceptance
@pytest.mark.usefixtures("unchecked")
def test_two_processes_end_as_one_in_float64(worked, monkeypatch):
    """The difference vanishes. `mwdn-cpsf` also encodes the PSF, of which each process has the whole batch."""
    monkeypatch.chdir(worked)
    with double_precision():
        train_precisely("double/one").run()
    states = [load_file(worked / "double" / name / "state.safetensors") for name in ("one", "two")]
    assert states[0].keys() == states[1].keys()
    assert states[0]["network.decoder.head.weight"].dtype == torch.float64
    for key, value in states[0].items():
        torch.testing.assert_close(states[1][key], value, rtol=1e-5, atol=1e-8, msg=lambda m, k=key: f"{k}: {m}")


def test_both_processes_have_the_lr_schedule_of_the_first(worked):
    """Only the first process validates."""
    schedules = [json.loads((worked / f"lr_schedule-{rank}.json").read_text()) for rank in (0, 1)]
    assert schedules[0] == schedules[1]
    losses = [line["validation_loss"] for line in log(worked / "double" / "two")]
    assert schedules[0]["best"] == min(loss for loss in losses if loss is not None)


def test_run_of_one_process_resumes_with_two(one, worked):
    assert_alike(worked / "mixed", one)
    assert [line["step"] for line in log(worked / "mixed")] == list(range(1, STEPS + 1))
    assert log(worked / "mixed")[:4] == log(one)[:4]  # not begun again


def test_bias_before_batch_norm_is_not_learned(one):
    """Its gradient is rounding noise, which Adam would turn into full steps."""
    torch.manual_seed(0)
    network = build("wiener-bank", width=4, fold=1, finest=0)
    freeze_cancelled(network)
    frozen = [name for name, parameter in network.named_parameters() if not parameter.requires_grad]
    assert len(frozen) == 18  # two in each of five and four scales
    assert all(name.endswith((".0.bias", ".3.bias")) for name in frozen)
    state = load_file(one / "state.safetensors")
    for name, parameter in network.named_parameters():
        assert torch.equal(state[f"network.{name}"], parameter) == (name in frozen)


def test_gradient_of_a_bias_before_batch_norm_is_zero(generator):
    """In float64 it vanishes."""
    network = build("mwdn", width=2).double()
    freeze_cancelled(network)
    frozen = {name for name, parameter in network.named_parameters() if not parameter.requires_grad}
    network.requires_grad_(True)
    picture = torch.rand(1, 3, 32, 32, generator=generator).double()
    network.encoder(picture)[-1].square().sum().backward()
    gradients = {name: p.grad.abs().max() for name, p in network.encoder.named_parameters()}
    for name, value in gradients.items():
        assert (value < 1e-9) == (f"encoder.{name}" in frozen)


# --- BatchNorm over all processes -----------------------------------------------------------------------


@pytest.mark.parametrize(("dtype", "tolerance"), [("float64", 1e-10), ("float32", 2e-4)])
@pytest.mark.parametrize("rank", [0, 1])
def test_batch_norm_over_two_processes(worked, rank, dtype, tolerance):
    """Output, gradients and running moments after two steps equal those of torch's layer for the whole batch."""
    found = load_file(worked / f"{dtype}-{rank}.safetensors")
    for key in ("y", "x.grad", "w.grad", "b.grad", "mean", "var", "count", "eval"):
        torch.testing.assert_close(found[f"two.{key}"], found[f"one.{key}"], rtol=tolerance, atol=tolerance)
    assert found["two.count"] == 2


# --- Interruptions --------------------------------------------------------------------------------------


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux ends a process with its parent")
@pytest.mark.acceptance
def test_killed_run_goes_on_with_two_machines_and_ends_as_an_unbroken_one(folder, two, free_port):
    """SIGKILL of torchrun only, after some steps: its processes end with it, and the next run resumes.

    The next one has a process on each of two machines, which share the folder.
    """
    process, path = torchrun(folder, "-m", "mwdn", *training("killed")), folder / "killed" / "log.jsonl"
    goal = random.randint(2, STEPS // 2)  # the rest is the time in which this process must see it
    while process.poll() is None and not (path.exists() and path.read_bytes().count(b"\n") >= goal):
        with pytest.raises(subprocess.TimeoutExpired):
            process.wait(0.02)
    children = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()
    handles = [os.pidfd_open(int(child)) for child in children]
    process.send_signal(signal.SIGKILL)
    process.communicate(timeout=60)  # the pipes close when the last of them has ended
    assert process.returncode == -signal.SIGKILL
    assert len(handles) == 2
    for handle in handles:
        assert select.select([handle], [], [], 60)[0] == [handle]
        os.close(handle)
    assert len(log(folder / "killed")) < STEPS
    said = [finish(machine) for machine in machines(folder, free_port, "-m", "mwdn", *training("killed"))]
    assert [out.split() for out, _ in said] == [["Weights", "in", "killed/best.safetensors"], []]
    for name in ("best", "last", "state"):
        assert same(folder / "killed" / f"{name}.safetensors", two / f"{name}.safetensors")
    assert log(folder / "killed") == log(two)


# --- Errors ---------------------------------------------------------------------------------------------


def test_errors_of_two_processes(worked):
    first, second = ((worked / f"said-{rank}.txt").read_text().splitlines() for rank in (0, 1))
    assert first[0] == second[0]
    assert first[0].startswith("ParameterError: `batch` (1) must be at least the number of processes (2)")
    assert first[1] == second[1]
    assert first[1].startswith("ParameterError: `device` (cuda:0) must be `cuda`")
    assert first[2] == second[2]
    assert first[2].startswith("DivergenceError: The loss of step 0 (samples 0 to 2) is not finite.")
    assert second[3].startswith("ParameterError: Process 1 must have the same recipe and PSF as process 0.")
    assert first[3].startswith("ProcessError: Process 0 of 2 lost the others: ")
    assert first[3].endswith("The same command resumes from the last saved state.")
    assert len(first) == len(second) == 4


@pytest.mark.parametrize("count", [2, 3, 4, 7])
def test_shares_are_the_batch(monkeypatch, count):
    monkeypatch.setattr(distributed, "world_size", lambda: count)
    parts = []
    for rank in range(count):
        monkeypatch.setattr(distributed, "rank", lambda rank=rank: rank)
        parts.append(distributed.shard(range(100, 107)))
    assert [number for part in parts for number in part] == list(range(100, 107))
    assert max(map(len, parts)) - min(map(len, parts)) <= 1

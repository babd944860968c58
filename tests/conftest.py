"""Shape checking of every annotated function, fixtures and small objects that many tests share."""

import gc
import os
import random
import signal
import socket
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path

import jaxtyping
import pytest

import shape_checks

# Where other work shares the machine, threads that wait by spinning take the core from the one they wait for:
# the small arrays of a solver then need 200 times as long. Read once, when torch starts.
os.environ.setdefault("OMP_WAIT_POLICY", "passive")

# A shell starts background jobs with Ctrl-C ignored, and so would every test of an interrupted run be.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

# A million objects live from the imports to the end. The collector would look through all of them, again and again.
gc.disable()

# Before anything imports mwdn: from here on calls check the shapes and types in their signatures.
shape_checks.install("mwdn")

import torch  # noqa: E402

torch.set_num_threads(1 if "PYTEST_XDIST_WORKER" in os.environ else 2)

ROOT = Path(__file__).resolve().parents[1]


def pytest_collection_finish() -> None:
    """From here on the garbage collector runs, but not over what is there already."""
    gc.freeze()
    gc.enable()


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup() -> None:
    """In each test the first calls of each function are checked."""
    shape_checks.start_again()


@pytest.fixture(autouse=True)
def _seed() -> None:
    """Seed of the global generator: initial weights."""
    torch.manual_seed(0)


@pytest.fixture
def generator() -> torch.Generator:
    """Source of a test's own random numbers."""
    return torch.Generator().manual_seed(20230731)


@pytest.fixture
def free_port() -> int:
    """A TCP port that is free now, below those that systems give to outgoing connections (32,768 on Linux).

    One of these could be taken by another test until the process that gets it, seconds later, listens.
    """
    while True:
        port = random.SystemRandom().randrange(20_000, 32_000)
        with socket.socket() as listener, suppress(OSError):
            listener.bind(("127.0.0.1", port))
            return port


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str]) -> Callable[..., tuple[int, str, str]]:
    """``run("demo", "--out", path)`` or ``run("demo --out x")`` gives exit code, standard output, standard error."""
    from mwdn.cli.app import main

    def call(*words: object) -> tuple[int, str, str]:
        line = str(words[0]).split() if len(words) == 1 else [str(word) for word in words]
        with pytest.raises(SystemExit) as caught:
            main(line)
        return (caught.value.code or 0, *capsys.readouterr())

    return call


@pytest.fixture
def unchecked() -> Iterator[None]:
    """Switch the import hook's checks off, as for users: mwdn itself must catch their mistakes."""
    jaxtyping.config.update("jaxtyping_disable", True)
    yield
    jaxtyping.config.update("jaxtyping_disable", False)


@pytest.fixture(scope="session")
def data() -> Path:
    """Folder of the real captures: ``MWDN_DATA``, or ``../shared/data`` beside the repository."""
    variable = os.environ.get("MWDN_DATA")
    folder = Path(variable) if variable else ROOT.parent / "shared" / "data"
    if not folder.is_dir():
        pytest.skip(f"No real captures: {folder} is not a folder. Set MWDN_DATA to where they are.")
    return folder


@pytest.fixture
def lpips_files(data: Path) -> dict[str, Path]:
    """Public weights of AlexNet and of the heads of LPIPS."""
    folder = data / "lpips"
    return {"alexnet": folder / "alexnet_features_torchvision.pth", "heads": folder / "lin_v0.1_alex.pth"}


@pytest.fixture
def noisy_pair(generator: torch.Generator) -> tuple[torch.Tensor, torch.Tensor]:
    """Two smooth pictures with noise of two strengths, and the same without noise."""
    coarse = torch.rand(2, 3, 8, 8, generator=generator)
    scene = torch.nn.functional.interpolate(coarse, (48, 57), mode="bicubic")
    noise = torch.randn(scene.shape, generator=generator) * torch.tensor([0.02, 0.2]).view(2, 1, 1, 1)
    return (scene + noise).clamp(0, 1), scene.clamp(0, 1)

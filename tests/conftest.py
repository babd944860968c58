"""Shape checking of every annotated function, reproducible noise, and the way to the real captures."""

import os
import socket
from collections.abc import Iterator
from pathlib import Path

import jaxtyping
import pytest

# Where other work shares the machine, threads that wait by spinning take the core from the one they wait for:
# the small arrays of a solver then need 200 times as long. Read once, when torch starts.
os.environ.setdefault("OMP_WAIT_POLICY", "passive")

# Before anything imports mwdn: from here on each call checks the shapes and types in its signature.
jaxtyping.install_import_hook("mwdn", "beartype.beartype")

import torch  # noqa: E402

torch.set_num_threads(1 if "PYTEST_XDIST_WORKER" in os.environ else 2)

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture(autouse=True)
def _seed() -> None:
    """Initial weights and anything else that draws from the global generator."""
    torch.manual_seed(0)


@pytest.fixture
def generator() -> torch.Generator:
    """Source of all random numbers that a test asks for itself."""
    return torch.Generator().manual_seed(20230731)


@pytest.fixture
def free_port() -> int:
    """Where nothing listens, for what must be told a port beforehand."""
    with socket.socket() as found:
        found.bind(("127.0.0.1", 0))
        return found.getsockname()[1]


@pytest.fixture
def unchecked() -> Iterator[None]:
    """Without the import hook's checks, as users run it: what they would catch, mwdn must catch itself."""
    jaxtyping.config.update("jaxtyping_disable", True)
    yield
    jaxtyping.config.update("jaxtyping_disable", False)


@pytest.fixture(scope="session")
def data() -> Path:
    """Folder of the real captures: ``MWDN_DATA``, or ``../shared/data`` beside the repository."""
    named = os.environ.get("MWDN_DATA")
    folder = Path(named) if named else ROOT.parent / "shared" / "data"
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

"""A GPU computes the same as the processor; skipped without a GPU.

python -m pytest -n 0 tests/test_gpu.py
"""

from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch

from cameras import contour_psf
from mwdn import Calibration, Camera, Reconstructor, solvers
from mwdn.data.mismatch import REAL_OPTIONS, Mismatch
from mwdn.data.pairs import PairFile
from mwdn.data.photographs import Photographs
from mwdn.data.recorded import RecordedPairs, record
from mwdn.data.simulated import SimulatedPairs
from mwdn.inference.batch import Batch
from mwdn.networks import build
from mwdn.runtime.transfers import to_device, to_host
from mwdn.training.recipe import Recipe, Schedule
from mwdn.training.tasks import supervised_task
from mwdn.training.trainer import Trainer

pytestmark = pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU here")

SIZE = 96, 128
NETWORKS = "mwdn", "mwdn-cpsf", "unet", "flatnet", "ifin"
TRAINED = (
    {"name": "wiener-bank", "width": 4, "regularisations": (1e-2, 1e-4)},
    {"name": "mwdn-cpsf", "width": 8},
    {"name": "le-admm-u", "width": 4},
    {"name": "mmcn", "width": 4},
    {"name": "updn", "width": 2},
    {"name": "flatnet", "width": 8, "size": SIZE},
    {"name": "svdeconv", "width": 8, "size": SIZE},
    {"name": "ifin", "width": 8},
)
CPU, GPU = torch.device("cpu"), torch.device("cuda", 0)


@pytest.fixture
def calibration(generator):
    return Calibration(contour_psf(SIZE, cell=10, generator=generator).expand(1, 3, -1, -1).contiguous())


@pytest.fixture
def batches(calibration, generator):
    """Four, of two captures each."""
    scenes = torch.rand(4, 2, 3, *SIZE, generator=generator) * torch.rand(4, 2, 3, 1, 1, generator=generator)
    return [Camera(calibration.psf).simulate(some, generator=generator) for some in scenes]


@pytest.fixture
def photographs(tmp_path):
    drawn = np.random.default_rng(2)
    (tmp_path / "photos").mkdir()
    for number in range(3):
        smooth = cv2.resize(drawn.integers(0, 256, (4, 4, 3), np.uint8), (24, 24), interpolation=cv2.INTER_CUBIC)
        cv2.imwrite(str(tmp_path / "photos" / f"{number}.png"), smooth)
    return Photographs(tmp_path / "photos", side=24)


def psnr(result, expected):
    return -10 * ((result - expected).square().mean() / expected.abs().max().square()).log10().item()


@pytest.mark.parametrize("shape", [(1,), (2, 3, 5, 7), (4, 3, 1000, 1200)])
def test_there_and_back(shape, generator):
    """Also while the GPU is busy, and where either end's memory is used again at once."""
    first, second = torch.rand(2, *shape, generator=generator)
    busy = torch.rand(4000, 4000, device=GPU)
    for _ in range(5):
        busy = busy @ busy
    expected = first.clone()
    there = to_device(first, GPU)
    first.zero_()
    doubled = to_device(second, GPU) * 2
    back = to_host(there)
    there.zero_()
    torch.testing.assert_close(back, expected, rtol=0, atol=0)
    torch.testing.assert_close(to_host(doubled), 2 * second, rtol=0, atol=0)
    assert there.device == GPU
    assert not back.is_pinned()


@pytest.mark.parametrize("precision", ["exact", "fast"])
@pytest.mark.parametrize("method", [*NETWORKS, "universal", "universal-small", *solvers.SOLVERS])
def test_reconstructions(method, precision, calibration, batches):
    """Of each shape, the first batch is computed, the second recorded as a CUDA graph, the others replayed."""
    if method in NETWORKS:
        method = build(method, width=8).eval()
    here = Reconstructor(method, calibration, device=CPU, precision="exact")
    there = Reconstructor(method, calibration, device=GPU, precision=precision)
    for batch in batches:
        assert psnr(there(batch), here(batch)) > (60 if precision == "exact" else 40)


@pytest.mark.parametrize("mismatch", [Mismatch(), Mismatch(**dict.fromkeys(REAL_OPTIONS, 0.02))])
def test_samples(calibration, photographs, mismatch):
    """The same scenes and PSFs; the noise differs, as each device has its own generator."""
    here, there = (
        SimulatedPairs(photographs.to(device), calibration.psf.to(device), mismatch=mismatch).batch(range(4))
        for device in (CPU, GPU)
    )
    torch.testing.assert_close(there.scene.cpu(), here.scene, rtol=1e-3, atol=1e-3)
    assert psnr(there.measurement.cpu(), here.measurement) > 20


@pytest.mark.parametrize("network", TRAINED, ids=lambda network: network["name"])
def test_training(network, calibration, photographs, tmp_path, monkeypatch):
    """Steps with recorded pairs in float32, replayed as a CUDA graph, have the losses that they have here.

    In bfloat16 nearly.
    """
    monkeypatch.setattr(torch.backends.cudnn, "allow_tf32", False)
    record(tmp_path / "pairs.h5", [(SimulatedPairs(photographs, calibration.psf), range(8))], calibration.psf)
    recipe = Recipe(
        network,
        Schedule(steps=4, batch=2, learning_rate=2e-3, warmup=2, validate_every=2, validation=2),
    )

    def losses(device, folder, *, bfloat16):
        changed = replace(recipe, schedule=replace(recipe.schedule, bfloat16=bfloat16))
        pairs = RecordedPairs(PairFile(tmp_path / "pairs.h5"), range(8), calibration.psf.to(device))
        task, values = supervised_task(pairs, changed.schedule), []
        trainer = Trainer(changed, task, out=tmp_path / folder, calibration=calibration, device=device)
        trainer.run(lambda report: values.append(report.loss))
        assert all(graph.graph is not None for graph, _ in trainer.gradient.graphs.values())
        assert len(trainer.gradient.graphs) == (device == GPU)
        return values

    expected = losses(CPU, "here", bfloat16=False)
    assert losses(GPU, "there", bfloat16=False) == pytest.approx(expected, rel=0.02)
    assert losses(GPU, "half", bfloat16=True) == pytest.approx(expected, rel=0.2)


def test_a_folder(calibration, batches, tmp_path):
    """Read, checked and written by threads of their own, which share the GPU."""
    captures = []
    for number, measurement in enumerate(torch.cat(batches)):
        captures.append(tmp_path / f"{number}.tif")
        cv2.imwrite(str(captures[-1]), (measurement.clamp(0, 1) * 65535).movedim(0, -1).numpy().astype(np.uint16))
    jobs = {}
    for device in (CPU, GPU):
        reconstruct = Reconstructor("universal-small", calibration, device=device, precision="exact")
        jobs[device] = list(Batch(reconstruct, "name", tmp_path / device.type, "npy").run(captures))
    for here, there in zip(jobs[CPU], jobs[GPU], strict=True):
        assert there.error is None
        assert there.trust.consistency.explained == pytest.approx(here.trust.consistency.explained, rel=1e-3)
        pictures = (torch.from_numpy(np.load(job.output)) for job in (there, here))
        assert psnr(*pictures) > 60

import pytest

from mwdn.calibration import Calibration
from mwdn.data.random import seeded
from mwdn.optics import Camera, sample_camera
from mwdn.preview.cameras import StoredCameras
from preview_server import LIMITS, SIDE, npy

pytest.importorskip("uvicorn", reason="needs the extra `page`")
httpx = pytest.importorskip("httpx2", reason="needs httpx2")


@pytest.fixture(scope="session")
def psf():
    return sample_camera(0, (SIDE, SIDE), family="contours")


@pytest.fixture(scope="session")
def psf_file(psf):
    return npy((psf[0].movedim(0, -1) / psf.max() * 60_000).numpy().astype("uint16"))


@pytest.fixture(scope="session")
def scene(psf):
    import torch

    scene = torch.zeros(1, 3, SIDE, SIDE)
    scene[..., 10:20, 30:40] = 0.8
    return scene


@pytest.fixture(scope="session")
def capture(psf, scene):
    measurement = Camera(psf).simulate(scene, generator=seeded(1))
    return npy((measurement.clamp(0, 1) * 60_000)[0].movedim(0, -1).numpy().astype("uint16"))


@pytest.fixture(scope="session")
def serve():
    """``serve(...)`` gives a running server; all are stopped at the end."""
    from mwdn.preview.server import make_server

    servers = []

    def start(cameras=None, limits=LIMITS, **options):
        server = make_server(cameras or StoredCameras(limits), limits, device="cpu", **options)
        server.start()
        servers.append(server)
        return server

    yield start
    for server in servers:
        server.stop()


@pytest.fixture(scope="module")
def client(serve, psf):
    server = serve(StoredCameras(LIMITS, None, {"camera": Calibration(psf)}))
    with httpx.Client(base_url=server.url, timeout=120) as client:
        yield client

"""Results on real captures are those that were recorded in November 2026: a change of any method shows here."""

from pathlib import Path

import pytest
import torch

from mwdn import Calibration, Reconstructor, read_frame
from mwdn.calibration import FrameFormat
from mwdn.solvers import SOLVERS
from mwdn.weights.bundled import BUNDLED

pytestmark = pytest.mark.acceptance

# PSF, capture, format of the frames, background of the PSF.
CAMERAS = {
    "mwdn": ("mwdn-camera/psf_320.png", "mwdn-camera/real-objects/object_0.png", FrameFormat(), "estimate"),
    "diffusercam": (
        "diffusercam/psf_recovered_270x480.npy",
        "diffusercam/diffuser_images/im10.npy",
        FrameFormat(upside_down=True, bgr=True),
        0.0,
    ),
}

# Root mean square, mean absolute difference of horizontal neighbours (detail and noise), mean of each quarter.
RECORDED = """
admm            mwdn        1.44589 0.02692626 0.324431 0.292643 0.707842 0.617391
admm            diffusercam 0.2218837 0.005917798 0.150171 0.114205 0.22831 0.189785
fista           mwdn        1.227476 0.02926601 0.284824 0.233129 0.782442 0.688094
fista           diffusercam 0.2230823 0.01892217 0.150106 0.118242 0.229128 0.189599
pyramid         mwdn        1.426346 0.04004895 0.293693 0.2824259 0.7149122 0.6670623
pyramid         diffusercam 0.2272897 0.01476565 0.1531849 0.1191129 0.2262114 0.1875513
wiener          mwdn        1.295445 0.02621401 0.503396 0.396707 0.989653 0.784999
wiener          diffusercam 0.2312952 0.003411995 0.196999 0.162456 0.198107 0.162022
universal       mwdn        1.496284 0.03892548 0.2453881 0.1864853 0.7750986 0.5122766
universal       diffusercam 0.229117 0.0190799 0.1535369 0.1194226 0.2289848 0.1898049
universal-small mwdn        1.471179 0.05051875 0.2424429 0.202682 0.7887322 0.615806
universal-small diffusercam 0.2339177 0.02114723 0.1489239 0.1152266 0.2314361 0.1842874
"""


def measures(scene: torch.Tensor) -> list[float]:
    middle, centre = (side // 2 for side in scene.shape[-2:])
    quarters = [scene[..., rows, columns] for rows in halves(middle) for columns in halves(centre)]
    return [
        float(value)
        for value in (
            scene.square().mean().sqrt(),
            scene.diff(dim=-1).abs().mean(),
            *(quarter.mean() for quarter in quarters),
        )
    ]


def halves(middle: int) -> tuple[slice, slice]:
    return slice(middle), slice(middle, None)


@pytest.mark.parametrize("camera", CAMERAS)
@pytest.mark.parametrize("method", [*SOLVERS, *BUNDLED])
def test_results_are_the_recorded_ones(method: str, camera: str, data: Path) -> None:
    lines = (line.split() for line in RECORDED.strip().splitlines())
    recorded = {(name, used): [float(value) for value in values] for name, used, *values in lines}
    assert (method, camera) in recorded, "a new method: record what it gives"
    psf, capture, frames, background = CAMERAS[camera]
    calibration = Calibration.from_file(data / psf, frames, background=background)
    measurement = calibration.correct(read_frame(data / capture, bgr=frames.bgr))
    scene = Reconstructor(method, calibration, device="cpu", precision="exact")(measurement)
    # Another processor rounds differently, which a hundred iterations amplify.
    assert measures(scene) == pytest.approx(recorded[method, camera], rel=1e-3)

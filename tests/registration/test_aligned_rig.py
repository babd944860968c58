"""A session on the simulated rig, aligned: the truth is known exactly."""

import cv2
import numpy as np
import pytest
from displayed import natural_pictures

from display_geometry import from_picture
from mwdn.capture.display import RigDisplay
from mwdn.capture.recipe import read_capture_recipe
from mwdn.capture.session import Session
from mwdn.capture.set_up import open_camera
from mwdn.data import PairFile
from mwdn.io.images import srgb_encode, write_frame
from mwdn.registration import read_projection

RECIPE = """
[camera]
source = "rig"
[display]
kind = "rig"
width_px = 240
height_px = 135
[pictures]
folder = "photos"
size = [120, 120]
fill = 0.9
[session]
settle_s = 0.0
references_every = 2
patterns = {patterns}
frames = 1
[rig]
height = 112
width = 112
fill = 0.9
room_light = 0.03
vignetting = 0.1
turn_degrees = 5.0
"""


@pytest.mark.acceptance  # 10 s each; test_estimate.py measures the same with a projection of its own
@pytest.mark.parametrize(("patterns", "most"), [('["dots", "charuco"]', 0.3), ('["none"]', 0.7)])
def test_a_session_on_the_rig_is_aligned(tmp_path, run, patterns, most):
    import torch

    (tmp_path / "photos").mkdir()
    for number, picture in enumerate(natural_pictures(3, 120)):
        coded = (255 * srgb_encode(torch.from_numpy(picture))).round().byte().numpy()
        cv2.imwrite(str(tmp_path / "photos" / f"{number}.png"), coded[..., ::-1])
    (tmp_path / "recipe.toml").write_text(RECIPE.format(patterns=patterns), encoding="utf-8")
    recipe = read_capture_recipe(tmp_path / "recipe.toml")
    with open_camera(recipe) as rig:
        session = Session(recipe, rig, RigDisplay(rig), tmp_path / "captured.h5")
        session.run()
        truth = rig.homography @ from_picture(session._place, (120, 120))
        write_frame(tmp_path / "psf.npy", rig.psf[0].movedim(0, -1).numpy())
    out = tmp_path / "aligned.h5"
    method = ("--method", "admm", "--iterations", "60")
    status, said, _ = run("align", tmp_path / "captured.h5", "--psf", tmp_path / "psf.npy", *method, "-o", out)
    assert status == 0
    assert "3 pairs" in said
    y, x = np.mgrid[0:119:13j, 0:119:13j]
    points = np.stack([x, y], -1)
    expected = cv2.perspectiveTransform(points, truth)
    found = read_projection(out).to_camera(points)
    assert np.linalg.norm(found - expected, axis=-1).mean() < most
    with PairFile(out) as file:
        assert (len(file), file.scene_shape) == (3, (112, 112, 3))

"""Sessions as `mwdn align` reads them: what a frame's numbers mean is the camera's and the session's."""

import numpy as np
import pytest
import torch

from mwdn import Calibration, FrameFormat
from mwdn.capture.captured_pairs import create_captured
from mwdn.capture.source import CameraFrame
from mwdn.errors import ParameterError
from mwdn.registration.captured import SessionPairs


def test_the_mosaic_of_a_session_is_taken_or_must_be_the_cameras(tmp_path, generator):
    path, psf = tmp_path / "pairs.h5", torch.rand(1, 3, 16, 16, generator=generator)
    frame = CameraFrame(array=np.ones((32, 32, 1), np.uint16), bit_depth=12, mosaic="gbrg")
    with create_captured(path, frame, (8, 8), {}) as pairs:
        pairs.append(frame, np.ones((8, 8, 3), np.uint16), "a.png")
    assert SessionPairs(path, Calibration(psf)).calibration.frames == FrameFormat(bit_depth=12, mosaic="gbrg")
    with pytest.raises(ParameterError, match=r"rggb.*pairs\.h5.*gbrg"):
        SessionPairs(path, Calibration(psf, FrameFormat(mosaic="rggb")))

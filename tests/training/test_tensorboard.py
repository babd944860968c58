"""TensorBoard: what is written is read back."""

import sys

import cv2
import numpy as np
import pytest
import torch
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from mwdn.errors import MissingPackageError, ParameterError
from mwdn.io.images import srgb_decode
from mwdn.training.report import Report
from mwdn.training.tensorboard import TensorBoard
from mwdn.training.validation import Validation


def read(folder):
    events = EventAccumulator(str(folder))
    events.Reload()
    return events


def scalars(events):
    return {tag: {e.step: e.value for e in events.Scalars(tag)} for tag in events.Tags()["scalars"]}


def report(step, validation=None):
    return Report(step, 3.0 + step, {"mse": 2.0, "l1": 1.0}, 1e-3 / step, 8.5, validation)


def test_numbers_and_sheet(tmp_path):
    encoded = np.random.default_rng(0).integers(0, 256, (20, 30, 3), np.uint8)
    sheet = srgb_decode(torch.from_numpy(encoded / np.float32(255))).movedim(-1, 0)[None]
    with TensorBoard(tmp_path / "deep" / "board") as write:
        write(report(1))
        write(report(2, Validation(21.5, 0.25, sheet)))
    events = read(tmp_path / "deep" / "board")
    values = scalars(events)
    assert values.keys() == {
        *("loss/total", "loss/mse", "loss/l1", "learning_rate", "pictures_per_s"),
        *("validation/psnr", "validation/loss"),
    }
    assert values["loss/total"] == {1: 4.0, 2: 5.0}
    assert values["loss/l1"] == {1: 1.0, 2: 1.0}
    assert values["learning_rate"] == pytest.approx({1: 1e-3, 2: 5e-4})
    assert values["pictures_per_s"][2] == 8.5
    assert (values["validation/psnr"], values["validation/loss"]) == ({2: 21.5}, {2: 0.25})
    (image,) = events.Images("validation")
    assert image.step == 2
    decoded = cv2.imdecode(np.frombuffer(image.encoded_image_string, np.uint8), cv2.IMREAD_COLOR)[..., ::-1]
    assert np.abs(decoded.astype(int) - encoded).max() <= 1


def test_steps_that_a_resumed_run_repeats_are_shown_once(tmp_path):
    for start, end in ((0, 6), (3, 8)):
        with TensorBoard(tmp_path, start) as write:
            for step in range(start + 1, end):
                write(report(step))
    assert list(scalars(read(tmp_path))["loss/total"]) == [1, 2, 3, 4, 5, 6, 7]
    assert len(read(tmp_path).Scalars("loss/total")) == 7


def test_without_the_package(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "tensorboard", None)
    for name in [name for name in sys.modules if name.startswith("torch.utils.tensorboard")]:
        monkeypatch.delitem(sys.modules, name)
    with pytest.raises(MissingPackageError, match=r"`pip install 'mwdn\[tensorboard\]'`"):
        TensorBoard(tmp_path)


def test_folder_that_cannot_be_written(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(ParameterError, match=r"must be a folder that can be written to"):
        TensorBoard(tmp_path / "file")

"""Recorded pairs as numbered samples: each training pair once per epoch."""

import itertools
import re
import threading

import h5py
import pytest
import torch

from cameras import capture_of_rectangles
from mwdn.calibration.refinement import Refinement
from mwdn.data.pair_checks import DISPLAY_WHITE, REFINED
from mwdn.data.pairs import PairFile
from mwdn.data.recorded import Division, PrefetchedPairs, RecordedPairs, recorded_pairs
from mwdn.data.simulated import Samples
from mwdn.errors import ImageError, ParameterError, ShapeError, UnknownNameError
from mwdn.fourier.convolution import convolve
from mwdn.solvers.pose import Pose


@pytest.fixture
def pairs(tmp_path):
    """``pairs(count)``: measurement number n is n / 255, its scene 1 - n / 255."""

    def make(count=30, size=(4, 6), channels=3, scene=None):
        shape = (*size, channels)
        path = tmp_path / "pairs.h5"
        with PairFile.create(path, measurement_shape=shape, scene_shape=scene or shape, dtype="uint8") as file:
            for number in range(count):
                measurement = torch.full((channels, *size), number / 255)
                whole = torch.full((scene[2], *scene[:2]), 1.0) if scene else torch.ones_like(measurement)
                file.append(measurement, whole - number / 255)
        return path

    return make


def psf(size=(4, 6), channels=3):
    return torch.ones(1, channels, *size) / (size[0] * size[1])


def rows(source, numbers):
    """Positions in the file of the samples of these numbers."""
    measurement, scene, _ = source.batch(numbers)
    torch.testing.assert_close(measurement + scene, torch.ones_like(scene))  # they belong together
    return (measurement[:, 0, 0, 0] * 255).round().int().tolist()


def test_split_of_the_paper(pairs):
    """8:1:1 by position: of 30 pairs the first 3 are for test, the next 3 for validation, 24 for training."""
    train, validation = recorded_pairs(pairs(), psf(), Division())
    assert isinstance(train, Samples)
    assert torch.equal(train.batch([0]).psf, psf())
    assert len(train) == 24
    assert sorted(rows(train, range(24))) == list(range(6, 30))
    assert sorted(rows(validation, range(10**12, 10**12 + 3))) == [3, 4, 5]
    assert rows(validation, range(10**12, 10**12 + 3)) == rows(validation, range(10**12 + 3, 10**12 + 6))


def test_the_psf_is_aligned_to_each_pair_once(tmp_path, monkeypatch):
    """Two captures of one scene, the second through a PSF that is turned by 0.5 degrees."""
    h, scene, measurement = capture_of_rectangles((96, 96), count=8, corners=(24, 56), rectangle=(12, 12), noise=0.0)
    turned = Pose(torch.tensor([0.5]), torch.tensor([0.0])).move(h)
    with PairFile.create(tmp_path / "p.h5", measurement_shape=(96, 96, 3), scene_shape=(96, 96, 3)) as file:
        for one in (measurement, convolve(scene, turned)):
            file.append(one[0], scene[0])
    source = RecordedPairs(PairFile(tmp_path / "p.h5"), range(2), h, shuffled=False, aligned=True)
    psfs = source.batch([0, 1]).psf
    errors = [float((psfs[number] - true[0]).norm() / true.norm()) for number, true in ((0, h), (1, turned))]
    wrong = float((turned - h).norm() / h.norm())
    assert max(errors) < 0.5 * wrong
    monkeypatch.setattr("mwdn.data.recorded.align", None)  # not called again
    assert torch.equal(source.batch([2, 3]).psf, psfs)


def test_prefetched_batches(pairs):
    """They are the same in any order; consecutive ones are read by another thread."""
    train, _ = recorded_pairs(pairs(), psf(), Division(), seed=4)
    readers = []

    class Watched(RecordedPairs):
        def batch(self, numbers):
            readers.append((numbers, threading.current_thread()))
            return super().batch(numbers)

    watched = Watched(train.file, train.rows, train.psf, train.seed)
    prefetched = PrefetchedPairs(watched, 4)
    for start in (0, 4, 8, 24, 28, 8):
        assert rows(prefetched, range(start, start + 2)) == rows(train, range(start, start + 2))
    not_prefetched = [numbers[0] for numbers, thread in readers if thread is threading.main_thread()]
    assert not_prefetched == [0, 24, 8]  # the first of each run of consecutive batches


def test_the_error_of_a_prefetched_pair_is_raised_with_its_batch(pairs, monkeypatch):
    train, _ = recorded_pairs(pairs(), psf(), Division())
    read = PairFile.__getitem__

    def refuse(file, number):
        if number == train.row(5):
            raise ImageError("damaged")
        return read(file, number)

    monkeypatch.setattr(PairFile, "__getitem__", refuse)
    prefetched = train.prefetched(4)
    assert rows(prefetched, range(4)) == rows(train, range(4))
    for _ in range(2):
        with pytest.raises(ImageError, match="damaged"):
            prefetched.batch(range(4, 8))


def test_each_epoch_has_each_pair_once_in_a_new_order(pairs):
    train, _ = recorded_pairs(pairs(), psf(), Division(), seed=4)
    epochs = [rows(train, range(start, start + 24)) for start in range(0, 96, 24)]
    assert all(sorted(epoch) == list(range(6, 30)) for epoch in epochs)
    assert all(one != other for one, other in itertools.combinations([*epochs, list(range(6, 30))], 2))
    other, _ = recorded_pairs(pairs(), psf(), Division(), seed=5)
    assert rows(other, range(24)) != epochs[0]
    negative, _ = recorded_pairs(pairs(), psf(), Division(), seed=-1)
    assert sorted(rows(negative, range(24))) == list(range(6, 30))


def test_a_number_is_the_same_pair_in_any_batch_and_process(pairs):
    path = pairs()
    once, again = (recorded_pairs(path, psf(), Division(), seed=1)[0] for _ in range(2))
    whole = rows(once, range(60))
    assert rows(again, [50, 7, 23, 24]) == [whole[n] for n in (50, 7, 23, 24)]
    assert [rows(again, [n])[0] for n in range(20, 30)] == whole[20:30]
    # Literal values: an update must not change the order in the middle of a run.
    assert [once.row(n) for n in range(5)] == [7, 27, 13, 23, 22]


def test_each_pair_of_a_small_file_is_in_its_fingerprint(pairs):
    """Every second of 20 pairs could be exchanged, and a run went on."""
    path = pairs(20)
    before = RecordedPairs(PairFile(path), [], psf()).fingerprint
    with h5py.File(path, "a") as file:
        file["scene"][13] = 1 - file["scene"][13]
    assert RecordedPairs(PairFile(path), [], psf()).fingerprint != before


def test_an_empty_file_has_a_fingerprint(pairs):
    assert RecordedPairs(PairFile(pairs(0)), [], psf()).fingerprint


def test_the_file_is_opened_when_the_first_pair_is_read(pairs):
    train, _ = recorded_pairs(pairs(), psf(), Division())
    assert not train.file._opened
    train.batch([0])
    assert train.file._opened


def test_a_split_without_validation_holds_out_training_pairs():
    parts = Division("diffusercam").parts(1100)
    train, validation = parts["train"], parts["validation"]
    assert list(validation) == [1019, 1039, 1059, 1079, 1099]
    assert sorted([*train, *validation]) == list(range(1000, 1100))
    parts = Division("random", fractions=(0.5, 0.25, 0.25), seed=3).parts(40)
    assert (len(parts["train"]), len(parts["validation"])) == (20, 10)
    assert not set(parts["train"]) & set(parts["validation"])


@pytest.mark.parametrize(
    ("division", "count", "said"),
    [
        (Division("diffusercam"), 1010, "of 1,010 pairs leaves 10 for training and 0 for validation"),
        (Division("random", (0.0, 0.5, 0.5)), 10, "leaves 0 for training and 5 for validation"),
        (Division("paper"), 9, "The split 'paper' needs at least 10 pairs, but there are 9"),
    ],
)
def test_too_few_pairs(division, count, said):
    with pytest.raises(ParameterError, match=re.escape(said)):
        division.parts(count)


def test_unknown_split():
    with pytest.raises(UnknownNameError, match="Did you mean 'paper'"):
        Division("papr").parts(100)


@pytest.mark.parametrize(
    ("file", "own", "said"),
    [
        ({}, psf((8, 12)), "`psf` (8 x 12) and the measurements of"),
        ({}, psf((8, 12)), "The PSF is 2 times as large"),
        ({}, psf((8, 8)), "`psf_bin`"),
        ({}, psf((3, 6)), "(4 x 6) must match"),
        ({"channels": 1}, psf(), "`psf` (3 channels) must be grey, or have the channels of the measurements of"),
        ({"scene": (8, 12, 3)}, psf(), "The scenes of"),
        ({"scene": (8, 12, 3)}, psf(), "(8 x 12) must have the size of its measurements (4 x 6)"),
        (
            {"channels": 1, "scene": (4, 6, 3)},
            psf(channels=1),
            "(3 channels) must have the channels of its measurements",
        ),
    ],
)
def test_pairs_that_do_not_fit_the_psf(pairs, file, own, said):
    with pytest.raises(ShapeError, match=re.escape(said)):
        recorded_pairs(pairs(**file), own, Division())


@pytest.mark.parametrize("refined", [False, True])
def test_a_refinement_is_applied_once(tmp_path, refined):
    """`mwdn align` has divided the measurements by the sensor's field already, if its camera had one."""
    attributes = {REFINED: "align"} if refined else {}
    path, field = tmp_path / "a.h5", Refinement(sensor_field=((1.0, 0.5, 0.0),))
    with PairFile.create(
        path, measurement_shape=(4, 6, 3), scene_shape=(4, 6, 3), dtype="float32", attributes=attributes
    ) as file:
        for _ in range(10):
            file.append(torch.full((3, 4, 6), 0.5), torch.ones(3, 4, 6))
    train, _ = recorded_pairs(path, psf(), Division(), refinement=field)
    expected = torch.full((1, 3, 4, 6), 0.5)
    torch.testing.assert_close(train.batch([0]).measurement, expected if refined else field.measurement(expected))


def test_stray_light_has_the_units_of_aligned_pairs(tmp_path):
    """The stray light is a fraction of the full scale; `mwdn align` has divided measurements by the display's white."""
    with PairFile.create(
        tmp_path / "a.h5", measurement_shape=(4, 6, 3), scene_shape=(4, 6, 3), attributes={DISPLAY_WHITE: 0.4}
    ) as file:
        file.append(torch.full((10, 3, 4, 6), (0.2 + 0.04) / 0.4), torch.ones(10, 3, 4, 6))
    train, _ = recorded_pairs(tmp_path / "a.h5", psf(), Division(), refinement=Refinement(stray_light=((0.04,),)))
    torch.testing.assert_close(train.batch([0]).measurement, torch.full((1, 3, 4, 6), 0.2 / 0.4))


def test_grey_psf_serves_pairs_in_colour(pairs):
    train, _ = recorded_pairs(pairs(), psf(channels=1), Division())
    assert train.batch([0, 1]).measurement.shape == (2, 3, 4, 6)


def test_no_such_file(tmp_path):
    with pytest.raises(ImageError, match=r"none\.h5` does not exist"):
        recorded_pairs(tmp_path / "none.h5", psf(), Division())


def test_pairs_are_put_on_the_device_of_the_psf(pairs):
    file = PairFile(pairs())
    assert RecordedPairs(file, [0], psf().to("meta")).batch([0]).scene.device.type == "meta"


def test_a_pair_with_nan_is_named(tmp_path):
    """Not the batch that it was in, with the advice to lower the learning rate."""
    path = tmp_path / "pairs.h5"
    with PairFile.create(path, measurement_shape=(4, 6, 3), scene_shape=(4, 6, 3), dtype="float32") as file:
        file.append(torch.full((4, 3, 4, 6), 0.5), torch.full((4, 3, 4, 6), 0.5))
    with h5py.File(path, "a") as file:
        file["scene"][2, 1, 1, 1] = torch.nan
    source = RecordedPairs(PairFile(path), [0, 2, 3], psf(), shuffled=False)
    with pytest.raises(ParameterError, match="scene of pair 2, counted from 0, holds NaN"):
        source.batch([0, 1])
    assert source.batch([0, 2]).scene.isfinite().all()

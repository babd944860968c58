"""A method bound to one camera, for single captures and for streams."""

import copy
import inspect
import pickle
import re
from itertools import product

import numpy as np
import pytest
import torch

from made import touch
from mwdn import Camera, solvers
from mwdn.calibration import Calibration, FrameFormat
from mwdn.errors import CheckpointError, ParameterError, ShapeError, UnknownNameError
from mwdn.inference.methods import find_method
from mwdn.inference.reconstructor import Reconstructor
from mwdn.inference.room_light import RoomLight
from mwdn.networks import NETWORKS, build
from mwdn.solvers import SOLVERS, Admm, Wiener
from mwdn.weights.checkpoint import save_network

SIZE = 32, 40


@pytest.fixture
def measurement(psf, generator):
    scene = torch.zeros(1, 3, *SIZE)
    scene[..., 10:20, 12:22] = torch.tensor([0.9, 0.5, 0.2])[:, None, None]
    return Camera(psf).simulate(scene, generator=generator)


# --- Method -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", SOLVERS)
def test_each_solver_by_its_name(name, psf, measurement):
    result = Reconstructor(name, Calibration(psf), device="cpu")(measurement)
    assert result.shape == measurement.shape
    assert result.device.type == "cpu"
    torch.testing.assert_close(result, SOLVERS[name]()(measurement, psf))


def test_the_scene_can_be_changed_and_learned_from(psf, measurement):
    """Inference tensors were returned, which no layer can be trained on."""
    reconstruct = Reconstructor("wiener", Calibration(psf))
    streamed = next(iter(reconstruct.stream([measurement[0].movedim(0, -1).numpy()])))[1]
    for scene in (reconstruct(measurement), streamed):
        gain = torch.ones(1, requires_grad=True)
        (gain * scene).sum().backward()
        assert gain.grad == pytest.approx(float(scene.sum()), rel=1e-3)
        scene.clamp_(0, 1)


def test_solver_object_and_function(psf, measurement):
    calibration = Calibration(psf)
    fixed = Wiener(regularisation=1e-3)
    assert torch.equal(Reconstructor(fixed, calibration)(measurement), fixed(measurement, psf))
    assert torch.equal(Reconstructor(lambda b, h: b - h, calibration)(measurement), measurement - psf)


@pytest.mark.parametrize("name", NETWORKS)
def test_each_network_from_its_checkpoint(tmp_path, name, psf, measurement):
    options = {"width": 2} if "width" in inspect.signature(NETWORKS[name]).parameters else {}
    network = build(name, **options)
    path = tmp_path / "net.safetensors"
    save_network(path, network, name, options)
    batch = torch.cat([measurement, measurement / 2])
    expected = network.eval()(batch, psf).detach()
    for method in (path, network.train()):
        options = {"align": False, "room_light": False, "device": "cpu"}
        result = Reconstructor(method, Calibration(psf), **options)(batch)
        assert (result - expected).norm() < 0.05 * expected.norm()
        exact = Reconstructor(method, Calibration(psf), precision="exact", **options)(batch)
        torch.testing.assert_close(exact, expected, rtol=1e-4, atol=1e-4)
        assert not result.requires_grad


def test_file_called_like_a_solver_does_not_hide_it(tmp_path, monkeypatch):
    touch(tmp_path, "admm")
    monkeypatch.chdir(tmp_path)
    assert isinstance(find_method("admm"), Admm)


def test_unknown_method():
    with pytest.raises(UnknownNameError, match=r"No method named 'admn'\. Did you mean 'admm'\? Known: .*wiener"):
        find_method("admn")
    with pytest.raises(CheckpointError, match=r"No checkpoint at `no\.safetensors`"):
        find_method("no.safetensors")


@pytest.mark.parametrize("name", NETWORKS)
def test_network_without_weights(name, tmp_path, monkeypatch):
    if name in SOLVERS:
        assert isinstance(find_method(name), SOLVERS[name])
        return
    with pytest.raises(ParameterError, match=rf"`{name}` is a network .*`mwdn train "):
        find_method(name)
    save_network(tmp_path / "w.safetensors", build("wiener"), "wiener", {})
    (tmp_path / "w.safetensors").rename(tmp_path / name)
    monkeypatch.chdir(tmp_path)
    assert isinstance(find_method(name), NETWORKS["wiener"])  # a file of that name goes before


@pytest.mark.parametrize("device", ["gpu", "cpux", "cuda:99", "meta", "vulkan"])
def test_unusable_device(device, psf):
    with pytest.raises(ParameterError, match=rf"`device` \({device}\) must be one that torch can use here") as caught:
        Reconstructor("wiener", Calibration(psf), device=device)
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 400


def test_measurement_of_another_size(psf):
    message = "`measurement` (1, 3, 16, 40) and `psf` (1, 3, 32, 40) must have the same height and width. Pass raw"
    with pytest.raises(ShapeError, match=re.escape(message)):
        Reconstructor("wiener", Calibration(psf))(torch.rand(1, 3, 16, 40))


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize("method", [*SOLVERS, "universal-small"])
@pytest.mark.parametrize("shape", [(0, 3, *SIZE), (1, 0, *SIZE), (3, *SIZE), SIZE, (1, 1, 3, *SIZE)])
def test_measurement_that_is_no_batch(method, shape, psf):
    with pytest.raises(ShapeError, match=re.escape(f"`measurement` {shape} must be")):
        Reconstructor(method, Calibration(psf), device="cpu")(torch.rand(shape))


@pytest.mark.usefixtures("unchecked")
def test_measurement_of_integers(psf):
    with pytest.raises(ParameterError, match=r"`measurement` \(torch.uint8\).*`measurement / 255`"):
        Reconstructor("wiener", Calibration(psf))(torch.zeros(1, 3, *SIZE, dtype=torch.uint8))


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize("calibration", ["psf.png", torch.ones(1, 3, *SIZE)])
def test_calibration_of_another_type(calibration):
    with pytest.raises(ParameterError, match=rf"`calibration` \({type(calibration).__name__}\) must be"):
        Reconstructor("wiener", calibration)


@pytest.mark.parametrize("method", [*SOLVERS, "universal-small"])
@pytest.mark.parametrize("channels", [1, 2, 4])
def test_measurement_of_other_channels_than_the_psf(method, channels, psf):
    message = f"`psf` (1, 3, 32, 40) has 3 channels and `measurement` (1, {channels}, 32, 40) has {channels}"
    with pytest.raises(ShapeError, match=re.escape(message)):
        Reconstructor(method, Calibration(psf), device="cpu")(torch.rand(1, channels, *SIZE))


def test_grey_psf_serves_measurements_of_any_channels(psf):
    grey = Calibration(psf[:, :1])
    for channels in (1, 2, 3):
        measurement = torch.rand(2, channels, *SIZE)
        assert Reconstructor("wiener", grey, device="cpu")(measurement).shape == measurement.shape


@pytest.mark.parametrize("align", [True, False])
def test_grey_psf_and_a_network_of_colours(align, psf):
    reconstruct = Reconstructor(build("wiener-bank", width=2, finest=4, align=align), Calibration(psf[:, :1]))
    assert reconstruct(torch.rand(1, 1, *SIZE)).shape == (1, 1, *SIZE)
    with pytest.raises(ShapeError, match=r"\(1, 2, 32, 40\) must have 3 channels for this network"):
        reconstruct(torch.rand(1, 2, *SIZE))


@pytest.mark.parametrize(
    "error", [torch.OutOfMemoryError("CUDA out of memory"), RuntimeError("DefaultCPUAllocator: can't allocate memory")]
)
def test_too_large_for_the_memory(psf, measurement, error):
    def greedy(measurement, psf):
        raise error

    with pytest.raises(ParameterError, match=r"needs more memory than cpu has free\. Bin or crop it: `bin=2`"):
        Reconstructor(greedy, Calibration(psf), device="cpu")(measurement)


@pytest.mark.parametrize("name", ["unet", "mwdn", "mwdn-cpsf"])
def test_network_of_other_colours(name, psf):
    with pytest.raises(ShapeError, match=r"must have 3 channels for this network"):
        Reconstructor(build(name, width=2), Calibration(psf[:, :1]))(torch.rand(1, 1, *SIZE))


# --- Poses and streams --------------------------------------------------------------------------------


@pytest.fixture
def bank():
    """Without iterations, which do not matter here; nor does the room's light, a second a picture."""
    return build("wiener-bank", width=2, finest=0).eval()


@pytest.fixture
def frames(psf, generator):
    """Raw 16-bit frames of a square that goes to the right."""
    result = []
    for number in range(5):
        scene = torch.zeros(1, 3, *SIZE)
        scene[..., 10:20, 12 + number : 22 + number] = torch.tensor([0.9, 0.5, 0.2])[:, None, None]
        seen = Camera(psf).simulate(scene, generator=generator)[0].movedim(0, -1)
        result.append((seen.clamp(0, 1) * 65535).round().numpy().astype(np.uint16))
    return result


@pytest.fixture
def aligned(monkeypatch):
    """Measurements whose poses were asked for, with their poses."""
    asked, align = [], solvers.align

    def record(measurement, psf):
        asked.append((measurement, align(measurement, psf)))
        return asked[-1][1]

    monkeypatch.setattr(solvers, "align", record)
    return asked


@pytest.mark.parametrize("precision", ["exact", "fast"])
def test_pose_given_is_the_pose_found(precision, bank, psf, measurement):
    reconstruct = Reconstructor(bank, Calibration(psf), device="cpu", precision=precision, room_light=False)
    both = torch.cat([measurement, measurement.roll(3, -1)])
    found = reconstruct(both)
    result = reconstruct.at(solvers.align(both, psf))(both)
    torch.testing.assert_close(result, found, rtol=1e-4, atol=1e-5)
    turned = reconstruct.at(solvers.Pose(torch.tensor([5.0]), torch.tensor([0.0])))
    assert (turned(measurement) - result[:1]).norm() > 0.02 * result[:1].norm()
    assert torch.equal(reconstruct(both), found)


def test_pose_does_not_matter_to_others(psf, measurement):
    pose = solvers.Pose(torch.tensor([5.0]), torch.tensor([0.01]))
    for method in ("wiener", build("wiener-bank", width=2, align=False)):
        reconstruct = Reconstructor(method, Calibration(psf), device="cpu")
        assert torch.equal(reconstruct.at(pose)(measurement), reconstruct(measurement))


@pytest.mark.parametrize(("refresh", "asked"), [(0, [0]), (2, [0, 2]), (100, [0])])
def test_stream_keeps_the_pose(refresh, asked, bank, psf, frames, aligned):
    calibration = Calibration(psf)
    reconstruct = Reconstructor(bank, calibration, device="cpu", precision="exact", room_light=False)
    seen = list(reconstruct.stream(frames[:4], refresh=refresh))
    assert len(aligned) == len(asked)
    assert all(torch.equal(each, seen[n][0]) for (each, _), n in zip(aligned, asked, strict=True))
    at = {n: reconstruct.at(pose) for n, (_, pose) in zip(asked, aligned, strict=True)}
    for number, (measurement, scene) in enumerate(seen):
        assert torch.equal(measurement, calibration.correct(frames[number]))
        torch.testing.assert_close(scene, at[max(n for n in asked if n <= number)](measurement))


def test_stream_aligns_on_the_first_frame_that_shows_something(bank, psf, frames, aligned):
    """The pose of a dark frame was kept for a hundred frames."""
    reconstruct = Reconstructor(bank, Calibration(psf), device="cpu", precision="exact", room_light=False)
    noise = np.random.default_rng(0).integers(0, 200, frames[0].shape, np.uint16)
    (_, dark), *seen = reconstruct.stream([noise, *frames[:2]])
    assert dark.isfinite().all()
    assert torch.equal(aligned[-1][0], seen[0][0])
    for measurement, scene in seen:
        torch.testing.assert_close(scene, reconstruct.at(aligned[-1][1])(measurement))


@pytest.mark.parametrize(("align", "ambient"), [(None, False), (False, False), (None, True)])
def test_the_light_of_the_room_is_found_with_or_without_alignment(psf, align, ambient):
    """`--no-align` switched it off, too."""
    calibration = Calibration(psf, ambient=torch.zeros_like(psf) if ambient else None)
    assert Reconstructor(build("wiener-bank", width=2), calibration, align=align).room_light is not ambient


def test_stream_aligns_without_the_light_of_the_room(psf, frames, aligned, monkeypatch):
    """As a call does: even light looks like haze of the PSF."""

    def found(b, h):
        return RoomLight(torch.full_like(b, 0.01), b.new_full((len(b),), 0.1))

    monkeypatch.setattr("mwdn.inference.reconstructor.find_room_light", found)
    reconstruct = Reconstructor("wiener", Calibration(psf), device="cpu", align=True, room_light=True)
    measurement, scene = next(iter(reconstruct.stream(frames)))
    torch.testing.assert_close(aligned[0][0], measurement - 0.01)
    torch.testing.assert_close(scene, reconstruct(measurement))


@pytest.mark.parametrize("solver", [Admm(iterations=30), solvers.Fista(iterations=30)], ids=["admm", "fista"])
def test_stream_goes_on_where_it_was(solver, psf, frames, aligned):
    warm = solvers.WarmStart(solver)
    reconstruct = Reconstructor(solver, Calibration(psf), device="cpu")
    for _ in range(2):  # each stream begins anew
        for measurement, scene in reconstruct.stream(frames):
            assert torch.equal(scene, warm(measurement, psf))
        warm = solvers.WarmStart(solver)
    assert torch.equal(reconstruct(measurement), solver(measurement, psf))
    assert aligned == []


def broken(frame):
    """With one pixel that is no number."""
    frame = (frame / 65535).astype(np.float32)
    frame[3, 4] = np.nan
    return frame


@pytest.mark.parametrize("solver", [Admm(iterations=20), solvers.Fista(iterations=20)], ids=["admm", "fista"])
def test_stream_forgets_a_frame_that_is_not_finite(solver, psf, frames):
    stream = Reconstructor(solver, Calibration(psf), device="cpu").stream([frames[0], broken(frames[1]), *frames[2:]])
    assert [bool(scene.isfinite().all()) for _, scene in stream] == [True, False, True, True, True]


def test_stream_finds_the_pose_on_the_first_frame_that_is_finite(bank, psf, frames, aligned):
    reconstruct = Reconstructor(bank, Calibration(psf), device="cpu", precision="exact", room_light=False)
    for refresh, at in ((0, [1]), (2, [1, 3, 4])):
        broken_ones = [broken(frames[n]) if n in (0, 2) else frames[n] for n in range(5)]
        stream = reconstruct.stream(broken_ones, refresh=refresh)
        seen = [measurement for measurement, _ in stream]
        asked = [each for each, _ in aligned if each.isfinite().all()]
        assert len(asked) == len(at)
        assert all(torch.equal(each, seen[n]) for each, n in zip(asked, at, strict=True))
        aligned.clear()


def test_stream_checks_the_channels(psf):
    network = build("unet", width=2, channels=1)
    stream = Reconstructor(network, Calibration(psf), device="cpu").stream([np.zeros((*SIZE, 3), np.uint8)])
    with pytest.raises(ShapeError, match="must have 1 channels for this network"):
        next(stream)


def test_stream_of_any_other_method_is_frame_by_frame(psf, frames):
    reconstruct = Reconstructor("wiener", Calibration(psf), device="cpu")
    for frame, (measurement, scene) in zip(frames, reconstruct.stream(frames), strict=True):
        assert torch.equal(scene, reconstruct(measurement))
        assert torch.equal(measurement, reconstruct.calibration.correct(frame))


def test_stream_takes_frames_as_they_are_asked_for(psf, frames):
    left = iter(frames)
    stream = Reconstructor("wiener", Calibration(psf)).stream(left)
    assert len(list(left)) == 5
    assert list(stream) == []


def test_stream_refuses(psf):
    reconstruct = Reconstructor("wiener", Calibration(psf))
    with pytest.raises(ParameterError, match=r"`refresh` \(-1\) must be a number of frames, or 0"):
        reconstruct.stream([], refresh=-1)
    with pytest.raises(ShapeError, match=r"must have the same height and width"):
        next(reconstruct.stream([np.zeros((4, 4, 3), np.uint8)]))


@pytest.mark.parametrize("method", [build("wiener"), Wiener(1e-3)])
def test_a_batch_is_taken_a_few_at_a_time(method, generator):
    """A batch of 3 pictures of 256 x 256 is 2 and 1."""
    psf = torch.rand(1, 3, 256, 256, generator=generator)
    sizes = []

    def counting(measurement, psf):
        sizes.append(len(measurement))
        return method(measurement, psf)

    reconstruct = Reconstructor(counting, Calibration(psf / psf.sum()), device="cpu")
    batch = torch.rand(3, 3, 256, 256, generator=generator)
    scene = reconstruct(batch)
    assert sizes == [2, 1]
    torch.testing.assert_close(scene[2:], reconstruct(batch[2:]))


@torch.no_grad()
def test_what_belongs_to_each_sample_keeps_a_batch_together(generator):
    """Where the iterations for the last frame ended, and the pose of the PSF."""
    psf = torch.rand(1, 3, 24, 32, generator=generator)
    calibration, batch = Calibration(psf / psf.sum()), torch.rand(3, 3, 24, 32, generator=generator)
    warm, whole = solvers.WarmStart(solvers.Admm(iterations=5)), solvers.WarmStart(solvers.Admm(iterations=5))
    stream = Reconstructor(warm, calibration, device="cpu")
    stream.pixels_per_chunk = 1
    for _ in range(2):
        torch.testing.assert_close(stream(batch), whole(batch, stream.psf))
    options = {"device": "cpu", "precision": "exact", "room_light": False}
    network = Reconstructor(build("wiener-bank", width=4).eval(), calibration, **options)
    network.pixels_per_chunk = 1
    pose = solvers.Pose(torch.tensor([0.0, 2.0, -3.0]), torch.tensor([0.0, 0.01, 0.02]))
    result = network.at(pose)(batch)
    for i in range(3):
        one = solvers.Pose(pose.turn_degrees[i : i + 1], pose.scale[i : i + 1])
        torch.testing.assert_close(result[i : i + 1], network.at(one)(batch[i : i + 1]), rtol=1e-3, atol=1e-4)


# --- Copies -------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "precision"),
    [*product({**SOLVERS, **NETWORKS}, ["fast"]), ("mwdn-cpsf", "exact"), ("wiener-bank", "exact")],
)
def test_copies_and_pickles_give_the_same_scene(name, precision, psf, measurement):
    """An exact engine keeps the same things for all networks: filters of the PSF, or the PSF's features."""
    known = inspect.signature(SOLVERS.get(name) or NETWORKS[name]).parameters
    options = {key: value for key, value in {"width": 2, "finest": 0, "iterations": 5}.items() if key in known}
    method = SOLVERS[name](**options) if name in SOLVERS else build(name, **options).eval()
    options = {"device": "cpu", "precision": precision, "align": False, "room_light": False}
    reconstruct = Reconstructor(method, Calibration(psf), **options)
    scene = reconstruct(measurement)
    for other in (pickle.loads(pickle.dumps(reconstruct)), copy.deepcopy(reconstruct), copy.copy(reconstruct)):
        assert torch.equal(other(measurement), scene)
        assert repr(other) == repr(reconstruct)


def test_representations_are_one_short_line(psf):
    calibration = Calibration(psf, FrameFormat(bin=4))
    reconstruct = Reconstructor("admm", calibration, device="cpu", align=True)
    pose = solvers.Pose(torch.zeros(1), torch.zeros(1))
    for thing in (reconstruct, calibration, calibration.frames, Camera(psf), pose):
        again = pickle.loads(pickle.dumps(thing))
        assert repr(again) == repr(copy.deepcopy(thing)) == repr(thing)
        assert len(repr(thing)) < 160
        assert "\n" not in repr(thing)
        assert "tensor" not in repr(thing)
    assert repr(reconstruct) == f"Reconstructor('admm', 32 x 40, PSF {calibration.psf_hash}, cpu, aligned)"
    assert repr(calibration) == f"Calibration(32 x 40, RGB, PSF {calibration.psf_hash}, FrameFormat(bin=4))"


def test_a_class_in_place_of_a_method_is_refused(psf):
    """It failed only at the first capture, in the class's constructor."""
    with pytest.raises(ParameterError, match=r"must be an object: `Admm\(\)`"):
        Reconstructor(solvers.Admm, Calibration(psf))

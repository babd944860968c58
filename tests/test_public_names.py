"""What `import mwdn` offers, and arrays where people hold arrays."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

import mwdn
from mwdn import Calibration, Camera, Reconstructor
from mwdn.errors import ImageError, ParameterError

SIZE = (32, 40)


@pytest.fixture
def psf():
    """A uint16 picture (H, W, C) of a point source: a few dots on black."""
    picture = np.zeros((*SIZE, 3), np.uint16)
    for row, column in ((16, 20), (9, 13), (22, 31), (25, 8)):
        picture[row, column] = 40000
    return picture


@pytest.fixture
def capture(psf):
    """A float32 capture (H, W, C) of a bright rectangle."""
    scene = torch.zeros(1, 3, *SIZE)
    scene[..., 10:20, 12:22] = 0.9
    return Camera(Calibration.from_array(psf).psf)(scene)[0].movedim(0, -1).numpy()


PACKAGES = {path.parent.name for path in Path(mwdn.__file__).parent.glob("*/__init__.py")} - {"cli"}


@pytest.mark.parametrize("name", [*mwdn.__all__, *sorted(PACKAGES), "errors", "types"])
def test_every_name_is_there(name):
    assert getattr(mwdn, name) is not None
    assert name in dir(mwdn)


def test_folders_are_attributes_of_a_fresh_import():
    code = f"import mwdn\nfor name in {sorted(PACKAGES)}: getattr(mwdn, name).__all__"
    subprocess.run([sys.executable, "-W", "error", "-c", code], check=True, timeout=600)


def test_an_unknown_name_is_an_attribute_error():
    with pytest.raises(AttributeError, match="nothing"):
        _ = mwdn.nothing


def test_a_renamed_name_still_works_and_says_the_new_one():
    with pytest.warns(DeprecationWarning, match=r"mwdn\.to_display"):
        assert mwdn.for_people is mwdn.to_display


def test_an_array_in_is_an_array_out(psf, capture):
    reconstruct = Reconstructor("wiener", Calibration.from_array(psf), device="cpu")
    scene = reconstruct(capture)
    assert isinstance(scene, np.ndarray)
    assert scene.shape == (*SIZE, 3)
    assert scene.dtype == np.float32
    expected = reconstruct(torch.from_numpy(capture).movedim(-1, 0)[None])[0].movedim(0, -1)
    np.testing.assert_array_equal(scene, expected.numpy())


def test_eight_bits_are_parts_of_255(psf, capture):
    reconstruct = Reconstructor("wiener", Calibration.from_array(psf), device="cpu", regularisation=1e-3)
    eight = (capture * 255).round().astype(np.uint8)
    np.testing.assert_allclose(reconstruct(eight), reconstruct(eight / np.float32(255)), atol=1e-6)


def test_grey_arrays_have_no_axis_of_channels(psf, capture):
    calibration = Calibration.from_array(psf[..., 0])
    assert calibration.psf.shape == (1, 1, *SIZE)
    assert Reconstructor("wiener", calibration, device="cpu")(capture[..., 0]).shape == (*SIZE, 1)


def test_a_pil_picture(psf, capture):
    Image = pytest.importorskip("PIL.Image")
    reconstruct = Reconstructor("wiener", Calibration.from_array(psf), device="cpu")
    eight = (capture * 255).round().astype(np.uint8)
    picture = Image.fromarray(eight)
    np.testing.assert_array_equal(reconstruct(picture), reconstruct(eight))
    with pytest.raises(ImageError, match=r"convert\('RGB'\)"):
        reconstruct(picture.convert("P"))


@pytest.mark.parametrize(
    ("change", "named"),
    [
        (lambda x: x.astype(np.int64), "int64"),
        (lambda x: np.stack([x, x]), "2 x 32 x 40 x 3"),
        (lambda x: np.where(x == x.max(), np.nan, x).astype(np.float32), "NaN"),
        (lambda x: x[..., :2], "32 x 40 x 2"),
        (lambda x: np.ma.masked_greater(x, x.mean()), "masked"),
        (lambda x: "capture.png", r"`capture.png` is a path, .*`mwdn.read_frame\('capture.png'\)`"),
    ],
)
@pytest.mark.usefixtures("unchecked")
def test_what_is_no_frame_is_refused(change, named, psf, capture):
    with pytest.raises(ImageError, match=named):
        Reconstructor("wiener", Calibration.from_array(psf), device="cpu")(change(capture))


@pytest.fixture
def double():
    """What some scientists put at the top of every script."""
    torch.set_default_dtype(torch.float64)
    yield
    torch.set_default_dtype(torch.float32)


@pytest.mark.usefixtures("double")
@pytest.mark.parametrize("method", ["wiener", "universal"])
def test_methods_do_not_depend_on_torchs_default_type(method, psf, capture):
    """Alignment of `universal` included."""
    calibration = Calibration.from_array(psf)
    assert calibration.psf.dtype == torch.float32
    scene = Reconstructor(method, calibration, device="cpu", precision="exact")(calibration.correct(capture))
    torch.set_default_dtype(torch.float32)
    expected = Reconstructor(method, calibration, device="cpu", precision="exact")(calibration.correct(capture))
    assert scene.dtype == torch.float32
    assert (scene - expected).norm() < 1e-3 * expected.norm()


@pytest.mark.usefixtures("double")
@pytest.mark.parametrize("name", mwdn.networks.NETWORKS)
def test_networks_do_not_depend_on_torchs_default_type(name):
    options = {"size": (16, 18)} if name in ("updn", "flatnet", "svdeconv") else {}
    network = mwdn.build(name, **options, **({} if name in ("wiener", "le-admm") else {"width": 4})).eval()
    scene = network(torch.rand(1, 3, 16, 18), torch.rand(1, 3, 16, 18) ** 6)
    assert scene.dtype == torch.float32
    assert scene.isfinite().all()


def test_the_psf_of_an_array_is_that_of_its_file(psf, tmp_path):
    np.save(tmp_path / "psf.npy", psf)
    file = Calibration.from_file(tmp_path / "psf.npy", bin=2, grey=True)
    array = Calibration.from_array(psf, bin=2, grey=True)
    assert file.psf_hash == array.psf_hash
    assert file.frames == array.frames


def test_arrays_are_written_and_scaled_as_tensors_are(capture, tmp_path):
    tensor = torch.from_numpy(capture).movedim(-1, 0)[None]
    np.testing.assert_array_equal(mwdn.to_display(capture), mwdn.to_display(tensor)[0].movedim(0, -1).numpy())
    mwdn.write_picture(tmp_path / "array.png", capture)
    mwdn.write_picture(tmp_path / "tensor.png", tensor)
    assert (tmp_path / "array.png").read_bytes() == (tmp_path / "tensor.png").read_bytes()


@pytest.mark.parametrize("write", [mwdn.write_picture, mwdn.write_linear])
def test_flipped_and_read_only_arrays_are_written(write, tmp_path):
    suffix = "png" if write is mwdn.write_picture else "tif"
    array = np.linspace(0, 1, 8 * 9 * 3, dtype=np.float32).reshape(8, 9, 3)
    flipped, fixed = array[::-1, ::-1], array.copy()
    fixed.flags.writeable = False
    for number, view in enumerate((flipped, flipped.copy(), fixed, array)):
        write(tmp_path / f"{number}.{suffix}", view)
    files = [(tmp_path / f"{number}.{suffix}").read_bytes() for number in range(4)]
    assert files[0] == files[1]
    assert files[2] == files[3]
    assert files[0] != files[2]


def test_networks_are_loaded_by_name_or_path(tmp_path):
    network = mwdn.load_network("universal-small")
    mwdn.weights.save_network(tmp_path / "net.safetensors", mwdn.build("unet", width=2), "unet", {"width": 2})
    assert isinstance(network, mwdn.networks.WienerBank)
    assert isinstance(mwdn.load_network(tmp_path / "net.safetensors"), mwdn.networks.UNet)


def test_a_solver_is_no_network():
    with pytest.raises(ParameterError, match=r"mwdn\.solvers\.build\('admm'\)"):
        mwdn.build("admm")


def test_a_method_that_does_not_align_can(psf, capture):
    """All solvers are called alike, so one of them is enough."""
    calibration = Calibration.from_array(psf)
    pose = mwdn.align(torch.from_numpy(capture).movedim(-1, 0)[None], calibration.psf)
    aligned = Reconstructor("wiener", calibration, align=True, device="cpu")
    moved = Reconstructor("wiener", Calibration(pose.move(calibration.psf)), device="cpu")
    np.testing.assert_allclose(aligned(capture), moved(capture), rtol=1e-4, atol=1e-5)
    np.testing.assert_array_equal(aligned.at(pose)(capture), aligned(capture))


def test_options_belong_to_a_method_given_by_its_name(psf):
    calibration = Calibration.from_array(psf)
    with pytest.raises(ParameterError, match="iterations"):
        Reconstructor(mwdn.solvers.Admm(), calibration, iterations=3)
    with pytest.raises(ParameterError, match="'universal'"):
        Reconstructor("universal", calibration, regularisation=1e-3)


def test_a_network_is_trained_in_one_call_and_reconstructs(psf, capture, tmp_path):
    photos = tmp_path / "photos"
    photos.mkdir()
    for number in range(3):
        mwdn.write_picture(photos / f"{number}.png", np.roll(capture, 5 * number, 1))
    recipe = mwdn.training.Recipe(
        {"name": "mwdn", "width": 2}, mwdn.training.Schedule(steps=2, batch=2, validate_every=1, validation=2)
    )
    calibration = Calibration.from_array(psf)
    steps = []
    path = mwdn.train(recipe, calibration, photos=photos, out=tmp_path / "run", device="cpu", callback=steps.append)
    assert [report.step for report in steps] == [1, 2]
    assert Reconstructor(path, calibration, device="cpu")(capture).shape == (*SIZE, 3)


def test_pairs_are_simulated_in_one_call_by_the_name_of_a_recipe(psf, capture, tmp_path):
    (tmp_path / "photos").mkdir()
    mwdn.write_picture(tmp_path / "photos" / "a.png", capture)
    photos, out = str(tmp_path / "photos"), str(tmp_path / "pairs.h5")
    mwdn.simulate("quick-cpu", Calibration.from_array(psf), photos=photos, out=out, count=2)
    measurement, scene = mwdn.data.PairFile(out)[1]
    assert measurement.shape == scene.shape == (3, *SIZE)

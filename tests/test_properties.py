"""Laws that hold for any size, type and value: drawn by hypothesis, the same examples in each run."""

from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import get_args

import jaxtyping
import numpy as np
import pytest
import torch

pytest.importorskip("hypothesis", reason="the extra `test` is not installed")

from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from mwdn import Calibration, Camera, Reconstructor, read_frame
from mwdn.calibration.camera_file import read_camera, write_camera
from mwdn.data import PairFile
from mwdn.errors import MwdnError
from mwdn.io import write_frame, write_linear, write_picture
from mwdn.io.images import read_picture
from mwdn.optics.orientation import Orientation

SIDES = st.integers(1, 24)
SIZES = st.tuples(SIDES, SIDES)
SEEDS = st.integers(0, 2**31)


def few(examples):
    """Settings: the same few examples in each run, no limit of time, no files of its own."""
    return settings(
        max_examples=examples,
        derandomize=True,
        deadline=None,
        database=None,
        suppress_health_check=[HealthCheck.too_slow],
    )


def noise(seed, *shape):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed))


@contextmanager
def folder():
    """A folder for one example: pytest's is one for all examples of a test."""
    with TemporaryDirectory() as path:
        yield Path(path)


# --- The forward model --------------------------------------------------------------------------------


@given(SIZES, SIZES, SIZES, st.sampled_from([(1, 1), (1, 3), (3, 3)]), SEEDS)
@few(25)
def test_the_forward_model_is_linear_and_has_its_adjoint(scene, psf, sensor, channels, seed):
    """<A x, y> = <x, A^T y>, and A (x - 2 z) = A x - 2 A z, for any three sizes."""
    camera = Camera(noise(seed, 1, channels[0], *psf).square() + 1e-3, size=sensor)
    x, z = noise(seed + 1, 2, 2, channels[1], *scene)
    y = noise(seed + 2, 2, channels[1], *sensor)
    Ax, Az, Ay = camera.forward(x), camera.forward(z), camera.adjoint(y, scene_size=scene)
    assert Ax.shape == y.shape
    assert Ay.shape == x.shape
    error = (Ax.double() * y).sum() - (x.double() * Ay).sum()
    assert error.abs() <= 2e-5 * x.norm() * y.norm()  # a PSF of unit sum: |A x| <= |x|
    torch.testing.assert_close(camera.forward(x - 2 * z), Ax - 2 * Az, rtol=0, atol=1e-4)


# --- Files --------------------------------------------------------------------------------------------


@given(
    SIZES, st.sampled_from([1, 3]), st.sampled_from(["uint8", "uint16"]), st.sampled_from(["png", "tif", "npy"]), SEEDS
)
@few(30)
def test_a_frame_comes_back_to_the_bit(size, channels, dtype, suffix, seed):
    most = np.iinfo(dtype).max
    frame = np.random.default_rng(seed).integers(0, most, (*size, channels), dtype, endpoint=True)
    with folder() as place:
        write_frame(place / f"a.{suffix}", frame)
        back = read_frame(place / f"a.{suffix}")
    assert back.dtype == frame.dtype
    np.testing.assert_array_equal(back, frame)


@given(SIZES, st.sampled_from([1, 3]), st.sampled_from([8, 16]), SEEDS)
@few(20)
def test_a_picture_comes_back_within_half_a_step(size, channels, bits, seed):
    """A step of the encoded numbers is at most 2.28 times as large in linear light: the slope of sRGB at white."""
    image = torch.rand(1, channels, *size, generator=torch.Generator().manual_seed(seed))
    with folder() as place:
        write_picture(place / "a.png", image, bits=bits)
        write_linear(place / "a.npy", image)
        linear = torch.from_numpy(read_frame(place / "a.npy")).movedim(-1, 0)[None]
        encoded = read_picture(place / "a.png")
    assert torch.equal(linear, image)
    torch.testing.assert_close(encoded, image.expand_as(encoded), rtol=0, atol=2.28 * 0.5 / (2**bits - 1) + 1e-6)


@given(SIZES, SIZES, st.sampled_from([1, 3]), st.sampled_from(["float32", "uint8", "uint16"]), st.integers(1, 3), SEEDS)
@few(15)
def test_pairs_come_back(measurement, scene, channels, dtype, count, seed):
    generator = torch.Generator().manual_seed(seed)
    m, s = (torch.rand(count, channels, *size, generator=generator) for size in (measurement, scene))
    shapes = {"measurement_shape": (*measurement, channels), "scene_shape": (*scene, channels)}
    step = 0.0 if dtype == "float32" else 1 / np.iinfo(dtype).max
    with folder() as place:
        with PairFile.create(place / "a.h5", dtype=dtype, **shapes) as file:
            file.append(m, s)
        with PairFile(place / "a.h5") as file:
            assert len(file) == count
            for expected, found in zip(zip(m, s, strict=True), file, strict=True):
                for one, other in zip(expected, found, strict=True):
                    torch.testing.assert_close(other, one, rtol=0, atol=step / 2 + 1e-6 * (step > 0))


CAMERAS = st.fixed_dictionaries(
    {},
    optional={
        "background": st.floats(0, 0.5),
        "bit_depth": st.integers(8, 16),
        "gamma": st.floats(1, 3),
        "psf_bit_depth": st.integers(8, 16),
        "psf_gamma": st.sampled_from(["srgb", 2.2]),
        "psf_orientation": st.sampled_from(get_args(Orientation)),
        "crop": st.tuples(st.integers(1, 5000), st.integers(1, 5000)),
        "bin": st.integers(1, 16),
        "bgr": st.booleans(),
        "grey": st.booleans(),
        "upside_down": st.booleans(),
        "white_balance": st.tuples(*[st.floats(0.2, 5)] * 3),
        "pitch_um": st.floats(0.5, 50),
        "distance_mm": st.floats(1, 1e6),
    },
)


@given(CAMERAS)
@few(40)
def test_a_camera_file_comes_back_as_written(camera):
    with folder() as place:
        (place / "psf.png").touch()
        write_camera(place / "camera.toml", {"psf": place / "psf.png", **camera})
        back = read_camera(place / "camera.toml")
        assert len(back.pop("psf_sha256")) == 64
        assert back == {"psf": place / "psf.png", **camera}


# --- Any array at the border --------------------------------------------------------------------------


@pytest.fixture(scope="module")
def cameras():
    """A camera of 19 x 24 pixels for each number of channels."""
    psf = noise(3, 19, 24, 3).square().numpy() ** 4
    return {1: Calibration.from_array(psf[..., :1]), 3: Calibration.from_array(psf)}


@pytest.mark.parametrize("method", ["wiener", "admm", "universal-small"])
def test_a_reconstructor_gives_a_finite_picture_or_our_error(method, cameras):
    """Sizes, numbers of channels and types that fit the camera or not; values from nothing to far too much."""
    types = ["uint8", "uint16", "int32", "float16", "float32", "float64", "bool", "complex64"]
    values = [0.0, 1e-9, 1.0, 1e3, 1e20, -1.0, float("nan"), float("inf")]
    sizes = st.one_of(st.just((19, 24)), SIZES)
    reconstructors = {count: Reconstructor(method, each, device="cpu") for count, each in cameras.items()}
    pictures = []

    @given(
        st.sampled_from([1, 3]),
        sizes,
        st.sampled_from([(), 1, 2, 3, 4]),
        st.sampled_from(types),
        st.sampled_from(values),
    )
    @few(40)
    def check(colours, size, channels, dtype, value):
        shape = size if channels == () else (*size, channels)
        array = np.random.default_rng(1).random(shape) * 200
        array.flat[0] = 200 * value if np.dtype(dtype).kind in "fc" else 200
        with np.errstate(over="ignore"):
            array = array.astype(dtype)
        try:
            scene = reconstructors[colours](array)
        except MwdnError:
            return
        pictures.append(np.shape(scene))
        assert np.isfinite(scene).all()
        assert scene.shape[:2] == size

    jaxtyping.config.update("jaxtyping_disable", True)  # as for users: mwdn itself must refuse
    try:
        check()
    finally:
        jaxtyping.config.update("jaxtyping_disable", False)
    assert pictures  # not everything is refused

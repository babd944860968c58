"""What people hold: numpy arrays and PIL pictures. Each border takes them or says how to make what it takes."""

import numpy as np
import pytest
import torch
from PIL import Image

import mwdn
from mwdn import Calibration, Camera, FrameFormat, Reconstructor, Sensor
from mwdn.errors import ImageError, MwdnError, ParameterError, ShapeError
from mwdn.evaluation import Protocol, consistency, l1, log_mse, measure, mse, psnr, ssim
from mwdn.io import as_frame
from mwdn.networks import build
from mwdn.solvers import SOLVERS, noise_level

SIZE = (32, 40)
RNG = np.random.default_rng(0)
PICTURE = RNG.random((*SIZE, 3), dtype=np.float32)
PSF = PICTURE**8
CALIBRATION = Calibration.from_array(PSF)
GREY = Calibration.from_array(PSF[..., 1])
MEASUREMENT = torch.from_numpy(PICTURE).movedim(-1, 0)[None]
BATCH_PSF = CALIBRATION.psf


def eight(picture):
    return (picture * 255).round().astype(np.uint8)


# --- Arrays in, arrays out ----------------------------------------------------------------------------

KINDS = {
    "uint8": (eight, 1 / 255),
    "uint16": (lambda x: (x * 65535).round().astype(np.uint16), 1 / 65535),
    "float32": (lambda x: x, 0.0),
    "float64": (lambda x: x.astype(np.float64), 0.0),
    "big-endian": (lambda x: (x * 65535).round().astype(">u2"), 1 / 65535),
    "PIL": (lambda x: Image.fromarray(eight(x)), 1 / 255),
}


@pytest.mark.parametrize("colours", [True, False])
@pytest.mark.parametrize("kind", KINDS)
def test_numbers_of_a_type_are_fractions_of_its_maximum(kind, colours):
    convert, step = KINDS[kind]
    picture, calibration = (PICTURE, CALIBRATION) if colours else (PICTURE[..., 1], GREY)
    given = convert(picture)
    expected = as_frame(picture)
    measurement = calibration.correct(given)[0].movedim(0, -1).numpy()
    np.testing.assert_allclose(measurement, expected, atol=0.51 * step + 1e-7)
    reconstruct = Reconstructor("wiener", calibration, device="cpu", regularisation=1e-2)
    scene = reconstruct(given)
    assert scene.dtype == np.float32
    assert scene.shape == (*SIZE, 3 if colours else 1)
    np.testing.assert_allclose(scene, reconstruct(picture), atol=50 * step + 1e-6)
    psf, exact = (Calibration.from_array(each, background=0.0).psf for each in (convert(picture / 2), picture / 2))
    torch.testing.assert_close(psf, exact, rtol=0, atol=3e-5)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("axes", [(*SIZE, 3), SIZE])
def test_pictures_for_display_keep_their_axes(kind, axes):
    picture = PICTURE[..., : 3 if len(axes) == 3 else 1].reshape(axes)
    shown = mwdn.to_display(KINDS[kind][0](picture))
    assert shown.shape == axes
    np.testing.assert_allclose(shown, mwdn.to_display(5 * picture), atol=0.01)


@pytest.mark.parametrize("distance", [psnr, ssim, mse, l1, log_mse], ids=lambda d: d.__name__)
def test_distances_of_arrays_are_those_of_tensors(distance):
    other = (0.9 * PICTURE + 0.05).astype(np.float32)
    expected = distance(MEASUREMENT, torch.from_numpy(other).movedim(-1, 0)[None]).item()
    result = distance(PICTURE, other)
    assert isinstance(result, float)
    assert result == pytest.approx(expected, rel=1e-6)
    assert distance(Image.fromarray(eight(PICTURE)), eight(other)) == pytest.approx(expected, rel=0.02, abs=1e-3)
    with pytest.raises(ParameterError, match=r"floats up to .* must have 1 as white"):
        distance(Image.fromarray(eight(PICTURE)[..., 0]).convert("F"), eight(other)[..., 0])
    assert distance(PICTURE[..., 0], other[..., 0]) == pytest.approx(
        distance(PICTURE[..., :1], other[..., :1]), rel=1e-6
    )


def test_the_saturated_part_of_a_picture_is_that_of_its_array():
    frame = np.zeros((4, 5), np.uint8)
    frame[1, :2] = 255
    for given in (frame, frame[..., None], frame[None], Image.fromarray(frame)):
        assert CALIBRATION.saturated_part(given) == pytest.approx(2 / 20)


# --- What is refused ----------------------------------------------------------------------------------

TAKE_ARRAYS = {
    "Reconstructor": lambda x: Reconstructor("wiener", CALIBRATION, device="cpu")(x),
    "stream": lambda x: next(Reconstructor("wiener", CALIBRATION, device="cpu").stream([x])),
    "from_array": Calibration.from_array,
    "correct": CALIBRATION.correct,
    "saturated_part": CALIBRATION.saturated_part,
    "as_frame": as_frame,
    "normalise": FrameFormat().normalise,
    "to_measurement": FrameFormat().to_measurement,
    "full_scale": FrameFormat().full_scale,
    "saturated": FrameFormat().saturated,
    "to_display": mwdn.to_display,
    "psnr": lambda x: psnr(x, PICTURE),
    "ssim": lambda x: ssim(PICTURE, x),
}

BAD_ARRAYS = {
    "int32": ((PICTURE * 255).astype(np.int32), "int32"),
    "int64": ((PICTURE * 255).astype(np.int64), "int64"),
    "bool": (PICTURE > 0.5, "bool"),
    "complex": (PICTURE.astype(np.complex64), "complex64"),
    "list": ((PICTURE[:2, :2, 0] * 255).astype(int).tolist(), "int64"),
    "ragged list": ([[1.0, 2.0], [3.0]], "inhomogeneous"),
    "object": (np.array([None, None]), "object"),
    "batch": (np.stack([PICTURE, PICTURE]), "2 x 32 x 40 x 3"),
    "batch of one": (PICTURE[None], "1 x 32 x 40 x 3"),
    "video": (np.stack([PICTURE[..., 0]] * 5), "5 x 32 x 40"),
    "row": (PICTURE[0, :, 0], "40"),
    "channels first": (PICTURE.transpose(2, 0, 1), "3 x 32 x 40"),
    "two channels": (PICTURE[..., :2], "32 x 40 x 2"),
    "RGBA": (np.concatenate([PICTURE, np.ones((*SIZE, 1), np.float32)], -1), "four channels"),
    "PIL I": (Image.fromarray(eight(PICTURE)[..., 0].astype(np.int32)), "uint16"),
    "PIL RGBA": (Image.fromarray(eight(PICTURE)).convert("RGBA"), "RGBA"),
    "palette": (Image.fromarray(eight(PICTURE)).convert("P"), "P"),
    "CMYK": (Image.fromarray(eight(PICTURE)).convert("CMYK"), "CMYK"),
    "YCbCr": (Image.fromarray(eight(PICTURE)).convert("YCbCr"), "YCbCr"),
    "bilevel": (Image.fromarray(eight(PICTURE)).convert("1"), "1"),
    "path": ("capture.png", "`capture.png` is a path"),
    "None": (None, "None"),
}
AXES = {"ragged list", "batch", "batch of one", "video", "row", "channels first", "two channels", "RGBA"}
"""Bad arrays with wrong axes; the others hold numbers of another type."""


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize("bad", BAD_ARRAYS)
@pytest.mark.parametrize("name", TAKE_ARRAYS)
def test_what_is_no_frame_is_named(name, bad):
    value, named = BAD_ARRAYS[bad]
    with pytest.raises(ImageError) as caught:
        TAKE_ARRAYS[name](value)
    assert named in str(caught.value)
    assert isinstance(caught.value, ShapeError if bad in AXES else TypeError)


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize("name", [n for n in TAKE_ARRAYS if n not in ("Reconstructor", "to_display")])
def test_tensors_are_no_frames(name):
    with pytest.raises((ImageError, ParameterError), match="tensor"):
        TAKE_ARRAYS[name](MEASUREMENT)


@pytest.mark.parametrize("largest", [255.0, 4095.0, 65535.0, 2.1])
@pytest.mark.parametrize("name", ["Reconstructor", "stream", "correct"])
def test_floats_far_above_saturation_are_refused(name, largest):
    with pytest.raises(ParameterError, match=f"{largest:g}.*`bit_depth="):
        TAKE_ARRAYS[name]((PICTURE / PICTURE.max() * largest).astype(np.float32))


def test_floats_of_a_known_depth_and_floats_near_saturation_are_measurements():
    of_twelve = Calibration.from_array(PSF, FrameFormat(bit_depth=12))
    capture = PICTURE * np.float32(4095)
    np.testing.assert_allclose(of_twelve.correct(capture)[0].movedim(0, -1).numpy(), PICTURE, atol=1e-6)
    assert CALIBRATION.correct(1.3 * PICTURE).max() > 1.2


@pytest.mark.parametrize("scale", [1e-6, 1.0, 255.0, 1e6])
def test_psf_of_floats_has_any_scale(scale):
    psf = Calibration.from_array((PSF * scale).astype(np.float32)).psf
    torch.testing.assert_close(psf, CALIBRATION.psf, rtol=1e-4, atol=1e-7)


@pytest.mark.usefixtures("unchecked")
def test_floats_far_above_white_are_not_written(tmp_path):
    for image in (PICTURE * 255, torch.from_numpy(PICTURE).movedim(-1, 0) * 255):
        with pytest.raises(ImageError, match=r"`mwdn\.to_display"):
            mwdn.write_picture(tmp_path / "a.png", image)
    with pytest.raises(ImageError, match="uint8"):
        mwdn.write_picture(tmp_path / "a.png", eight(PICTURE))
    with pytest.raises(ImageError, match="four channels"):
        mwdn.write_picture(tmp_path / "a.png", np.ones((4, 4, 4), np.float32))


TAKE_TENSORS = {
    "Camera": lambda x: Camera(BATCH_PSF)(x),
    "Camera.adjoint": lambda x: Camera(BATCH_PSF).adjoint(x),
    "Camera.simulate": lambda x: Camera(BATCH_PSF).simulate(x),
    "Sensor.expose": lambda x: Sensor().expose(x),
    "convolve": lambda x: mwdn.convolve(x, BATCH_PSF),
    "correlate": lambda x: mwdn.correlate(x, BATCH_PSF),
    "wiener": lambda x: mwdn.wiener(x, BATCH_PSF, 1e-3),
    "convolve psf": lambda x: mwdn.convolve(MEASUREMENT, x),
    "align": lambda x: mwdn.align(x, BATCH_PSF),
    "consistency": lambda x: consistency(x, BATCH_PSF, MEASUREMENT),
    "consistency scene": lambda x: consistency(MEASUREMENT, BATCH_PSF, x),
    "noise_level": noise_level,
    "measure": lambda x: measure(x, MEASUREMENT, Protocol()),
    "network": lambda x: build("wiener")(x, BATCH_PSF),
    "on_device": lambda x: Reconstructor("wiener", CALIBRATION, device="cpu").on_device(x),
    **{name: lambda x, solver=solver: solver()(x, BATCH_PSF) for name, solver in SOLVERS.items()},
}


@pytest.mark.usefixtures("unchecked")
def test_dark_and_ambient_frames_are_tensors_of_floats():
    for name in ("dark", "ambient"):
        for other in ((MEASUREMENT * 255).int(), PICTURE, MEASUREMENT[0]):
            with pytest.raises(MwdnError, match=f"`{name}`"):
                Calibration(BATCH_PSF, **{name: other})


BAD_TENSORS = {
    "uint8": (MEASUREMENT * 255).to(torch.uint8),
    "int32": (MEASUREMENT * 255).int(),
    "int64": (MEASUREMENT * 255).long(),
    "bool": MEASUREMENT > 0.5,
    "complex": MEASUREMENT.cfloat(),
    "8-bit floats": MEASUREMENT.to(torch.float8_e4m3fn),
    "sparse": MEASUREMENT.to_sparse(),
    "meta": MEASUREMENT.to("meta"),
    "one picture": MEASUREMENT[0],
    "plane": MEASUREMENT[0, 0],
    "five axes": MEASUREMENT[None],
}


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize("bad", BAD_TENSORS)
@pytest.mark.parametrize("name", [*TAKE_TENSORS, "Reconstructor", "to_display"])
def test_other_tensors_are_named(name, bad):
    """Integers have an unknown scale: divided by the largest int32, a capture of 8 bits was 1e-7."""
    value = BAD_TENSORS[bad]
    error, named = (ParameterError, str(value.dtype)) if value.ndim == 4 else (ShapeError, str(tuple(value.shape)))
    with pytest.raises(error) as caught:
        (TAKE_TENSORS | TAKE_ARRAYS)[name](value)
    assert named in str(caught.value)


# --- Numbers ------------------------------------------------------------------------------------------


def with_pixel(value):
    other = MEASUREMENT.clone()
    other[0, 1, 3, 4] = value
    return other


BAD_NUMBERS = {
    "NaN": (with_pixel(torch.nan), "NaN or infinity"),
    "infinity": (with_pixel(torch.inf), "NaN or infinity"),
    "both infinities": (torch.cat([MEASUREMENT, with_pixel(torch.inf), with_pixel(-torch.inf)]), "NaN or infinity"),
    "half precision": (with_pixel(torch.nan).half(), "NaN or infinity"),
    "negative": (torch.cat([MEASUREMENT, -MEASUREMENT]), "no light"),
    "large": (1e20 * MEASUREMENT, r"1e\+20.* 1e-12 to 1e\+15"),
    "small": (1e-14 * MEASUREMENT, r"1e-14.* 1e-12 to 1e\+15"),
}


@pytest.mark.parametrize("method", ["wiener", "universal-small"])
@pytest.mark.parametrize("bad", BAD_NUMBERS)
def test_numbers_that_are_no_light_are_refused(bad, method):
    """Each gave a picture of NaN, or a wrong one, without a word."""
    value, message = BAD_NUMBERS[bad]
    reconstruct = Reconstructor(method, CALIBRATION, device="cpu")
    for call in (reconstruct, reconstruct.on_device):
        with pytest.raises(ParameterError, match=message):
            call(value)


@pytest.mark.parametrize("method", ["wiener", "admm", "universal-small"])
def test_scale_of_a_measurement_is_the_scale_of_its_picture(method):
    """Automatic Wiener lost the contrast below 1e-9. Darkness is a measurement: a video goes on."""
    reconstruct = Reconstructor(method, CALIBRATION, device="cpu", precision="exact")
    picture = reconstruct(MEASUREMENT)
    for scale in (1e-11, 1e15):
        assert (reconstruct(scale * MEASUREMENT) / scale - picture).norm() < 1e-5 * picture.norm()
    assert reconstruct(0 * MEASUREMENT).abs().max() < 1e-12


@pytest.mark.parametrize("name", ["wiener", "admm", "pyramid"])
def test_regularisation_is_finite(name):
    """ADMM gave a picture of NaN, Wiener a black one."""
    with pytest.raises(ParameterError, match=r"`regularisation` \(inf\)"):
        Reconstructor(name, CALIBRATION, regularisation=float("inf"))


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize("bad", ["array", "PIL", "None", "path"])
@pytest.mark.parametrize("name", TAKE_TENSORS)
def test_arrays_are_named_where_tensors_are_needed(name, bad):
    value = {"array": PICTURE, "PIL": Image.fromarray(eight(PICTURE)), "None": None, "path": "capture.png"}[bad]
    with pytest.raises(ParameterError, match=r"must be a tensor .*`Calibration\."):
        TAKE_TENSORS[name](value)


@pytest.mark.usefixtures("unchecked")
def test_a_distance_needs_two_of_a_kind():
    for pair in ((PICTURE, MEASUREMENT), (MEASUREMENT, PICTURE)):
        with pytest.raises(ParameterError, match="both"):
            psnr(*pair)
    with pytest.raises(MwdnError, match=r"\(1, 3, 32, 40\).*\(1, 1, 32, 40\)"):
        ssim(PICTURE, PICTURE[..., 0])
    for integers in (BAD_TENSORS["uint8"], BAD_TENSORS["int32"]):
        with pytest.raises(ParameterError, match=str(integers.dtype)):
            mse(integers, integers)


def test_an_array_in_a_file(tmp_path):
    """The mode of the file was taken for that of a picture."""
    np.save(tmp_path / "frame.npy", PICTURE)
    mapped = np.load(tmp_path / "frame.npy", mmap_mode="r")
    np.testing.assert_array_equal(as_frame(mapped), as_frame(PICTURE))

"""Masks from arrays: the same optics as designed masks, whatever the numbers stand for."""

import math
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch

from mwdn.errors import ImageError, MwdnError, ParameterError, ShapeError
from mwdn.optics import ArrayMask, CodedAperture, Contour, Setup, mask_psf
from mwdn.optics.amplitude_masks import separable_mls
from mwdn.optics.array_mask import make_mask
from mwdn.optics.mask_files import write_mask
from mwdn.optics.psf_measures import likeness

GREEN = Setup(aperture_mm=(0.3, 0.3), pixels=(160, 160), bin=1, band_nm=(532.0, 532.0), wavelengths=1, colour=False)


def ramp(down: float, right: float, pitch_um: float = 2.0, count: int = 161):
    """Phase of a prism that deflects green light by these sines."""
    position = (torch.arange(count) - count // 2) * pitch_um
    return 2 * math.pi / 0.532 * (down * position[:, None] + right * position)


def test_a_prism_moves_the_psf():
    """A phase of 2 pi x sin(a) / wavelength deflects light by the angle a: over 2 mm by 2 mm tan(a)."""
    straight = mask_psf(make_mask(ramp(0, 0), "phase", pitch_um=2.0, phase_nm=532.0), GREEN)
    sines = [math.sin(math.atan(pixels * 2.4 / 2000)) for pixels in (5, -10)]
    deflected = mask_psf(make_mask(ramp(*sines), "phase", pitch_um=2.0, phase_nm=532.0), GREEN)
    torch.testing.assert_close(deflected, straight.roll((5, -10), (-2, -1)), rtol=0, atol=0.05 * float(straight.max()))


def test_a_wrapped_phase_is_the_same_mask():
    phase = ramp(0.01, -0.02)
    wrapped = torch.remainder(phase + math.pi, 2 * math.pi) - math.pi
    with pytest.raises(ParameterError, match="`levels=256`"):
        mask_psf(make_mask(wrapped, "phase", pitch_um=2.0, phase_nm=532.0), GREEN)
    psf = mask_psf(make_mask(wrapped, "phase", pitch_um=2.0, phase_nm=532.0, levels=256), GREEN)
    smooth = mask_psf(make_mask(phase, "phase", pitch_um=2.0, phase_nm=532.0), GREEN)
    assert (psf - smooth).abs().max() < 0.02 * smooth.max()


def wave(pitch_um: float, side_um: float = 400.0):
    """Heights of a smooth surface, on samples of this pitch: slopes up to 0.25, 6.6 degrees behind the surface."""
    position = (torch.arange(round(side_um / pitch_um)) + 0.5) * pitch_um
    return 1.6 * torch.sin(2 * math.pi * position / 40)[:, None] * torch.ones(len(position))


def test_a_steep_surface_is_interpolated_as_the_message_says(tmp_path):
    """The pitch of an array is what it is: a smaller `pitch_um` would shrink the mask."""
    np.save(tmp_path / "wave.npy", wave(4.0).numpy())
    mask = ArrayMask(tmp_path / "wave.npy", "height", 4.0)
    with pytest.raises(ParameterError, match=r"`mask` .* 4 um apart, .*: `subdivide=3`\.") as caught:
        mask.build(GREEN)
    factor = int(str(caught.value)[-3])
    coarse = mask_psf(replace(mask, subdivide=factor).build(GREEN), GREEN)
    fine = mask_psf(make_mask(wave(1.0), "height", pitch_um=1.0), GREEN)
    assert likeness(coarse, fine) > 0.95
    np.save(tmp_path / "wrapped.npy", torch.remainder(ramp(0.05, 0.05), 2 * math.pi).numpy())
    wrapped = ArrayMask(tmp_path / "wrapped.npy", "phase", 2.0)
    with pytest.raises(ParameterError, match="`levels=256`"):
        wrapped.build(GREEN)
    assert replace(wrapped, levels=256).build(GREEN).step_um > 0


def test_an_interpolated_surface_is_a_mask_file(tmp_path, generator):
    """Interpolation between a peak and flat ground undershoots the ground, but no height of a mask is negative."""
    bumps = 0.05 * (torch.rand(20, 20, generator=generator) > 0.9).float()
    mask = make_mask(bumps, "height", pitch_um=10.0, subdivide=4)
    assert mask.values.min() == 0
    assert 0.05 < mask.values.max() < 0.1
    write_mask(tmp_path / "mask.tif", mask)


def test_a_surface_is_steep_only_where_light_passes(tmp_path):
    heights = torch.zeros(200, 200)
    heights[:, :20] = wave(2.0)[:200, :20]
    np.save(tmp_path / "border.npy", heights.numpy())
    assert ArrayMask(tmp_path / "border.npy", "height", 2.0).build(GREEN).values.shape == (200, 200)


def test_phases_are_heights_at_their_wavelength(generator):
    height = torch.rand(9, 12, generator=generator)
    phase = 2 * math.pi * 0.5 * height / 0.6  # index 1.5, 600 nm
    lower = phase - phase.max() + phase.min()  # a constant delays all light alike
    masks = [
        make_mask(height, "height", pitch_um=2.0, index=1.5),
        make_mask(phase, "phase", pitch_um=2.0, index=1.5, phase_nm=600.0),
        make_mask(lower, "phase", pitch_um=2.0, index=1.5, phase_nm=600.0),
    ]
    for mask in masks:
        assert (mask.kind, mask.index, mask.step_um) == ("phase", 1.5, 0.0)
        torch.testing.assert_close(mask.values - mask.values.min(), height - height.min())


def test_squares_subdivided_are_a_coded_aperture():
    code, design = separable_mls(4), CodedAperture(order=4, feature_um=10.0, pitch_um=2.0)
    mask = make_mask(code, "amplitude", pitch_um=10.0, subdivide=5)
    assert mask.pitch_um == 2.0
    assert torch.equal(mask.values, design.build(GREEN).values)
    assert torch.equal(make_mask(code / 4, "transmission", pitch_um=10.0).values, code / 2)


def test_the_mask_of_a_design_gives_the_same_psf(tmp_path):
    setup = replace(GREEN, band_nm=(450.0, 650.0), wavelengths=2, colour=True)
    mask = Contour(size_mm=(0.4, 0.4), iterations=3).build(setup)
    write_mask(tmp_path / "mask.tif", mask)
    again = ArrayMask(tmp_path / "mask.tif").build(setup)
    assert torch.equal(mask_psf(again, setup), mask_psf(mask, setup))
    for name, value in (("pitch_um", 2.0), ("index", 1.6), ("subdivide", 3), ("phase_nm", 532.0), ("levels", 8)):
        with pytest.raises(ParameterError, match=f"leave out `{name}`"):
            ArrayMask(tmp_path / "mask.tif", **{name: value}).build(setup)


def test_files(tmp_path):
    """Floats are in their unit, integers parts of the full scale, true and false open and opaque."""
    numbers = np.random.default_rng(0).integers(0, 65536, (8, 9), dtype=np.uint16)
    light = torch.from_numpy(numbers / np.float32(65535))
    np.save(tmp_path / "float.npy", numbers / 131070)
    np.save(tmp_path / "open.npy", numbers > 30000)
    cv2.imwrite(str(tmp_path / "grey.png"), numbers)
    cv2.imwrite(str(tmp_path / "colour.tif"), np.stack([numbers] * 3, -1))

    def values(name, **options):
        return ArrayMask(tmp_path / name, pitch_um=2.0, **options).build(GREEN).values

    torch.testing.assert_close(values("float.npy", values="height"), light / 2)
    for name in ("grey.png", "colour.tif"):
        torch.testing.assert_close(values(name, values="height", full_scale=0.3), 0.3 * light)
        torch.testing.assert_close(values(name, values="amplitude"), light)
    assert torch.equal(values("open.npy", values="amplitude"), torch.from_numpy(numbers > 30000).float())


@pytest.mark.parametrize(
    ("array", "options", "error", "message"),
    [
        (np.zeros((4, 5, 6)), {}, ShapeError, r"\(4, 5, 6\)"),
        (np.zeros(4), {}, ShapeError, r"\(4,\)"),
        (np.full((4, 4), np.nan), {}, ImageError, "NaN"),
        (np.zeros((4, 4), complex), {}, ImageError, "complex128"),
        (np.full((4, 4), 1.5), {"values": "amplitude"}, ParameterError, r"1\.5 to 1\.5"),
        (np.full((4, 4), -0.1), {"values": "transmission"}, ParameterError, r"-0\.1 to -0\.1"),
        (np.diag([0.0, 1200.0]), {}, ParameterError, r"0 to 1200 um.*nm"),
        (np.zeros((1, 4)), {}, ParameterError, "1 x 4 samples"),
        (np.zeros((4, 4)), {"subdivide": 6000}, ParameterError, "24,000 x 24,000"),
        (np.zeros((4, 4)), {"subdivide": 0}, ParameterError, r"`subdivide` \(0\)"),
        (np.zeros((4, 4)), {"pitch_um": -1.0}, ParameterError, r"`pitch_um` \(-1\)"),
        (np.zeros((4, 4)), {"pitch_um": None}, ParameterError, "`values='height', pitch_um=2`"),
        (np.zeros((4, 4)), {"values": None}, ParameterError, "height, phase"),
        (np.zeros((4, 4)), {"index": 1.0}, ParameterError, r"`index` \(1\)"),
        (np.zeros((4, 4)), {"full_scale": 1.0}, ParameterError, "`full_scale`"),
        (np.zeros((4, 4), np.uint8), {}, ParameterError, "`full_scale`.* um that 255"),
        (np.zeros((4, 4), np.uint8), {"full_scale": -1.0}, ParameterError, r"`full_scale` \(-1\)"),
        (np.eye(4, dtype=np.uint8), {"full_scale": 0.5, "values": "amplitude"}, ParameterError, "`full_scale`"),
    ],
)
def test_what_cannot_be_a_mask(tmp_path, array, options, error, message):
    np.save(tmp_path / "mask.npy", array)
    options = {"values": "height", "pitch_um": 2.0} | options
    with pytest.raises(error, match=message):
        ArrayMask(tmp_path / "mask.npy", **options).build(GREEN)


@pytest.mark.parametrize("numbers", [np.ones((8, 8)), torch.ones(1, 8, 8)])
@pytest.mark.usefixtures("unchecked")
def test_only_a_tensor_of_two_axes_is_a_mask(numbers):
    with pytest.raises(ParameterError, match=r"must be a tensor \(H, W\)"):
        make_mask(numbers, "height", pitch_um=2.0)


def test_bad_files_are_named(tmp_path):
    (tmp_path / "text.npy").write_text("no numbers")
    cv2.imwrite(str(tmp_path / "colour.png"), np.arange(48, dtype=np.uint8).reshape(4, 4, 3))
    for name, text in (("none.npy", "does not exist"), ("text.npy", "NPY"), ("colour.png", "colours")):
        with pytest.raises(MwdnError, match=text):
            ArrayMask(tmp_path / name, "amplitude", 2.0).build(GREEN)

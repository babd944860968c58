"""Random cameras: valid PSFs that differ from each other and resemble measured ones."""

import math
from functools import cache

import numpy as np
import pytest
import torch

from mwdn.calibration import Calibration
from mwdn.errors import ParameterError, UnknownNameError
from mwdn.optics import FAMILIES, Variety, random_psf, sample_camera
from mwdn.optics.drawing import contour_lines, scatter_light, smooth_field

SIZE = 61, 84
CLEAN = Variety(
    support=(0.7, 0.7),
    offset=0.0,
    turn_degrees=0.0,
    halo=(0.0, 0.0),
    glow=(0.0, 0.0),
    background=(0.0, 0.0),
    speckle=(0.0, 0.0),
    grey=1.0,
)


@pytest.mark.parametrize("family", FAMILIES)
@pytest.mark.parametrize("size", [SIZE, (8, 8), (9, 200), (120, 33)])
def test_a_psf_of_any_size(family, size):
    psf = sample_camera(3, size, family=family)
    assert psf.shape == (1, 3, *size)
    assert psf.dtype == torch.float32
    assert psf.isfinite().all()
    assert psf.min() >= 0
    torch.testing.assert_close(psf.double().sum((-2, -1)), torch.ones(1, 3, dtype=torch.float64), rtol=0, atol=1e-5)
    Calibration(psf)  # checks that the PSF is valid


@pytest.mark.parametrize("family", FAMILIES)
def test_same_seed_same_camera(family):
    first, again = (sample_camera(7, SIZE, family=family) for _ in range(2))
    generator = torch.Generator().manual_seed(7)
    assert torch.equal(first, again)
    assert torch.equal(first, sample_camera(generator, SIZE, family=family))
    assert not torch.equal(first, sample_camera(generator, SIZE, family=family))


def test_the_global_generator_is_left_alone():
    before = torch.get_rng_state()
    sample_camera(1, SIZE)
    assert torch.equal(torch.get_rng_state(), before)


def test_cameras_are_distinct():
    """Among sixty PSFs no pair correlates by 0.95 at its best shift; the highest is 0.91, of two zone plates."""
    psfs = torch.cat([sample_camera(seed, (64, 64)) for seed in range(60)]).mean(1)
    spectra = torch.fft.rfft2(psfs - psfs.mean((-2, -1), keepdim=True))
    energy = psfs.sub(psfs.mean((-2, -1), keepdim=True)).square().sum((-2, -1))
    for i in range(len(psfs) - 1):
        likeness = torch.fft.irfft2(spectra[i] * spectra[i + 1 :].conj(), s=(64, 64)).amax((-2, -1))
        assert (likeness / (energy[i] * energy[i + 1 :]).sqrt()).max() < 0.95


def test_every_family_occurs_as_often(monkeypatch):
    """400 draws of 5 families: each count is 80, within 5 standard deviations, sqrt(400 / 5 * 4 / 5)."""
    counts = dict.fromkeys(FAMILIES, 0)

    def counted(name, draw):
        def wrapped(*arguments):
            counts[name] += 1
            return draw(*arguments)

        return wrapped

    monkeypatch.setattr(random_psf, "FAMILIES", {name: counted(name, draw) for name, draw in FAMILIES.items()})
    for seed in range(400):
        sample_camera(seed, (8, 8))
    assert all(abs(count - 80) < 40 for count in counts.values()), counts


@pytest.mark.parametrize("size", [(64, 64), (65, 65), (64, 97), (51, 80)])
def test_the_centre_is_the_pixel_that_stands_for_no_displacement(size):
    """A zone plate without offset and noise is symmetric about its centre."""
    psf = sample_camera(0, size, family="zone-plate", variety=CLEAN)[0, 1]
    turned = psf.flip((0, 1)).roll([1 - n % 2 for n in size], (0, 1))
    torch.testing.assert_close(turned, psf, rtol=1e-3, atol=1e-3 * psf.max().item())


def test_offset_moves_the_light():
    """The centroid of the aperture moves up to the largest offset, and no farther."""
    size, farthest = (80, 120), 0.0
    variety = Variety(**{**vars(CLEAN), "offset": 0.1, "support": (0.5, 0.5)})
    for seed in range(20):
        psf = sample_camera(seed, size, family="zone-plate", variety=variety)[0, 0]
        for axis, n in enumerate(size):
            centroid = (psf.sum(1 - axis) * torch.arange(n)).sum().item()
            distance = abs(centroid - n // 2) / n
            assert distance < 0.11
            farthest = max(farthest, distance)
    assert farthest > 0.05


def test_colours_are_alike_if_grey_and_differ_otherwise():
    grey, coloured = (Variety(grey=part, colour_blur=0.0) for part in (1.0, 0.0))
    psf = sample_camera(2, SIZE, variety=grey)
    torch.testing.assert_close(psf[:, :1].expand_as(psf), psf)
    psf = sample_camera(2, SIZE, variety=coloured)
    for a, b in ((0, 1), (1, 2), (2, 0)):
        assert (psf[0, a] - psf[0, b]).abs().sum() > 0.01


def test_background_is_what_was_asked_for():
    """A background of 20 % gives each of the n pixels 20 % / n of the sum."""
    variety = Variety(**{**vars(CLEAN), "background": (0.2, 0.2), "support": (0.4, 0.4)})
    psf = sample_camera(4, (96, 96), family="separable", variety=variety)
    corner = psf[..., :5, :5] * 96 * 96
    torch.testing.assert_close(corner, torch.full_like(corner, 0.2), rtol=0.02, atol=0)


@pytest.mark.parametrize("device", ["cuda", "mps"])
def test_a_gpu_gives_the_camera_of_the_cpu(device):
    if not getattr(torch, device).is_available():
        pytest.skip(f"no {device} here")
    for family in FAMILIES:
        expected, result = sample_camera(5, SIZE, family=family), sample_camera(5, SIZE, family=family, device=device)
        assert result.device.type == device
        torch.testing.assert_close(result.cpu(), expected, rtol=1e-3, atol=1e-3 * expected.max().item())


def test_scattered_light_is_conserved_and_its_centroid_kept(generator):
    rows, columns = 2 + 16 * torch.rand(2, 500, generator=generator)
    power = torch.rand(500, generator=generator)
    light = scatter_light(rows, columns, power, (20, 20))
    axis = torch.arange(20.0)
    torch.testing.assert_close(light.sum(), power.sum(), rtol=1e-4, atol=0)
    torch.testing.assert_close((light.sum(1) * axis).sum(), (rows * power).sum(), rtol=1e-4, atol=0)
    torch.testing.assert_close((light.sum(0) * axis).sum(), (columns * power).sum(), rtol=1e-4, atol=0)
    order = torch.randperm(500, generator=generator)
    assert torch.equal(light, scatter_light(rows[order], columns[order], power[order], (20, 20)))


def test_rays_beside_the_frame_are_lost():
    rows, columns = torch.tensor([-0.5, -7.0, 4.5, 90.0, 2.0]), torch.tensor([2.0, 2.0, 3.0, 2.0, -1.0])
    light = scatter_light(rows, columns, torch.ones(5), (5, 6))
    expected = torch.zeros(5, 6)
    expected[0, 2] = expected[4, 3] = 0.5
    torch.testing.assert_close(light, expected)


def test_field_has_the_waves_asked_for(generator):
    field = smooth_field((128, 128), 16.0, bandwidth=0.1, generator=generator)
    power = torch.fft.rfft2(field).abs().square()
    rows, columns = torch.fft.fftfreq(128)[:, None], torch.fft.rfftfreq(128)
    frequency = (rows**2 + columns**2).sqrt()
    assert abs((power * frequency).sum() / power.sum() - 1 / 16) < 0.1 / 16
    assert abs(field.mean()) < 1e-5
    assert math.isclose(field.var(correction=0), 1, rel_tol=1e-5)


def test_contour_line_of_a_ramp_has_its_width():
    ramp = (torch.arange(41.0) - 20).expand(30, -1) * 0.3
    line = contour_lines(ramp, 6.0)
    expected = torch.exp(-4 * math.log(2) * (torch.arange(41.0) - 20).square() / 36)
    torch.testing.assert_close(line, expected.expand(30, -1), rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize(
    "wrong",
    [{"glow": (0.5, 0.2)}, {"halo": (0.0, 1.0)}, {"support": (0.0, 1.0)}, {"offset": -0.1}, {"speckle": (-1.0, 0.0)}],
)
def test_impossible_varieties_are_refused(wrong):
    with pytest.raises(ParameterError, match=next(iter(wrong))):
        Variety(**wrong)


@pytest.mark.parametrize(
    "wrong", [{"support": 0.5}, {"offset": (0.0, 0.1)}, {"halo": None}, {"support": (0.1, 0.2, 0.3)}]
)
@pytest.mark.usefixtures("unchecked")
def test_a_range_is_no_number(wrong):
    with pytest.raises(ParameterError, match=next(iter(wrong))):
        Variety(**wrong)
    assert Variety(halo=[0.0, 0.2]).halo == [0.0, 0.2]  # as of JSON


@pytest.mark.usefixtures("unchecked")
def test_numpys_numbers_are_seeds():
    assert torch.equal(sample_camera(np.int64(3), (16, 24)), sample_camera(3, (16, 24)))


@pytest.mark.parametrize(("seed", "size"), [(1.5, (16, 16)), (None, (16, 16)), (2**70, (16, 16)), (0, 16)])
@pytest.mark.usefixtures("unchecked")
def test_arguments_of_other_types_are_named(seed, size):
    with pytest.raises(ParameterError, match="of `sample_camera` must be"):
        sample_camera(seed, size)


def test_wrong_calls():
    with pytest.raises(UnknownNameError, match="Did you mean 'contours'"):
        sample_camera(0, SIZE, family="contour")
    with pytest.raises(ParameterError, match="at least 8 x 8"):
        sample_camera(0, (7, 20))


def measures(psf):
    """Contrast, peak, part of the pixels with half of the light, and amplitude of four bands of the spectrum."""
    psf = psf.mean(1)[0]
    mean = psf.mean()
    light = psf.flatten().sort(descending=True).values.cumsum(0)
    spectrum = torch.fft.rfft2(psf).abs().square()
    rows, columns = torch.fft.fftfreq(psf.shape[0])[:, None], torch.fft.rfftfreq(psf.shape[1])
    frequency = (rows**2 + columns**2).sqrt()
    bands = [spectrum[(frequency >= a) & (frequency < 2 * a)].mean().log10() for a in (0.03, 0.06, 0.12, 0.24)]
    return torch.stack([psf.std() / mean, psf.max() / mean, (light < 0.5 * light[-1]).float().mean(), *bands])


@cache
def drawn(family):
    return torch.stack([measures(sample_camera(seed, (320, 320), family=family)) for seed in range(40)])


@pytest.mark.acceptance
@pytest.mark.parametrize(
    ("family", "file", "options"),
    [
        ("contours", "mwdn-camera/psf_320.png", {}),
        ("contours", "phlatcam/psf_384x640.npy", {}),
        ("caustics", "diffusercam/psf_recovered_270x480.npy", {"upside_down": True, "bgr": True}),
        ("caustics", "diffusercam-tutorial/psf_sample.tif", {"bin": 4}),
    ],
)
def test_measured_cameras_lie_within_their_family(family, file, options, data):
    """Measured PSFs lie within the range of 40 random ones in each measure."""
    measured = measures(Calibration.from_file(data / file, **options).psf)
    low, high = drawn(family).aminmax(dim=0)
    assert (measured >= low).all(), (measured, low)
    assert (measured <= high).all(), (measured, high)

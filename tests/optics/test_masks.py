"""Masks against their known properties, and the PSF of a camera with a mask."""

import dataclasses
import math

import numpy as np
import pytest
import torch

from mwdn.errors import ParameterError, UnknownNameError
from mwdn.optics import MASKS, amplitude_masks
from mwdn.optics.amplitude_masks import CodedAperture, Pinholes, ZoneAperture
from mwdn.optics.deviation import Deviation
from mwdn.optics.drawing import contours
from mwdn.optics.field import Aberration
from mwdn.optics.masks import Mask, mask_psf
from mwdn.optics.phase_masks import Contour, Diffuser, Lenslets
from mwdn.optics.phase_retrieval import retrieve_phase
from mwdn.optics.propagation import coordinates, point_source, propagate
from mwdn.optics.setup import Setup

SMALL = Setup(aperture_mm=(0.5, 0.4), pixels=(256, 240), wavelengths=3)
"""64 x 60 pixels of 9.6 um: 0.61 x 0.58 mm."""

CONTOUR = Contour(size_mm=(0.6, 0.5), iterations=8)


def green(setup=SMALL):
    return dataclasses.replace(setup, band_nm=(533.6, 533.6), wavelengths=1, colour=False)


# --- Phase ------------------------------------------------------------------------------------------------


def test_contour_mask_of_the_paper_has_its_numbers():
    """8 x 145 nm of fused silica delay green light by one wave; the highest of the 8 levels by 7/8 of it."""
    design = Contour()
    assert (design.size_mm, design.pitch_um, design.levels, design.step_nm) == ((7.0, 7.0), 2.0, 8, 145.0)
    assert design.design_nm == pytest.approx(533.6)
    mask = CONTOUR.build(SMALL)
    assert mask.values.shape == (300, 250)
    assert mask.size_mm == pytest.approx((0.6, 0.5))
    levels = mask.values / 0.145
    torch.testing.assert_close(levels, levels.round(), rtol=0, atol=1e-5)
    assert levels.round().unique().tolist() == list(range(8))
    delay = mask.field(533.6)[mask.values == mask.values.max()][0]
    assert torch.angle(delay).item() / (2 * math.pi) % 1 == pytest.approx(7 / 8, abs=1e-5)


def test_contour_mask_puts_the_light_onto_its_lines():
    """The lines receive many times the light that falls onto their area without a mask."""
    design = CONTOUR
    mask = design.build(green())
    lines = contours((300, 250), line=4.0, spacing=52.0, generator=torch.Generator().manual_seed(0)) > 0.3
    light = {"pitch_um": 2.0, "wavelength_nm": 533.6}
    field = mask.field(533.6) * point_source((300, 250), distance_mm=200.0, **light)
    behind = propagate(field, distance_mm=2.0, **light).abs().square()
    part = (behind * lines).sum() / (300 * 250)
    assert lines.double().mean() < 0.15
    assert part > 0.6
    fine = dataclasses.replace(design, levels=64, step_nm=145 / 8).build(green())
    coarse = dataclasses.replace(design, levels=2, step_nm=145 * 4.0).build(green())
    parts = []
    for each in (fine, coarse):
        field = each.field(533.6) * point_source((300, 250), distance_mm=200.0, **light)
        parts.append((propagate(field, distance_mm=2.0, **light).abs().square() * lines).sum().item() / (300 * 250))
    # The efficiency of N levels is sinc^2(1 / N) of that of a smooth surface: 0.95 for 8, 0.41 for 2.
    assert part.item() / parts[0] == pytest.approx(np.sinc(1 / 8) ** 2, abs=0.03)
    assert parts[1] / parts[0] < 0.62


def test_phase_retrieval_finds_a_lens():
    """The phase that focuses light into a spot is a thin lens, up to a constant."""
    count, focal = 100, 1.0
    light = {"pitch_um": 2.0, "wavelength_nm": 500.0}
    y, x = coordinates(count, 2.0)[:, None], coordinates(count, 2.0)
    spot = torch.zeros(count, count)
    spot[50, 50] = 1
    phase = retrieve_phase(spot, torch.ones(count, count).to(torch.complex64), distance_mm=focal, **light)
    behind = propagate(torch.polar(torch.ones(count, count), phase), distance_mm=focal, **light).abs().square()
    lens = torch.polar(torch.ones(count, count).double(), -2 * math.pi / 0.5 * (y**2 + x**2 + 1e6).sqrt())
    best = propagate(lens.to(torch.complex64), distance_mm=focal, **light).abs().square()
    assert behind.argmax() == best.argmax() == 50 * count + 50
    assert behind.max() > 0.8 * best.max()


def test_contours_are_as_wide_and_as_far_apart_as_asked():
    lines = contours((600, 600), line=5.0, spacing=50.0, generator=torch.Generator().manual_seed(1))
    bright = lines[100:500, 100:500] > 0.5
    # On a straight cut the lines take width / distance of the length; oblique angles lengthen both alike.
    assert bright.float().mean().item() == pytest.approx(5 / 50, rel=0.35)
    power = np.fft.fft2(lines.numpy() - lines.mean().item())
    radius = np.hypot(np.fft.fftfreq(600)[:, None], np.fft.fftfreq(600))
    ring = np.bincount((radius * 200).astype(int).ravel(), (abs(power) ** 2).ravel())
    ring /= np.bincount((radius * 200).astype(int).ravel())
    assert ring[1:].argmax() + 1 == pytest.approx(200 / 50, abs=1)


def test_diffuser_turns_light_by_its_angle_and_has_its_features():
    design = Diffuser(size_mm=(3.0, 3.0), pitch_um=5.0, feature_um=100.0, deflection_degrees=0.8)
    height = design.build(SMALL).values.double()
    for axis in (0, 1):
        slope = height.diff(dim=axis) / 5.0 * (design.index - 1)
        assert math.degrees(math.atan(slope.square().mean().sqrt())) == pytest.approx(0.8, rel=0.1)
    centred = height - height.mean()
    shifted = (centred[20:] * centred[:-20]).mean() / centred.square().mean()  # 20 x 5 um
    assert shifted.item() == pytest.approx(math.exp(-1), abs=0.08)
    assert height.min() == 0


def test_lenslets_focus_on_the_sensor():
    setup = green(Setup(aperture_mm=(0.5, 0.5), pixels=(256, 256), bin=1, distance_mm=2.0))
    design = Lenslets(size_mm=(0.5, 0.5), spacing_um=160.0, irregularity=0.0)
    mask = design.build(setup)
    psf = mask_psf(mask, setup)[0, 0]
    # A lattice of lenses: the middle one sits on the axis, its neighbours 160 um and 1 % (2 mm / 200 mm) away.
    assert divmod(int(psf.argmax()), 256) == (128, 128)
    beside = psf[126:131, 180:210]
    assert 180 + beside.sum(0).argmax().item() == pytest.approx(128 + 160 * 1.01 / 2.4, abs=1)
    spots = torch.nn.functional.max_pool2d(psf[None], 9, 1, 4)[0]
    assert ((psf == spots) & (psf > 0.3 * psf.max())).sum() == 9
    rounded = dataclasses.replace(design, levels=16).build(setup)
    assert len(rounded.values.unique()) == 16
    assert (rounded.values - mask.values).abs().max() <= rounded.step_um / 2 + 1e-5


# --- Amplitude --------------------------------------------------------------------------------------------


def test_zone_aperture_opens_and_closes_at_its_radii():
    mask = ZoneAperture(size_mm=(2.0, 2.0), zone_um=300.0).build(SMALL)
    along = mask.values[500, 500:].numpy()
    changes = np.flatnonzero(np.diff(along)) * 2.0 + 1.0
    expected = 300.0 * np.sqrt(np.arange(len(changes)) + 0.5)
    np.testing.assert_allclose(changes, expected, atol=1.0)
    assert along[0] == 1


@pytest.mark.parametrize("order", sorted(amplitude_masks._TAPS))
def test_mls_has_the_flat_spectrum_of_maximum_length(order):
    """Circular autocorrelation 2^n - 1 at 0 and -1 elsewhere: no shorter period, no zero in the spectrum."""
    code = amplitude_masks.separable_mls(order).double().numpy()
    row = 2 * code[0] - 1
    correlation = np.fft.ifft(abs(np.fft.fft(row)) ** 2).real
    np.testing.assert_allclose(correlation, [len(row)] + [-1] * (len(row) - 1), atol=1e-6)
    signs = 2 * code - 1
    np.testing.assert_array_equal(signs, np.outer(signs[:, 0], signs[0]) * signs[0, 0])  # of rank 1
    assert set(np.unique(code)) == {0.0, 1.0}


@pytest.mark.parametrize("side", [5, 13, 31])
def test_mura_decodes_to_one_peak(side):
    """Gottesman and Fenimore: its correlation with the decoding array is a delta."""
    code = amplitude_masks.mura(side).double().numpy()
    decoder = 2 * code - 1
    decoder[0, 0] = 1
    correlation = np.fft.ifft2(np.fft.fft2(code) * np.fft.fft2(decoder).conj()).real
    peak = correlation[0, 0]
    correlation[0, 0] = 0
    assert peak > 0.45 * side**2
    np.testing.assert_allclose(correlation, 0, atol=1e-9)


def test_coded_aperture_is_its_pattern_enlarged():
    mask = CodedAperture(order=4, feature_um=10.0).build(SMALL)
    code = amplitude_masks.separable_mls(4)
    assert torch.equal(mask.values, code.repeat_interleave(5, 0).repeat_interleave(5, 1))


def test_pinholes_have_their_number_and_area():
    from scipy.ndimage import label

    mask = Pinholes(size_mm=(1.0, 1.5), count=12, diameter_um=40.0).build(SMALL)
    assert label(mask.values.numpy())[1] == 12
    assert mask.values.sum().item() * 4 == pytest.approx(12 * math.pi * 20**2, rel=0.03)
    for seed in range(5):  # no part of a large hole is beyond the border
        large = Pinholes(size_mm=(0.1, 0.1), count=1, diameter_um=90.0, seed=seed).build(SMALL)
        assert large.values.sum().item() * 4 == pytest.approx(math.pi * 45**2, rel=0.03)


# --- PSF ------------------------------------------------------------------------------------------------


def test_pinhole_makes_a_shadow_of_its_size_in_the_middle():
    """0.5 mm behind a hole of 100 um: all light of the hole, magnified by 1 + 0.5 / 200."""
    values = torch.zeros(251, 251)
    values[100:151, 100:151] = 1
    setup = green(Setup(distance_mm=0.5, aperture_mm=(0.5, 0.5), pixels=(128, 128), bin=1))
    psf = mask_psf(Mask("amplitude", values, 2.0), setup)[0, 0].double()
    assert psf.sum().item() == pytest.approx((51 * 2.0) ** 2 / 500.0**2, rel=0.03)
    places = coordinates(128, 2.4)
    for axis in (0, 1):
        profile = psf.sum(1 - axis)
        assert (profile * places).sum() / profile.sum() == pytest.approx(0.0, abs=0.05)
        # A band of width a has the second moment a^2 / 12; the tails of diffraction are cut at 75 um.
        near = places.abs() < 75
        second = (profile * places**2)[near].sum() / profile[near].sum()
        assert second.sqrt().item() == pytest.approx(102 * 1.0025 / math.sqrt(12), rel=0.05)


def test_source_above_the_axis_casts_the_pattern_below():
    mask = Pinholes(size_mm=(0.4, 0.4), count=3, diameter_um=40.0).build(SMALL)
    straight, tilted = (
        mask_psf(mask, green(), angle_degrees=angle)[0, 0].double() for angle in ((0.0, 0.0), (-2.0, 1.0))
    )
    for axis, moved in ((0, 2.0), (1, -1.0)):
        places = coordinates(straight.shape[axis], 9.6)
        middles = [(psf.sum(1 - axis) * places).sum() / psf.sum() for psf in (straight, tilted)]
        assert (middles[1] - middles[0]).item() == pytest.approx(2000 * math.tan(math.radians(moved)), abs=4.0)


def test_all_light_arrives_and_colours_differ():
    """A clear plate smaller than the sensor: 1 in each channel, less the light diffracted beyond the sensor."""
    plate = Mask("phase", torch.zeros(300, 250), 2.0, 1.5)
    psf = mask_psf(plate, SMALL)
    assert psf.shape == (1, 3, 64, 60)
    torch.testing.assert_close(psf.sum((-2, -1)), torch.ones(1, 3), rtol=0, atol=0.03)
    setup = dataclasses.replace(SMALL, wavelengths=13)
    psf = mask_psf(CONTOUR.build(setup), setup)
    lines = psf.flatten(2).sort().values[..., -380:].sum(-1)[0]  # the brightest tenth of the pixels
    assert lines[1] > max(lines[0], lines[2])


def test_finer_pitch_gives_the_same_psf():
    """The diffuser's surface does not depend on the sampling."""
    setup = green()
    coarse, fine = (
        mask_psf(Diffuser(size_mm=(0.6, 0.6), pitch_um=pitch).build(setup), setup)[0, 0] for pitch in (2.0, 1.0)
    )
    surfaces = [Diffuser(size_mm=(0.6, 0.6), pitch_um=pitch).build(setup).values for pitch in (2.0, 1.0)]
    torch.testing.assert_close(surfaces[0], surfaces[1][::2, ::2], rtol=0.02, atol=0.02)
    assert torch.corrcoef(torch.stack([coarse.flatten(), fine.flatten()]))[0, 1] > 0.99


def test_seed_decides():
    for design in (CONTOUR, Diffuser(size_mm=(0.5, 0.5)), Lenslets(size_mm=(0.5, 0.5)), Pinholes(count=4)):
        one, again, other = (dataclasses.replace(design, seed=seed).build(SMALL).values for seed in (1, 1, 2))
        assert torch.equal(one, again)
        assert not torch.equal(one, other)


IMPOSSIBLE = [
    (Contour(pitch_um=-2.0), "`pitch_um` (-2) must be positive"),
    (Contour(pitch_um=0.1), "makes 70,000 x 70,000 samples"),
    (Contour(levels=0), "`levels` (0) must be 2 to 65,536"),
    (Contour(index=1.0), "`index` (1) must be above 1"),
    (Contour(step_nm=1450.0), "= 5336 nm must be in the light's band (400.0, 760.0): try `step_nm` 158."),
    (Contour(size_mm=(1.0, 1.0), pitch_um=20.0, spacing_um=500.0, line_um=40.0), "by 7.1 degrees"),
    (Contour(size_mm=(1.0, 1.0), pitch_um=9.0), "1 <= `line` (0.888889) < `spacing`"),
    (Contour(size_mm=(1.0, 1.0), irregularity=0.0), "`irregularity` (0) must be in (0, 1]"),
    (Contour(size_mm=(1.0, 1.0), iterations=0), "`iterations` (0) must be positive"),
    (Diffuser(levels=1), "`levels` (1) must be 2 to 65,536"),
    (Diffuser(feature_um=5.0), "`feature_um` (5) must be at least 4 samples (8 um)"),
    (Diffuser(deflection_degrees=0.0), "`deflection_degrees` (0) must be positive"),
    (Lenslets(spacing_um=5.0), "`spacing_um` (5) must be at least 4 samples"),
    (Lenslets(irregularity=0.7), "`irregularity` (0.7) must be in [0, 0.5]"),
    (Lenslets(focal_mm=-1.0), "`focal_mm` (-1) must be positive"),
    (ZoneAperture(zone_um=50.0), "cannot sample rings of 0.552 um at the corners: use at most 0.276 um"),
    (CodedAperture(feature_um=3.0), "`pitch_um` (2) cannot sample squares of 3 um: use at most 1.5 um"),
    (CodedAperture(order=40), "`order` (40) of an mls must be 2 to 11"),
    (CodedAperture("mura", 33), "`order` (33) of a mura must be"),
    (Diffuser(deflection_degrees=95.0), "`deflection_degrees` (95) must be below 90"),
    (Pinholes(count=0), "`count` (0) must be positive"),
    (Pinholes(count=20_000), "`count` (20000) holes"),  # its search took days
    (Pinholes(diameter_um=3.0), "`diameter_um` (3) must be at least 2 samples, 4 um"),
    (Pinholes(size_mm=(0.3, 0.3)), "`size_mm` (0.3, 0.3)"),
    (Pinholes(size_mm=(0.1, 0.3), count=1, diameter_um=110.0), "`diameter_um` (110) must be"),
]


@pytest.mark.parametrize(("design", "message"), IMPOSSIBLE, ids=[message[:40] for _, message in IMPOSSIBLE])
def test_impossible_masks(design, message):
    with pytest.raises(ParameterError) as caught:
        design.build(SMALL)
    assert message in str(caught.value)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"distance_mm": -2.0}, "`distance_mm` (-2) must be positive"),
        ({"distance_mm": math.inf}, "`distance_mm` (inf) must be finite"),
        ({"source_mm": 0.0}, "`source_mm` (0) must be positive"),
        ({"aperture_mm": (3.0, 0.0)}, "`aperture_mm` (0) must be positive"),
        ({"pixels": (0, 10)}, "`pixels` (0) must be positive"),
        ({"bin": 2000}, "`bin` (2000) must be at most 1280"),
        ({"bin": 200}, "6 x 6 pixels"),  # too few for the width of its autocorrelation
        ({"pixels": (100_000, 100_000), "bin": 1}, "100,000 x 100,000 pixels"),  # 120 GB
        ({"band_nm": (760.0, 400.0)}, "`band_nm` (760.0, 400.0) must be the shortest and the longest"),
        ({"wavelengths": 0}, "`wavelengths` (0) must be positive"),
        ({"aperture_mm": (math.inf, 1.0)}, "`aperture_mm` (inf, 1.0) must be finite"),
        ({"band_nm": (400.0, math.inf)}, "`band_nm` (400.0, inf) must be finite"),
        ({"distance_mm": "a"}, "`distance_mm` ('a')"),
        ({"source_mm": "inf"}, "`source_mm` ('inf')"),
        ({"aperture_mm": 3.0}, "`aperture_mm` (3.0)"),
        ({"pixels": 1280}, "`pixels` (1280)"),
    ],
)
@pytest.mark.usefixtures("unchecked")
def test_impossible_setups(change, message):
    with pytest.raises(ParameterError) as caught:
        Setup(**change)
    assert message in str(caught.value)


def test_a_star_is_at_infinity():
    assert Setup(source_mm=math.inf).source_mm == math.inf


@pytest.mark.parametrize("kind", [*MASKS.values(), Deviation, Aberration])
@pytest.mark.usefixtures("unchecked")
def test_text_for_a_number_is_refused(kind):
    """It was raw Python's error, for some masks much later."""
    for name, value in {field.name: field.default for field in dataclasses.fields(kind)}.items():
        if isinstance(value, float | tuple):
            with pytest.raises(ParameterError, match=f"`{name}`"):
                kind(**{name: "a"})


def test_pitch_that_cannot_sample_the_surface():
    mask = Diffuser(size_mm=(1.0, 1.0), pitch_um=6.0, deflection_degrees=3.0).build(SMALL)
    with pytest.raises(ParameterError, match=r"`pitch_um` \(6\).* 400 nm .* use at most"):
        mask_psf(mask, SMALL)
    with pytest.raises(ParameterError, match=r"`index` \(1\) must be above 1"):
        Mask("phase", torch.zeros(4, 4), 1.0)


@pytest.mark.usefixtures("unchecked")
def test_another_kind_of_mask_is_refused():
    """It was taken for a phase mask of index 1, which is transparent."""
    with pytest.raises(UnknownNameError, match="Did you mean 'amplitude'"):
        Mask("Amplitude", torch.zeros(4, 4), 1.0)

"""Free space against closed forms: beam, lens, grating, slit; energy, reciprocity, and the checks of sampling."""

import math

import numpy as np
import pytest
import torch
from scipy.special import fresnel, j1

from mwdn.errors import ParameterError
from mwdn.optics.propagation import coordinates, integrate, needed_samples, point_source, propagate

LIGHT = {"pitch_um": 2.0, "wavelength_nm": 500.0}
"""The pitch samples angles up to a sine of 0.125: 0.126 mm of displacement per mm."""


def grid(height, width, pitch=2.0):
    return coordinates(height, pitch)[:, None], coordinates(width, pitch)


def gaussian(shape, waist, *, middle=(0.0, 0.0)):
    y, x = grid(*shape)
    return torch.exp(-((y - middle[0]) ** 2 + (x - middle[1]) ** 2) / waist**2).to(torch.complex64)


@pytest.mark.parametrize("shape", [(160, 160), (161, 144)])
def test_gaussian_beam(shape):
    """Waist 50 um, Rayleigh range 15.7 mm: modulus, curvature of the front and Gouy phase after 10 mm."""
    waist, wavelength, z = 50.0, 0.5, 10_000.0
    result = propagate(gaussian(shape, waist), distance_mm=10.0, **LIGHT)
    rayleigh, k = math.pi * waist**2 / wavelength, 2 * math.pi / wavelength
    y, x = grid(*shape)
    expected = torch.exp(-(y**2 + x**2) / (waist**2 * (1 + 1j * z / rayleigh))) / (1 + 1j * z / rayleigh)
    expected = expected * complex(math.cos(k * z), math.sin(k * z))
    # The paraxial solution is exact to about (wavelength / (pi waist))^2 = 1e-5 per Rayleigh range.
    torch.testing.assert_close(result, expected.to(torch.complex64), rtol=0, atol=3e-4)


def rayleigh_sommerfeld(field, points, pitch, wavelength, z):
    """Direct sum of the first Rayleigh-Sommerfeld integral in float64, numpy."""
    y, x = (coordinates(n, pitch).numpy() for n in field.shape)
    k, out = 2 * np.pi / wavelength, []
    for v, u in points:
        r = np.sqrt((v - y[:, None]) ** 2 + (u - x) ** 2 + z**2)
        kernel = z / (2 * np.pi * r**2) * (1 / r - 1j * k) * np.exp(1j * k * r)
        out.append((field * kernel).sum() * pitch**2)
    return np.array(out)


def test_agrees_with_the_rayleigh_sommerfeld_integral():
    """An independent formula, in space instead of frequency, for a field without symmetry."""
    y, x = grid(64, 81)
    field = gaussian((64, 81), 16.0, middle=(-10.0, 8.0)) + 0.5j * gaussian((64, 81), 12.0, middle=(20.0, -25.0))
    field = field * torch.exp(0.12j * (x - 0.5 * y)).to(torch.complex64)
    result = propagate(field, distance_mm=0.8, size=(101, 90), **LIGHT)
    rows, columns = np.arange(0, 101, 7), np.arange(0, 90, 9)
    points = [((i - 50) * 2.0, (j - 45) * 2.0) for i in rows for j in columns]
    expected = rayleigh_sommerfeld(field.numpy().astype(complex), points, 2.0, 0.5, 800.0)
    np.testing.assert_allclose(result.numpy()[np.ix_(rows, columns)].ravel(), expected, rtol=0, atol=2e-4)


def test_slit_casts_fresnels_shadow():
    """Rectangle 200 x 120 um, 2 mm behind it: products of Fresnel integrals, edges on the samples' borders."""
    height, width, z, wavelength = 100, 60, 2000.0, 0.5
    result = propagate(torch.ones(height, width, dtype=torch.complex64), distance_mm=2.0, size=(160, 120), **LIGHT)

    def along(count, samples):
        places = coordinates(count, 2.0).numpy()
        scale = math.sqrt(2 / (wavelength * z))
        s, c = fresnel(scale * (np.array([-samples, samples])[:, None] - 1 - places))  # the middle sample is at 0
        return (c[1] - c[0] + 1j * (s[1] - s[0])) / np.sqrt(2j)

    expected = abs(np.outer(along(160, height), along(120, width))) ** 2
    intensity = result.abs().square().numpy()
    # The pitch samples 0.25 periods per um; a sharp edge then has ripples of a few percent.
    assert np.sqrt(((intensity - expected) ** 2).mean()) < 0.02
    assert np.corrcoef(intensity.ravel(), expected.ravel())[0, 1] > 0.998


def test_lens_focuses_to_airys_spot():
    """Round lens of 400 um, focal length 4 mm: (2 J1(v) / v)^2 with v = pi D r / (wavelength f)."""
    diameter, focal, wavelength = 400.0, 4000.0, 0.5
    y, x = grid(240, 240)
    radius = torch.hypot(y.expand(-1, 240), x.expand(240, -1))
    lens = torch.polar((radius <= diameter / 2).double(), -math.pi * radius**2 / (wavelength * focal))
    spot = propagate(lens.to(torch.complex64), distance_mm=4.0, size=(41, 41), **LIGHT).abs().square().numpy()
    v = np.pi * diameter * radius[100:141, 100:141].numpy() / (wavelength * focal)
    v[20, 20] = 1e-9
    expected = (2 * j1(v) / v) ** 2
    np.testing.assert_allclose(spot / spot[20, 20], expected, rtol=0, atol=0.01)
    # Strehl: (area / (wavelength f))^2.
    assert spot[20, 20] == pytest.approx((math.pi * diameter**2 / 4 / (wavelength * focal)) ** 2, rel=0.02)


def test_grating_has_the_orders_of_the_equation():
    """Sinusoidal phase of depth 1 and period 20 um: sin = m / 40, efficiency J_m(1)^2; separate after 20 mm."""
    from scipy.special import jv

    shape, period, z = (100, 200), 20.0, 20.0
    _, x = grid(*shape)
    grating = torch.polar(torch.ones(200).double(), torch.sin(2 * math.pi * x / period))
    beam = gaussian(shape, 60.0) * grating.to(torch.complex64)
    far = propagate(beam, distance_mm=z, size=(200, 1500), **LIGHT).abs().square().sum(0).numpy()
    places = coordinates(1500, 2.0).numpy()
    total = gaussian(shape, 60.0).abs().square().sum().item()
    for m in (-2, -1, 0, 1, 2):
        sine = m * 0.5 / period
        middle = z * 1e3 * sine / math.sqrt(1 - sine**2)
        near = abs(places - middle) < 240  # half the distance between two orders
        assert (far[near] * places[near]).sum() / far[near].sum() == pytest.approx(middle, abs=3.0)
        assert far[near].sum() / total == pytest.approx(jv(m, 1.0) ** 2, abs=4e-3)


def test_energy_and_reciprocity(generator):
    """Energy is conserved on a plane wide enough; source and detector can be exchanged."""
    smooth = gaussian((60, 71), 22.0)
    noise = torch.randn(2, 60, 71, generator=generator)
    field = smooth * torch.complex(noise[0], noise[1])
    wide = propagate(field, distance_mm=1.0, size=(400, 400), grid=(420, 450), **LIGHT)
    assert wide.abs().square().sum() == pytest.approx(field.abs().square().sum().item(), rel=1e-3)
    other = gaussian((60, 71), 15.0, middle=(12.0, -20.0))
    forward = (propagate(field, distance_mm=1.0, **LIGHT) * other).sum()
    back = (field * propagate(other, distance_mm=1.0, **LIGHT)).sum()
    assert abs(forward - back) < 1e-4 * abs(forward)


@pytest.mark.parametrize(("first", "second"), [((40, 41), (40, 41)), ((33, 30), (70, 81)), ((64, 64), (9, 12))])
def test_centres_face_each_other(first, second):
    """A spot at sample n // 2 arrives at sample n // 2, whatever the sizes of the two planes."""
    forward = propagate(gaussian(first, 6.0), distance_mm=0.1, size=second, **LIGHT).abs()
    assert forward.shape == second
    assert divmod(int(forward.argmax()), second[1]) == (second[0] // 2, second[1] // 2)


def test_larger_grid_changes_nothing():
    field = torch.ones(50, 50, dtype=torch.complex64)
    needed = needed_samples(50, 80, distance_mm=1.0, **LIGHT)
    small = propagate(field, distance_mm=1.0, size=(80, 80), grid=(needed, needed), **LIGHT).abs().square()
    large = propagate(field, distance_mm=1.0, size=(80, 80), grid=(600, 600), **LIGHT).abs().square()
    assert (small - large).abs().max() < 0.02 * large.max()
    with pytest.raises(ParameterError, match=rf"`grid` \(100 x 100\) lets light wrap .* at least {needed} x {needed}"):
        propagate(field, distance_mm=1.0, size=(80, 80), grid=(100, 100), **LIGHT)


def test_point_source_is_a_sphere_and_far_away_a_plane():
    near = point_source((9, 12), distance_mm=1.0, angle_degrees=(3.0, -2.0), **LIGHT)
    y, x = grid(9, 12)
    place = [1000 * math.tan(math.radians(angle)) for angle in (3.0, -2.0)]
    r = torch.sqrt((y - place[0]) ** 2 + (x - place[1]) ** 2 + 1e6)
    expected = r[4, 6] / r * torch.exp(2j * math.pi / 0.5 * (r - r[4, 6]))
    torch.testing.assert_close(near, expected.to(torch.complex64), rtol=0, atol=1e-5)
    plane = point_source((9, 12), angle_degrees=(3.0, -2.0), **LIGHT)
    far = point_source((9, 12), distance_mm=1e7, angle_degrees=(3.0, -2.0), **LIGHT)
    torch.testing.assert_close(plane, far, rtol=0, atol=2e-3)


def test_light_from_above_goes_down():
    """Light of a point above the axis (a negative angle) lands below the axis behind the mask."""
    field = gaussian((120, 120), 40.0) * point_source((120, 120), angle_degrees=(-3.0, 2.0), **LIGHT)
    spot = propagate(field, distance_mm=1.0, **LIGHT).abs().square().double()
    y, x = grid(120, 120)
    assert ((spot * y).sum() / spot.sum()).item() == pytest.approx(1000 * math.tan(math.radians(3)), abs=1.0)
    assert ((spot * x).sum() / spot.sum()).item() == pytest.approx(-1000 * math.tan(math.radians(2)), abs=1.0)


@pytest.mark.parametrize("pixel", [1.0, 2.0, 2.4, 7.0])
def test_pixels_collect_all_light(pixel, generator):
    light = torch.rand(30, 41, generator=generator)
    result = integrate(light, pitch_um=2.0, size=(90, 100), pixel_um=pixel)
    assert result.sum() == pytest.approx(light.sum().item(), rel=1e-5)


def test_pixels_as_large_as_samples_are_the_samples_and_bins_their_sums(generator):
    light = torch.rand(12, 15, generator=generator)
    torch.testing.assert_close(integrate(light, pitch_um=2.0, size=(12, 15), pixel_um=2.0), light)
    # Pixel 2 of 5 spans three samples around sample 7: 6, 7, 8.
    binned = integrate(light[:9], pitch_um=2.0, size=(3, 5), pixel_um=6.0)
    torch.testing.assert_close(binned, light[:9].reshape(3, 3, 5, 3).sum((1, 3)))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"pitch_um": -2.0}, r"`pitch_um` \(-2\) must be positive"),
        ({"wavelength_nm": 0.0}, r"`wavelength_nm` \(0\) must be positive"),
        ({"distance_mm": -1.0}, r"`distance_mm` \(-1\) must be positive"),
    ],
)
def test_impossible_lengths(change, message):
    for function, first in ((propagate, torch.ones(4, 4, dtype=torch.complex64)), (point_source, (4, 4))):
        with pytest.raises(ParameterError, match=message):
            function(first, **(LIGHT | {"distance_mm": 1.0} | change))


def test_pitch_that_cannot_sample_the_angle():
    with pytest.raises(ParameterError, match=r"`pitch_um` \(2\) cannot sample .* use at most 0\.966 um"):
        point_source((4, 4), angle_degrees=(0.0, 15.0), **LIGHT)
    with pytest.raises(ParameterError, match="within 90 degrees"):
        point_source((4, 4), angle_degrees=(0.0, 90.0), **LIGHT)

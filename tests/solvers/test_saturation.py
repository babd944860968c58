"""Saturated pixels: where they are found, and that solvers take them for a lower bound of the light."""

import numpy as np
import pytest
import torch
from scipy.optimize import minimize_scalar
from torch.nn import functional as F

from cameras import contour_psf
from mwdn import convolve
from mwdn.inference.methods import find_method
from mwdn.optics.room_light import sloping_light, spot_light
from mwdn.optics.saturation import saturated_pixels, subtract_light
from mwdn.solvers import Admm, Penalties, Pyramid
from mwdn.solvers.plug_and_play import plug_and_play
from mwdn.solvers.proximal import Variation
from mwdn.solvers.pyramid import solve
from mwdn.solvers.splitting import Problem, initial_state, update_copies

SIZE = 96, 128


def camera(generator):
    """A PSF, a scene on dark and its light on the sensor, of maximum 1."""
    psf = contour_psf(SIZE, cell=16, generator=generator)
    blocks = F.interpolate(torch.rand(1, 1, 3, 4, generator=generator), (48, 64), mode="nearest")
    scene = F.pad(blocks, (32, 32, 24, 24))
    light = convolve(scene, psf)
    return psf, scene / light.max(), light / light.max()


def overexposed(light):
    """A twentieth of its pixels saturated."""
    return light.clamp(max=float(light.quantile(0.95)))


def test_saturated_pixels_stay_a_bound_below_other_light(generator):
    """A slope is subtracted: the plateau is the least that remains of it, never more than the scene's light."""
    _, _, light = camera(generator)
    room = 0.2 * light.mean() * sloping_light(SIZE, 0.6)
    capture = overexposed(light + room)
    rest = subtract_light(capture, room.expand_as(capture))
    was, now = saturated_pixels(capture), saturated_pixels(rest)
    assert was.any()
    assert now[was].all()
    assert (rest[now] <= light[now] + 1e-6).all()
    torch.testing.assert_close(rest[~now], light[~now])
    assert torch.equal(subtract_light(capture, torch.zeros_like(capture)), capture)


def test_a_hot_pixel_of_the_dark_frame_is_no_bound(generator):
    _, _, light = camera(generator)
    capture = overexposed(light)
    dark = torch.full_like(capture, 0.01 * float(capture.max()))
    row, column = saturated_pixels(capture)[0, 0].nonzero()[0].tolist()
    dark[..., row, column] = 0.4 * capture.max()
    row, column = divmod(int(capture.argmin()), capture.shape[-1])  # another one, away from the plateau
    dark[..., row, column], capture[..., row, column] = 0.4 * capture.max(), capture.max()
    rest = subtract_light(capture, dark)
    assert rest.max() == pytest.approx(0.99 * float(capture.max()), rel=0.005)


def test_a_lamp_that_saturates_by_itself_is_no_bound_of_the_scene():
    lamp = spot_light(SIZE, (0.3, 0.3), 0.1)[None, None]
    capture = (0.3 + lamp / lamp.max()).clamp(max=0.8)
    rest = subtract_light(capture, lamp / lamp.max())
    assert (rest[lamp < 0.1 * lamp.max()] > 0.29).all()


@pytest.mark.parametrize("gain", [1e-6, 1.0, 50.0])
@pytest.mark.parametrize("black", [0.0, 0.02])
def test_found_at_any_scale_and_black_level(gain, black, generator):
    _, _, light = camera(generator)
    noisy = light + 0.003 * torch.randn(light.shape, generator=generator)
    measurement = gain * (noisy.clamp(max=0.7) - black)
    assert (saturated_pixels(measurement) == (noisy >= 0.7 * 0.995 + 0.005 * black)).all()
    assert not saturated_pixels(gain * noisy).any()


def test_each_colour_by_itself(generator):
    _, _, light = camera(generator)
    measurement = torch.cat([light.clamp(max=0.6), light, 0.5 * light], 1)
    found = saturated_pixels(measurement)
    assert found[:, 0].any()
    assert not found[:, 1:].any()


def test_what_is_no_plateau(generator):
    """Few levels of grey, a few hot pixels, an even or dark frame, and frames with NaN."""
    _, _, light = camera(generator)
    hot = light.clone()
    hot[0, 0, 10, 10:14] = 1.7
    for measurement in (
        (30 * light).round() / 30,
        hot,
        torch.ones(1, 3, 40, 40),
        torch.zeros(1, 1, 40, 40),
        torch.ones(1, 1, 1, 1),
        torch.full((1, 1, 40, 40), torch.nan),
    ):
        assert not saturated_pixels(measurement).any()


def test_the_data_step_is_the_proximal_map_of_a_lower_bound(generator):
    """Against scipy: x = argmin f(x) + mu/2 (x - z)^2, with f(x) = 1/2 min(x - b, 0)^2 where b is saturated."""
    psf, _, light = camera(generator)
    small = light[..., :4, :5].clamp(max=0.3)
    saturated = torch.rand(small.shape, generator=generator) < 0.5
    problem = Problem.from_psf(small, psf[..., :4, :5])._replace(saturated=saturated)
    state = initial_state(problem, torch.rand(1, 1, *problem.grid, generator=generator), smooth=False)
    state = state._replace(data_target=state.Hv + 0.3 * torch.randn(small.shape, generator=generator))
    mu = Penalties(0.4, 0.0, 0.5)
    variation: Variation = "colour"
    found = update_copies(state, problem, mu, 0.0, variation).data_target
    z = (2 * state.Hv - state.data_target).double().numpy().ravel()
    expected = []
    for argument, bound, free in zip(z, small.numpy().ravel(), saturated.numpy().ravel(), strict=True):

        def cost(x, argument=argument, bound=bound, free=free):
            misfit = min(x - bound, 0.0) if free else x - bound
            return 0.5 * misfit**2 + 0.2 * (x - argument) ** 2

        expected.append(minimize_scalar(cost, bounds=(-5, 5), method="bounded", options={"xatol": 1e-9}).x)
    x = found - state.Hv + torch.from_numpy(z).reshape(found.shape)  # target = H v - (z - x)
    np.testing.assert_allclose(x.numpy().ravel(), expected, atol=1e-5)


def test_an_overexposed_capture_is_as_good_as_a_right_one(generator):
    """Where ADMM, which takes the maximum for the light, loses most."""
    psf, scene, light = camera(generator)
    noise = 0.002 * torch.randn(light.shape, generator=generator)
    right, clipped = light + noise, overexposed(light + noise)

    def error(method, measurement):
        return float((method(measurement, psf) - scene).square().mean())

    assert error(Pyramid(), clipped) < 2 * error(Pyramid(), right)
    assert error(Admm(), clipped) > 3 * error(Pyramid(), clipped)


def test_plug_and_play_and_the_residual(generator):
    """What exceeds the maximum is no residual, and no round pulls it back."""
    psf, scene, light = camera(generator)
    clipped = overexposed(light)
    estimate = solve(clipped, psf)
    saturated = saturated_pixels(clipped)
    assert float(estimate.residual[saturated].min()) >= 0
    result = plug_and_play(estimate, lambda picture, sigma: picture, 6)
    restored = convolve(result.scene, psf)
    assert float((restored - light)[saturated].abs().mean()) < 0.2 * float((clipped - light)[saturated].abs().mean())
    assert float((result.scene - scene).square().mean()) < float((estimate.scene - scene).square().mean()) * 1.1


def test_networks_for_any_camera(generator):
    """`universal-small` iterates at an eighth and a quarter of the size, where pixels are partly saturated."""
    psf, scene, light = camera(generator)
    network = find_method("universal-small").eval()
    psf, light = psf.expand(1, 3, -1, -1), light.expand(1, 3, -1, -1)
    with torch.inference_mode():
        right, clipped = (float((network(b, psf) - scene).square().mean()) for b in (light, overexposed(light)))
    assert clipped < 1.5 * right

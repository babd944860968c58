"""What the U-Net behind the bank may change of the estimates."""

import pytest
import torch

from made import trained
from mwdn.errors import ParameterError
from mwdn.networks import build
from mwdn.networks.evidence import BENIGN_DOUBT, DOUBT_BLOCKS, MAX_DOUBT, against_psf, doubt_of_psf
from mwdn.networks.wiener_bank import CLOSED, WienerBank
from mwdn.optics import Camera
from mwdn.solvers.levels import relative_noise
from mwdn.solvers.pyramid import Estimate, solve


@pytest.mark.parametrize("fold", [1, 2, 4])
@pytest.mark.parametrize("size", [(160, 144), (151, 137)])
def test_neither_light_nor_pattern_of_the_folded_blocks_is_added(generator, fold, size):
    """A U-Net that answers with a number of its own at each place in the blocks."""
    network = build("wiener-bank", width=2, fold=fold, block=8).eval()
    with torch.no_grad():
        network.decoder.head.weight.zero_()
        network.decoder.head.bias.copy_(torch.rand(3 * fold**2, generator=generator))
    estimates = torch.rand(1, 15, *size, generator=generator)
    with torch.no_grad():
        corrected = network.correct(estimates, network.unit(estimates))
    torch.testing.assert_close(corrected, estimates[:, :3])


def test_the_mean_light_of_blocks_stays(generator):
    network = build("wiener-bank", width=2, block=8).eval()
    with torch.no_grad():
        for layer in network.modules():
            if isinstance(layer, torch.nn.BatchNorm2d):
                layer.bias.fill_(0.5)  # features above 0
        network.decoder.head.weight.mul_(10)
        estimates = torch.rand(1, 15, 160, 144, generator=generator)
        change = network.correct(estimates, network.unit(estimates)) - estimates[:, :3]
    blocks = torch.nn.functional.avg_pool2d(change, 16)
    assert change.abs().max() > 0.01
    assert blocks.abs().max() < 0.2 * change.abs().max()


@pytest.mark.parametrize("gain", [1e-8, 1e8])
def test_gain_does_not_matter(generator, gain):
    network = build("wiener-bank", width=2, block=8).eval()
    psf, measurement = torch.rand(1, 3, 64, 72, generator=generator) ** 8, torch.rand(1, 3, 64, 72, generator=generator)
    with torch.no_grad():
        expected, result = network(measurement, psf), network(gain * measurement, psf) / gain
    torch.testing.assert_close(result, expected, rtol=1e-3, atol=1e-3 * float(expected.max()))


@pytest.mark.parametrize("options", [{"rounds": -1}, {"fold": 0}, {"width": 0}])
def test_numbers_that_are_no_counts(options):
    with pytest.raises(ParameterError, match=f"`{next(iter(options))}` .* must be .*at least"):
        build("wiener-bank", **options)


def constant_output(network: WienerBank, light: float, gate: float) -> WienerBank:
    """The U-Net answers with this light everywhere, and with this gate if it has one."""
    with torch.no_grad():
        network.decoder.head.weight.zero_()
        network.decoder.head.bias.fill_(light)
        network.decoder.head.bias[12:].fill_(gate)
    return network.eval()


@pytest.mark.parametrize(("mean_light", "gate", "passed"), [("kept", 0, 0), ("free", 0, 1), ("gated", CLOSED, 0.5)])
def test_mean_light_passes_as_the_option_says(generator, mean_light, gate, passed):
    network = constant_output(build("wiener-bank", width=2, block=8, mean_light=mean_light), 0.25, gate)
    estimates = torch.rand(1, 15, 96, 80, generator=generator)
    unit = network.unit(estimates)
    with torch.no_grad():
        change = network.correct(estimates, unit) - estimates[:, :3]
    torch.testing.assert_close(change, (0.25 * passed * unit).expand_as(change), atol=1e-6, rtol=1e-5)


def test_a_closed_and_an_open_gate_are_kept_and_free_light(generator):
    estimates = torch.rand(1, 15, 96, 80, generator=generator)
    networks = {}
    for light in ("kept", "free", "gated"):
        torch.manual_seed(0)
        networks[light] = build("wiener-bank", width=2, block=8, mean_light=light).eval()
    gated = networks["gated"]
    for light, gate in (("kept", -100.0), ("free", 100.0)):
        head = networks[light].decoder.head
        networks[light].load_state_dict(
            {**gated.state_dict(), "decoder.head.weight": head.weight, "decoder.head.bias": head.bias}
        )
        with torch.no_grad():
            gated.decoder.head.weight[:12], gated.decoder.head.bias[:12] = head.weight, head.bias
            gated.decoder.head.weight[12:], gated.decoder.head.bias[12:] = 0, gate
            one, other = (each.correct(estimates, each.unit(estimates)) for each in (gated, networks[light]))
        torch.testing.assert_close(one, other)


def evidence_of(measurement, psf) -> torch.Tensor:
    """Noise and doubts as the network is told them."""
    network = build("wiener-bank", width=2, regularisations=(1e-3,), evidence=True).eval()
    with torch.no_grad():
        numbers = network.estimates(measurement, psf)[:, -1 - len(DOUBT_BLOCKS) :]
    assert (numbers == numbers[..., :1, :1]).all()  # constant maps
    return numbers[0, :, 0, 0]


def test_evidence_tells_a_right_psf_from_a_wrong_one(generator):
    """With a right PSF the logarithms of the doubts are about 1 at most; turned by 180 degrees it leaves more."""
    psf = torch.rand(1, 3, 96, 96, generator=generator) ** 12
    scene = torch.zeros(1, 3, 96, 96)
    scene[..., 30:60, 25:70] = (
        torch.rand(1, 3, 6, 9, generator=generator).repeat_interleave(5, -1).repeat_interleave(5, -2)
    )
    light = Camera(psf)(scene)
    noise = 0.02 * light.square().mean().sqrt()
    measurement = light + noise * torch.randn(light.shape, generator=generator)
    right, wrong = evidence_of(measurement, psf), evidence_of(measurement, psf.flip((-2, -1)))
    assert right[0] == pytest.approx(wrong[0])  # the noise, which does not depend on the PSF
    assert (right[1:] < 1.3).all()
    assert (wrong[1:] > right[1:] + 1.0).all()


def test_evidence_of_noise_alone(generator):
    """A measurement without a scene: its residual in blocks of s x s has a standard deviation of n / s."""
    measurement = 1 + 0.05 * torch.randn(1, 3, 128, 128, generator=generator)
    psf = torch.zeros(1, 3, 128, 128)
    psf[..., 64, 64] = 1
    estimate = solve(measurement, psf)
    doubt = against_psf(estimate, estimate.detail(1e-3), 8)[0, -1, 0, 0]
    residual, noise = estimate.residual, relative_noise(measurement) * measurement.square().mean().sqrt()
    expected = residual.unfold(-1, 16, 16).unfold(-3, 16, 16).mean((-1, -2)).square().mean().sqrt() * 16 / noise
    assert doubt.exp() == pytest.approx(float(expected), rel=0.01)


class Doubted(Estimate):
    """An estimate of given doubts."""

    def __init__(self, *doubts):
        object.__setattr__(self, "doubts", torch.tensor(doubts).reshape(-1, 1, 1, 1))

    def doubt(self, side):
        return self.doubts


def test_the_denoiser_is_told_a_clear_doubt_alone():
    none, whole = BENIGN_DOUBT
    told = doubt_of_psf(Doubted(0.5, none, (none + whole) / 2, whole, 1e6)).flatten()
    middle, large = torch.tensor([(none + whole) / 2, whole]).log()
    torch.testing.assert_close(told, torch.tensor([0.0, 0.0, middle / 2, large, torch.tensor(MAX_DOUBT).log()]))


def test_the_denoiser_is_told_the_doubt_times_its_level(generator):
    """One that returns what it is told: each sample of a batch has its own doubt."""
    network = build("wiener-bank", width=2, rounds=1, evidence=True).eval()
    network.denoiser = torch.nn.Module()
    network.denoiser.forward = lambda image, conditions: conditions
    conditions = network.denoise(Doubted(1.0, 8.0))(torch.rand(2, 3, 8, 8), torch.full((2, 1, 1, 1), 0.5))
    assert conditions.shape == (2, 2, 1, 1)
    torch.testing.assert_close(conditions[:, 0], torch.full((2, 1, 1), 0.5))
    torch.testing.assert_close(conditions[:, 1].flatten(), 0.5 * doubt_of_psf(Doubted(1.0, 8.0)).flatten())


@pytest.mark.parametrize("options", [{"evidence": True}, {"mean_light": "gated"}, {"mean_light": "free"}])
def test_without_iterations_there_is_no_evidence(options):
    with pytest.raises(ParameterError, match="need iterations: `finest`"):
        build("wiener-bank", finest=0, **options)


@pytest.mark.parametrize("size", [(41, 57), (64, 64)])
def test_any_size_with_all_options(generator, size):
    network = build("wiener-bank", width=2, evidence=True, mean_light="gated").eval()
    psf, measurement = (torch.rand(1, 3, *size, generator=generator) for _ in range(2))
    with torch.no_grad():
        scene = network(measurement, psf**8)
    assert scene.shape == measurement.shape
    assert torch.isfinite(scene).all()


def test_no_frame_around_the_picture(generator):
    """Even estimates: what the U-Net changes at the border is what it changes inside, but for zeros 24 pixels away."""
    network = trained(build("wiener-bank", width=4, block=24, rounds=1, mean_light="free"), generator).eval()
    estimates = torch.rand(1, 15, 1, 1, generator=generator).expand(-1, -1, 192, 192)
    with torch.no_grad():
        corrected = network.correct(estimates, network.unit(estimates))
        framed = network._correct(estimates, network.unit(estimates))

    def contrast(picture):
        folded = torch.nn.functional.avg_pool2d(picture, 2)
        inside = folded[..., 32:-32, 32:-32].mean((-2, -1), keepdim=True)
        return float((folded[..., :2] - inside).square().mean().sqrt())

    assert contrast(corrected) < 0.3 * contrast(framed), (contrast(corrected), contrast(framed))

"""Protocols and variants by hand, metrics against other people's code, confidence intervals by simulation."""

import math

import numpy as np
import pytest
import torch
from skimage.metrics import peak_signal_noise_ratio, structural_similarity
from torchmetrics.functional.image import peak_signal_noise_ratio as torchmetrics_psnr

from mwdn.errors import ParameterError, ShapeError
from mwdn.evaluation.metrics import METRICS, Perceptual, Protocol, best_gain, bootstrap, measure, psnr


@pytest.fixture
def perceptual(lpips_files):
    return Perceptual.load(**lpips_files)


@pytest.fixture
def pair(generator):
    """Noisy pictures, with values outside [0, 1], and their scenes."""
    scene = torch.rand(2, 3, 40, 44, generator=generator)
    return scene + 0.3 * torch.randn(scene.shape, generator=generator), scene


def grid(height, width):
    """Each pixel is 1000 times its row plus its column."""
    return (1000 * torch.arange(height)[:, None] + torch.arange(width)).float().expand(1, 1, -1, -1)


def test_full_is_the_whole_picture():
    assert torch.equal(Protocol.parse("full").crop(grid(5, 7)), grid(5, 7))
    assert Protocol.parse("full") == Protocol()


@pytest.mark.parametrize(
    ("height", "width", "top", "left"), [(320, 320, 96, 96), (128, 128, 0, 0), (270, 480, 71, 176), (129, 131, 0, 1)]
)
def test_centre_is_the_papers_crop(height, width, top, left):
    part = Protocol.parse("centre-128").crop(grid(height, width))
    assert part.shape[-2:] == (128, 128)
    assert part[0, 0, 0, 0] == 1000 * top + left
    assert part[0, 0, -1, -1] == 1000 * (top + 127) + left + 127


def test_rows_and_columns_are_those_of_diffusercam():
    for text in ("60:270,60:440", " 60:270, 60:440 "):
        part = Protocol.parse(text).crop(grid(270, 480))
        assert part.shape[-2:] == (210, 380)
        assert part[0, 0, 0, 0] == 60060
        assert part[0, 0, -1, -1] == 269439


@pytest.mark.parametrize(
    "text",
    [
        "",
        "Full",
        "centre",
        "centre-0",
        "centre--5",
        "center-128",
        "60:270",
        "9:9,0:4",
        "5:4,0:4",
        "-1:4,0:4",
        "a:b,c:d",
    ],
)
def test_other_protocols_are_refused(text):
    with pytest.raises(ParameterError, match=r"`protocol` \('.*'\) must be full, centre-128"):
        Protocol.parse(text)


@pytest.mark.parametrize("text", ["centre-41", "0:41,0:40", "0:40,0:41"])
def test_a_part_must_lie_inside_the_picture(text):
    with pytest.raises(ShapeError, match="must lie inside the pictures"):
        Protocol.parse(text).crop(grid(40, 40))


def test_psnr_is_that_of_torchmetrics_and_scikit_image(pair):
    result = psnr(*pair)
    oracle = torchmetrics_psnr(*pair, data_range=1.0, reduction="none", dim=(1, 2, 3))
    torch.testing.assert_close(result, oracle)
    expected = [peak_signal_noise_ratio(y.numpy(), x.numpy(), data_range=1) for x, y in zip(*pair, strict=True)]
    np.testing.assert_allclose(result, expected, rtol=1e-5)
    assert psnr(pair[0], pair[0]).tolist() == [math.inf, math.inf]


def test_psnr_by_hand():
    assert psnr(torch.full((1, 1, 4, 4), 0.1), torch.zeros(1, 1, 4, 4)).item() == pytest.approx(20)


def test_measure_crops_then_clips_then_compares(pair, perceptual):
    result = measure(*pair, Protocol.parse("2:38,4:40"), variant="clipped", perceptual=perceptual)
    image, scene = (picture[..., 2:38, 4:40] for picture in pair)
    assert tuple(result) == METRICS
    torch.testing.assert_close(result["psnr"], psnr(image.clamp(0, 1), scene))
    for i in range(2):
        x, y = image[i].clamp(0, 1).numpy(), scene[i].numpy()
        options = {"gaussian_weights": True, "use_sample_covariance": False, "data_range": 1, "channel_axis": 0}
        assert result["ssim"][i].item() == pytest.approx(structural_similarity(x, y, **options), abs=2e-5)
    assert all(value.shape == (2,) and value.isfinite().all() for value in result.values())


def test_raw_is_not_clipped(pair):
    result = measure(*pair, Protocol(), variant="raw")["mse"]
    torch.testing.assert_close(result, (pair[0] - pair[1]).square().mean((1, 2, 3)))
    assert (result > measure(*pair, Protocol(), variant="clipped")["mse"]).all()


def test_the_papers_protocol_is_raw_by_default(pair):
    part = Protocol.parse("centre-32")
    assert torch.equal(measure(*pair, part)["mse"], measure(*pair, part, variant="raw")["mse"])
    assert torch.equal(measure(*pair, Protocol())["mse"], measure(*pair, Protocol(), variant="clipped")["mse"])


def test_best_gain_undoes_an_affine_change(pair):
    scene = pair[1]
    change = torch.tensor([3.0, 0.01]).view(2, 1, 1, 1) * scene + torch.tensor([-2.0, 0.7]).view(2, 1, 1, 1)
    torch.testing.assert_close(best_gain(change, scene), scene, atol=2e-5, rtol=0)
    result = measure(change, scene, Protocol(), variant="best-gain")
    assert (result["psnr"] > 90).all()
    assert (result["ssim"] > 0.9999).all()


def test_best_gain_is_least_squares_over_all_colours(pair):
    for x, y in zip(*pair, strict=True):
        design = np.stack([x.flatten(), np.ones(x.numel())], axis=1)
        expected = design @ np.linalg.lstsq(design, y.flatten().numpy(), rcond=None)[0]
        np.testing.assert_allclose(best_gain(x[None], y[None]).flatten(), expected, atol=1e-5)


def test_best_gain_does_not_clip_and_an_even_picture_becomes_the_mean(pair):
    assert best_gain(pair[0] * 5, 3 * pair[1]).max() > 1
    even = best_gain(torch.full_like(pair[1], 0.5), pair[1])
    torch.testing.assert_close(even, pair[1].mean((1, 2, 3), keepdim=True).expand_as(even))


def test_best_gain_of_an_even_picture_has_a_gradient(pair):
    """It was NaN, and a training with `best_gain` diverged at the first dark reconstruction."""
    even = torch.zeros_like(pair[1]).requires_grad_()
    (best_gain(even, pair[1]) - pair[1]).square().sum().backward()
    assert even.grad.isfinite().all()


def test_best_gain_is_of_the_part_that_is_compared(pair):
    scene = pair[1]
    spoilt = 2 * scene + 1
    spoilt[..., :4, :] = 9
    assert (measure(spoilt, scene, Protocol.parse("4:40,0:44"), variant="best-gain")["psnr"] > 90).all()


def test_missing_networks_are_nan_and_have_a_reason(pair, tmp_path, data):
    absent = Perceptual.load(tmp_path / "absent.pth")
    assert set(absent.missing) == {"lpips", "feature_mse"}
    assert "absent.pth" in absent.missing["lpips"]
    result = measure(*pair, Protocol(), perceptual=absent)
    assert all(result[name].isnan().all() == (name in absent.missing) for name in METRICS)
    heads = Perceptual.load(data / "lpips" / "alexnet_features_torchvision.pth", tmp_path / "absent.pth")
    assert set(heads.missing) == {"lpips"}
    result = measure(*pair, Protocol(), perceptual=heads)
    assert result["feature_mse"].isfinite().all()
    assert result["lpips"].isnan().all()
    assert measure(*pair, Protocol())["lpips"].isnan().all()


@pytest.mark.usefixtures("unchecked")
def test_wrong_calls_are_refused(pair):
    with pytest.raises(ShapeError, match="must have the same shape"):
        measure(pair[0][..., :-1], pair[1], Protocol())
    with pytest.raises(ParameterError, match="best-gain, clipped, raw"):
        measure(*pair, Protocol(), variant="best")
    with pytest.raises(ParameterError, match=r"`protocol` \('full'\) of `measure` must be `Protocol`"):
        measure(*pair, "full")


def test_bootstrap_is_reproducible_and_holds_the_mean(generator):
    values = torch.randn(50, generator=generator)
    mean, low, high = bootstrap(values)
    assert mean == pytest.approx(values.mean().item(), rel=1e-6)
    assert low < mean < high
    assert bootstrap(values) == (mean, low, high)
    assert bootstrap(values.tolist(), seed=1) != (mean, low, high)
    narrow = bootstrap(values, 0.5)
    assert low < narrow[1] < mean < narrow[2] < high


def test_bootstrap_has_the_width_of_the_standard_error(generator):
    values = torch.randn(400, generator=generator)
    _, low, high = bootstrap(values)
    assert (high - low) / (2 * 1.96 * values.std().item() / 20) == pytest.approx(1, abs=0.08)


def test_bootstrap_covers_the_true_mean_at_its_confidence(generator):
    """Of 200 skewed data sets, whose true mean is 1, about 90 % of the intervals hold it; 3 standard errors are 6 %."""
    held = 0
    for _ in range(200):
        values = -torch.rand(60, generator=generator, dtype=torch.float64).log()
        _, low, high = bootstrap(values, 0.9, resamples=300)
        held += low <= 1 <= high
    assert 0.82 < held / 200 < 0.96


def test_bootstrap_of_few_values():
    assert bootstrap([2.5]) == (2.5, 2.5, 2.5)
    assert bootstrap([1.0, math.inf])[::2] == (math.inf, math.inf)
    assert bootstrap([1.0, math.inf])[1] == 1
    assert all(math.isnan(value) for value in bootstrap([math.nan, math.nan]))
    for values, confidence in (([], 0.95), ([1.0], 1.0), ([1.0], 0.0)):
        with pytest.raises(ParameterError, match="`values`"):
            bootstrap(values, confidence)

"""Distances against other people's code and published numbers; their gradients."""

import math

import cv2
import numpy as np
import pytest
import torch
from skimage.metrics import structural_similarity
from torch import nn
from torchmetrics.functional.image import structural_similarity_index_measure

from mwdn.errors import ShapeError
from mwdn.evaluation.alexnet import AlexNet, Heads, load_alexnet, load_heads
from mwdn.evaluation.distances import feature_mse, l1, log_mse, lpips, mse, ssim

DISTANCES = ("feature_mse", "l1", "log_mse", "lpips", "mse", "ssim")


@pytest.fixture(scope="module")
def networks():
    """With random weights, which are enough for everything but published numbers."""
    torch.manual_seed(1)
    heads = Heads()
    for parameter in heads.parameters():
        nn.init.uniform_(parameter)
    return AlexNet().requires_grad_(False), heads.requires_grad_(False)


@pytest.fixture
def distances(networks):
    return {
        "mse": mse,
        "l1": l1,
        "log_mse": log_mse,
        "ssim": ssim,
        "feature_mse": lambda x, y: feature_mse(x, y, networks[0]),
        "lpips": lambda x, y: lpips(x, y, *networks),
    }


@pytest.mark.parametrize("channels", [1, 3])
def test_ssim_is_that_of_scikit_image_and_torchmetrics(noisy_pair, channels):
    image, reference = (picture[:, :channels] for picture in noisy_pair)
    result = ssim(image, reference)
    options = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False, "data_range": 1}
    expected = [
        structural_similarity(x.double().numpy(), y.double().numpy(), channel_axis=0, **options)
        for x, y in zip(image, reference, strict=True)
    ]
    np.testing.assert_allclose(result, expected, atol=2e-5)
    # torchmetrics averages over windows that reach into a reflected border, too: leave those out.
    _, windows = structural_similarity_index_measure(image, reference, data_range=1.0, return_full_image=True)
    torch.testing.assert_close(result, windows[..., 5:-5, 5:-5].mean((1, 2, 3)), atol=2e-5, rtol=0)


def test_mse_its_logarithm_and_l1_by_hand():
    image = torch.stack([torch.zeros(1, 2, 2), torch.tensor([[[0.0, 1], [2, 1]]])])
    assert mse(image, torch.ones_like(image)).tolist() == [1, 0.5]
    assert log_mse(image, torch.ones_like(image)).tolist() == pytest.approx([0, math.log10(0.5)])
    assert l1(image, torch.ones_like(image)).tolist() == [1, 0.5]


def test_feature_mse_is_equation_3(noisy_pair, networks):
    """The authors' formula for one sample: the sum of two means, of pictures without normalisation."""
    for x, y in zip(*noisy_pair, strict=True):
        a, b = networks[0](x[None]), networks[0](y[None])
        expected = nn.functional.mse_loss(a[1], b[1]) + nn.functional.mse_loss(a[3], b[3])
        torch.testing.assert_close(feature_mse(x[None], y[None], networks[0])[0], expected)


def test_lpips_has_the_published_numbers(data, lpips_files):
    network, heads = load_alexnet(lpips_files["alexnet"]), load_heads(lpips_files["heads"])
    read = lambda name: cv2.imread(str(data / "lpips" / "examples" / f"ex_{name}.png"))[..., ::-1]  # noqa: E731
    pictures = [torch.from_numpy(read(name) / np.float32(255)).movedim(-1, 0) for name in ("ref", "p0", "p1")]
    reference = torch.stack([pictures[0]] * 2)
    result = lpips(torch.stack(pictures[1:]), reference, network, heads)
    np.testing.assert_allclose(result, [0.7219, 0.1376], atol=1e-3)


@pytest.mark.parametrize("name", DISTANCES)
def test_one_number_a_sample_whatever_the_batch(name, distances, noisy_pair):
    image, reference = noisy_pair
    together = distances[name](image, reference)
    alone = torch.cat([distances[name](image[i : i + 1], reference[i : i + 1]) for i in range(2)])
    assert together.shape == (2,)
    torch.testing.assert_close(together, alone)
    assert (together[0] > together[1]) == (name == "ssim")


@pytest.mark.parametrize("name", DISTANCES)
def test_identical_pictures_are_at_no_distance(name, distances, noisy_pair):
    same = distances[name](noisy_pair[0], noisy_pair[0])
    least = {"ssim": 1.0, "log_mse": -8.0}.get(name, 0.0)
    torch.testing.assert_close(same, torch.full((2,), least), atol=1e-6, rtol=0)


@pytest.mark.parametrize("name", DISTANCES)
@pytest.mark.parametrize("other", ["noisy", "identical", "black"])
def test_gradients_are_finite(name, other, distances, noisy_pair):
    noisy, scene = noisy_pair
    black = torch.zeros_like(scene)
    image, reference = {"noisy": (noisy, scene), "identical": (scene, scene), "black": (black, black)}[other]
    image = image.clone()
    distances[name](image.requires_grad_(), reference).sum().backward()
    assert image.grad.isfinite().all()
    assert (image.grad.abs().max() > 1e-6) == (other == "noisy")


def test_lpips_has_a_finite_gradient_where_no_feature_responds(noisy_pair, networks):
    """Where all channels are 0 the unit vector has no direction; a square root would give NaN."""
    dead = AlexNet().requires_grad_(False)
    for layer in dead.features:
        if isinstance(layer, nn.Conv2d):
            nn.init.constant_(layer.bias, -100.0)
    image = noisy_pair[0].clone().requires_grad_()
    lpips(image, noisy_pair[1], dead, networks[1]).sum().backward()
    assert image.grad.isfinite().all()


@pytest.mark.parametrize("name", ["mse", "log_mse", "l1", "ssim"])
def test_gradients_agree_with_differences(name, distances, generator):
    x, y, step = (torch.rand(1, 1, 12, 12, generator=generator) for _ in range(3))
    (slope,) = torch.autograd.grad(distances[name](x.requires_grad_(), y).sum(), x)
    change = distances[name](x.detach() + 1e-3 * step, y) - distances[name](x.detach() - 1e-3 * step, y)
    torch.testing.assert_close((slope * step).sum(), change.sum() / 2e-3, rtol=2e-2, atol=1e-5)


@pytest.mark.parametrize("name", DISTANCES)
def test_float32_inside_autocast(name, distances, noisy_pair):
    plain = distances[name](*noisy_pair)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        inside = distances[name](*noisy_pair)
        rounded = distances[name](noisy_pair[0].bfloat16(), noisy_pair[1])
    assert inside.dtype == rounded.dtype == torch.float32
    assert torch.equal(inside, plain)


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize("name", DISTANCES)
def test_shapes_must_agree(name, distances):
    for other in ((1, 3, 40, 41), (2, 3, 40, 40), (3, 40, 40)):
        with pytest.raises(ShapeError, match="must have the same shape"):
            distances[name](torch.rand(1, 3, 40, 40), torch.rand(other))


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize("name", DISTANCES)
def test_pictures_without_batch_are_refused(name, distances):
    with pytest.raises(ShapeError, match=r"`image` \(3, 40, 40\) must be .*`image\[None\]`"):
        distances[name](torch.rand(3, 40, 40), torch.rand(3, 40, 40))


def test_ssim_needs_one_window():
    with pytest.raises(ShapeError, match="11 x 11"):
        ssim(torch.rand(1, 1, 10, 20), torch.rand(1, 1, 10, 20))

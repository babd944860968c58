"""The training loss: the weighted sum of distances."""

import pytest
import torch

from mwdn.errors import CheckpointError, ParameterError, UnknownNameError
from mwdn.evaluation.distances import feature_mse, lpips, mse, ssim
from mwdn.training import losses
from mwdn.training.losses import LOSS_PARTS, Loss


def test_loss_is_the_weighted_sum_of_its_parts(noisy_pair, lpips_files):
    weights = {"mse": 1.0, "l1": 0.5, "ssim": 0.1, "feature_mse": 0.05, "lpips": 0.2}
    loss = Loss(weights, **lpips_files)
    total, parts = loss(*noisy_pair)
    assert total.shape == ()
    assert set(parts) == set(weights)
    torch.testing.assert_close(total, sum(weights[name] * parts[name] for name in weights))
    torch.testing.assert_close(parts["mse"], mse(*noisy_pair).mean())
    torch.testing.assert_close(parts["ssim"], 1 - ssim(*noisy_pair).mean())
    torch.testing.assert_close(parts["lpips"], lpips(*noisy_pair, loss.alexnet, loss.heads).mean())
    torch.testing.assert_close(parts["feature_mse"], feature_mse(*noisy_pair, loss.alexnet).mean())


def test_loss_has_gradients_for_the_reconstruction_only(noisy_pair, lpips_files):
    loss = Loss({"mse": 1.0, "feature_mse": 0.05, "lpips": 0.0}, **lpips_files)
    image = noisy_pair[0].clone().requires_grad_()
    total, parts = loss.train()(image, noisy_pair[1])
    total.backward()
    assert image.grad.isfinite().all()
    assert parts["lpips"] > 0
    assert not any(part.requires_grad for part in parts.values())
    assert not any(parameter.requires_grad for parameter in loss.parameters())


def test_grey_pictures_have_all_losses(noisy_pair, lpips_files):
    names = set(LOSS_PARTS) - {"vgg_mse"}  # in test_vgg.py
    total, _ = Loss(dict.fromkeys(sorted(names), 1.0), **lpips_files)(noisy_pair[0][:, :1], noisy_pair[1][:, :1])
    assert total.isfinite()


def test_networks_load_only_if_a_part_needs_them(monkeypatch, tmp_path):
    monkeypatch.setattr(losses, "load_alexnet", None)
    monkeypatch.setattr(losses, "load_heads", None)
    assert not list(Loss({"mse": 1.0, "ssim": 0.1, "l1": 1}).parameters())
    monkeypatch.undo()
    with pytest.raises(CheckpointError):
        Loss({"lpips": 1.0}, alexnet=tmp_path / "absent.pth")


def test_weights_can_change_while_training(noisy_pair):
    loss = Loss({"mse": 1.0, "l1": 1.0})
    before, parts = loss(*noisy_pair)
    loss.weights["l1"] = 0.05
    torch.testing.assert_close(loss(*noisy_pair)[0], before - 0.95 * parts["l1"])


def test_wrong_weights_are_refused():
    with pytest.raises(UnknownNameError, match="Did you mean 'feature_mse'"):
        Loss({"feature_mes": 1.0})
    for weight in (-1.0, float("nan"), float("inf")):
        with pytest.raises(ParameterError, match="`mse`"):
            Loss({"mse": weight})
    with pytest.raises(ParameterError, match="at least one"):
        Loss({})

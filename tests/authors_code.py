"""The networks and the training of the paper's authors, written from methods.md: functions of a state dict.

The tensors have the names of their checkpoints.
"""

import torch
from torch.nn import functional as F


def double(state, name, inputs, outputs, inner, generator):
    """Random weights of a double (3x3 convolution, BatchNorm, ReLU), under the authors' names 0 to 5."""
    for index, (a, b) in ((0, (inputs, inner)), (3, (inner, outputs))):
        state[f"{name}.double_conv.{index}.weight"] = torch.randn(b, a, 3, 3, generator=generator) / (3 * a**0.5)
        state[f"{name}.double_conv.{index}.bias"] = 0.1 * torch.randn(b, generator=generator)
        norm = f"{name}.double_conv.{index + 1}"
        state[f"{norm}.weight"] = 1 + 0.1 * torch.randn(b, generator=generator)
        state[f"{norm}.bias"] = 0.1 * torch.randn(b, generator=generator)
        state[f"{norm}.running_mean"] = 0.1 * torch.randn(b, generator=generator)
        state[f"{norm}.running_var"] = 0.5 + torch.rand(b, generator=generator)
        state[f"{norm}.num_batches_tracked"] = torch.tensor(7)


def authors(generator, *, cpsf, width=4):
    """State of the authors' network at any width, with random weights."""
    state = {"w": 1e-3 * (1 + torch.rand(1 if cpsf else 4, generator=generator))}
    state["delta"] = 1e-2 * (0.5 + torch.rand(5 if cpsf else 4, generator=generator))
    widths = (3, width, 2 * width, 4 * width, 8 * width, 8 * width)
    names = ["inc", *(f"down{i}.avgpool_conv.1" for i in (1, 2, 3, 4))]
    for name, a, b in zip(names, widths[:-1], widths[1:], strict=True):
        double(state, name, a, b, b, generator)
    ups = [(16 * width, 4 * width), (8 * width, 2 * width), (4 * width, width), (2 * width, width)]
    for i, (a, b) in enumerate(ups, 1):
        double(state, f"up{i}.conv", a, b, a // 2, generator)
    state["outc.conv.weight"] = torch.randn(3, width, 1, 1, generator=generator)
    state["outc.conv.bias"] = torch.randn(3, generator=generator)
    if cpsf:
        names = ["inc0", *(f"down{i}.avgpool_conv.1" for i in (11, 22, 33))]
        for name, a, b in zip(names, widths[:-2], widths[1:-1], strict=True):
            double(state, name, a, b, b, generator)
    return state


def blocks(state, name, x, *, training=False):
    for index in (0, 3):
        x = F.conv2d(
            x, state[f"{name}.double_conv.{index}.weight"], state[f"{name}.double_conv.{index}.bias"], padding=1
        )
        norm = {
            key: state[f"{name}.double_conv.{index + 1}.{key}"]
            for key in ("running_mean", "running_var", "weight", "bias")
        }
        x = F.batch_norm(x, **norm, training=training).relu()
    return x


def features(state, names, x, *, training=False):
    scales = [blocks(state, names[0], x, training=training)]
    for name in names[1:]:
        scales.append(blocks(state, f"{name}.avgpool_conv.1", F.avg_pool2d(scales[-1], 2), training=training))
    return scales


def circular_wiener(b, h, constant):
    """Eq. (2) with circular boundaries and an unshifted PSF; the result is shifted by half the frame instead."""
    H = torch.fft.rfft2(h)
    v = torch.fft.irfft2(H.conj() / (H.abs() ** 2 + constant) * torch.fft.rfft2(b), s=b.shape[-2:])
    return v.roll((b.shape[-2] // 2, b.shape[-1] // 2), (-2, -1))


def authors_output(state, b, h, *, cpsf, training=False):
    """Output of the authors' network for a PSF as stored."""
    *skips, x = features(state, ["inc", "down1", "down2", "down3", "down4"], b, training=training)
    if cpsf:
        psfs = features(state, ["inc0", "down11", "down22", "down33"], state["w"] * h, training=training)
    else:
        psfs = [w * F.avg_pool2d(h.sum(1, keepdim=True), 2**i) for i, w in enumerate(state["w"])]
    for i in (3, 2, 1, 0):
        x = F.interpolate(x, scale_factor=2, mode="bilinear", align_corners=True)
        x = torch.cat([circular_wiener(skips[i], psfs[i], state["delta"][i]), x], 1)
        x = blocks(state, f"up{4 - i}.conv", x, training=training)
    return F.conv2d(x, state["outc.conv.weight"], state["outc.conv.bias"])


def alexnet_features(weights, x):
    """relu2 and relu4 of AlexNet, from its convolutions 0, 3, 6, 8 in torchvision's numbers."""
    convolution = lambda x, n, **how: F.conv2d(x, weights[f"features.{n}.weight"], weights[f"features.{n}.bias"], **how)  # noqa: E731
    x = F.max_pool2d(convolution(x, 0, stride=4, padding=2).relu(), 3, 2)
    second = convolution(x, 3, padding=2).relu()
    third = convolution(F.max_pool2d(second, 3, 2), 6, padding=1).relu()
    return second, convolution(third, 8, padding=1).relu()


def authors_training(state, batches, h, alexnet, *, cpsf, layout):
    """The state after one step for each batch: Adam at 1e-4 with weight decay of everything, MSE + feature MSE."""
    state = {
        key: value.clone(memory_format=layout if value.ndim == 4 else torch.preserve_format)
        for key, value in state.items()
    }
    learned = [
        value.requires_grad_() for key, value in state.items() if value.is_floating_point() and "running" not in key
    ]
    optimiser = torch.optim.Adam(learned, lr=1e-4, weight_decay=1e-4)
    for b, scene in batches:
        output = authors_output(state, b.contiguous(memory_format=layout), h, cpsf=cpsf, training=True)
        pairs = zip(alexnet_features(alexnet, output), alexnet_features(alexnet, scene), strict=True)
        loss = F.mse_loss(output, scene) + sum(F.mse_loss(*pair) for pair in pairs)
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
    return {key: value.detach() for key, value in state.items()}

"""Conversion of the layers of networks to ONNX: convolutions, pooling, normalisation, changes of resolution."""

from typing import Any

import torch
from torch import fx

from mwdn.errors import ExportError
from mwdn.export.onnx_graph import OnnxGraph
from mwdn.export.onnx_operations import TYPES, Handler, as_type, filled, reshape, shape_name, source, value

_aten = torch.ops.aten


def _convolution(g: OnnxGraph, node: fx.Node, x: str, *others: Any) -> str:  # noqa: ANN401
    weight, bias, stride, padding, dilation, groups = filled(others, None, None, (1, 1), (0, 0), (1, 1), 1)
    return g("Conv", x, weight, bias, strides=stride, pads=[*padding, *padding], dilations=dilation, group=groups)


def _convolution_transpose(g: OnnxGraph, node: fx.Node, x: str, *others: Any) -> str:  # noqa: ANN401
    defaults = None, None, (1, 1), (0, 0), (0, 0), 1, (1, 1)
    weight, bias, stride, padding, more, groups, dilation = filled(others, *defaults)
    shape = {"strides": stride, "pads": [*padding, *padding], "output_padding": more, "dilations": dilation}
    return g("ConvTranspose", x, weight, bias, group=groups, **shape)


def _pool(operation: str, *before: list[int]) -> Handler:
    """Pooling whose options are ``before`` (padding, and dilation of maxima), ceil_mode, and others."""

    def handler(g: OnnxGraph, node: fx.Node, x: str, size: list[int], stride: Any = (), *options: Any) -> str:  # noqa: ANN401
        *given, ceil_mode = filled(options[: len(before) + 1], *before, False)
        if given != list(before) or any(options[len(before) + 1 :]):
            raise ExportError(f"`{node.target}` with padding cannot be written as ONNX. Export to .pt2 instead.")
        return g(operation, x, kernel_shape=size, strides=stride or size, ceil_mode=int(ceil_mode))

    return handler


def _group_norm(g: OnnxGraph, node: fx.Node, x: str, groups: int, weight: Any, bias: Any, *others: Any) -> str:  # noqa: ANN401
    # In float32, as in torch: squares summed over a picture exceed the range of float16.
    one, epsilon, dtype = torch.ones(groups), (*others, 1e-5)[0], value(node).dtype
    grouped = g("Reshape", as_type(g, torch.float32, x, node.args[0]), g.integers([0, groups, -1]))
    normal = g("InstanceNormalization", grouped, one, torch.zeros(groups), epsilon=epsilon)
    spread = reshape(g, node, normal)
    result = g("Add", g("Mul", spread, weight.float()[:, None, None]), bias.float()[:, None, None])
    return result if dtype == torch.float32 else g("Cast", result, to=TYPES[dtype])


def _upsample(g: OnnxGraph, node: fx.Node, x: str, size: Any, corners: bool, *_: Any) -> str:  # noqa: ANN401
    # All four lengths: onnxruntime 1.31 loses the axes of a Resize when it moves it (to NHWC, for int8).
    mode = "align_corners" if corners else "half_pixel"
    wanted = shape_name(g, value(node).shape)
    return g("Resize", x, None, None, wanted, mode="linear", coordinate_transformation_mode=mode)


def _grid_sample(g: OnnxGraph, node: fx.Node, x: str, grid: str, mode: int, padding: int, corners: bool) -> str:
    modes, paddings = ("bilinear", "nearest", "bicubic"), ("zeros", "border", "reflection")
    return g("GridSample", x, grid, mode=modes[mode], padding_mode=paddings[padding], align_corners=int(corners))


def _unshuffle(g: OnnxGraph, node: fx.Node, x: str, block: int) -> str:
    # SpaceToDepth has another order of channels.
    _, channels, height, width = source(node).shape
    split = g("Reshape", x, g.integers([-1, channels, height // block, block, width // block, block]))
    return reshape(g, node, g("Transpose", split, perm=[0, 1, 3, 5, 2, 4]))


LAYERS: dict[Any, Handler] = {
    _aten.avg_pool2d.default: _pool("AveragePool", [0, 0]),
    _aten.conv2d.default: _convolution,
    _aten.conv_transpose2d.input: _convolution_transpose,
    _aten.grid_sampler.default: _grid_sample,
    _aten.group_norm.default: _group_norm,
    _aten.max_pool2d.default: _pool("MaxPool", [0, 0], [1, 1]),
    _aten.pixel_shuffle.default: lambda g, node, x, block: g("DepthToSpace", x, blocksize=block, mode="CRD"),
    _aten.pixel_unshuffle.default: _unshuffle,
    _aten.upsample_bilinear2d.vec: _upsample,
}
"""Handlers of layers."""

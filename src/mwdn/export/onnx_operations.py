"""Conversion of torch's operations on real tensors to ONNX: arithmetic, reductions, shapes. Layers: `onnx_layers`.

A handler takes the graph, the node of torch and its arguments: names for computed values, tensors and numbers for
constants. It adds operations to the graph and returns the name of the result.
"""

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor, fx

from mwdn.errors import ExportError
from mwdn.export.onnx_graph import OnnxGraph, Pair

_aten = torch.ops.aten
TYPES = {torch.float32: 1, torch.float16: 10}  # numbers of onnx.TensorProto
Handler = Callable[..., Any]


def value(node: fx.Node) -> Any:  # noqa: ANN401
    """Result of an operation without its data: shape and type."""
    return node.meta["val"]


def source(node: fx.Node) -> Tensor:
    """First argument without its data."""
    return value(node.args[0])  # type: ignore[arg-type]


def filled(arguments: Sequence[Any], *defaults: Any) -> tuple[Any, ...]:  # noqa: ANN401
    """Positional arguments, completed with defaults."""
    return (*arguments, *defaults[len(arguments) :])


def _reshape_target(shape: Sequence[Any]) -> list[int]:
    """Shape for a Reshape, with -1 for a free batch size."""
    return [length if isinstance(length, int) else -1 for length in shape]


def shape_name(g: OnnxGraph, shape: Sequence[Any]) -> str:
    """Name of a shape whose first axis may depend on the batch size."""
    if all(isinstance(length, int) for length in shape):
        return g.integers(shape)
    times = int(shape[0].node.expr.as_coeff_Mul()[0])  # colours moved into the batch
    batch = g("Mul", g("Shape", "measurement", start=0, end=1), g.integers([times]))
    return g("Concat", batch, g.integers(_reshape_target(shape)[1:]), axis=0)


def _plain(operation: str) -> Handler:
    """An operation with the same meaning in ONNX; mixed precisions are promoted as in torch."""

    def handler(g: OnnxGraph, node: fx.Node, *arguments: Any) -> str:  # noqa: ANN401
        return g(operation, *(as_type(g, value(node).dtype, *each) for each in zip(arguments, node.args, strict=True)))

    return handler


def _sum(operation: str) -> Handler:
    """A sum or difference, whose second argument torch may multiply by ``alpha``."""
    plain = _plain(operation)

    def handler(g: OnnxGraph, node: fx.Node, a: Any, b: Any, *, alpha: float = 1) -> str:  # noqa: ANN401
        return plain(g, node, a, b if alpha == 1 else g("Mul", b, torch.tensor(float(alpha))))

    return handler


def as_type(g: OnnxGraph, dtype: torch.dtype, x: Any, argument: Any) -> Any:  # noqa: ANN401
    """A number or result, cast to a precision."""
    if not isinstance(argument, fx.Node):
        return torch.tensor(x, dtype=dtype)
    return x if value(argument).dtype == dtype else g("Cast", x, to=TYPES[dtype])


def _compare(operation: str) -> Handler:
    def handler(g: OnnxGraph, node: fx.Node, a: str, b: Any) -> str:  # noqa: ANN401
        return g(operation, a, as_type(g, source(node).dtype, b, node.args[1]))

    return handler


def _lerp(g: OnnxGraph, node: fx.Node, start: str, end: str, weight: float) -> str:
    return g("Add", start, g("Mul", g("Sub", end, start), torch.tensor(float(weight))))


def _where(g: OnnxGraph, node: fx.Node, condition: str, *given: Any) -> str:  # noqa: ANN401
    values = zip(given, node.args[1:], strict=True)
    return g("Where", condition, *(as_type(g, value(node).dtype, *each) for each in values))


def _identity(g: OnnxGraph, node: fx.Node, x: Any, **_: Any) -> Any:  # noqa: ANN401
    return x


def _reduce(operation: str) -> Handler:
    def handler(g: OnnxGraph, node: fx.Node, x: str, axes: Sequence[int] = (), keep: bool = False) -> str:
        return g(operation, x, g.integers(axes), keepdims=int(keep))

    return handler


def _norm(g: OnnxGraph, node: fx.Node, x: str, order: float = 2, axes: Sequence[int] = (), keep: bool = False) -> str:
    if order != 2:
        raise ExportError(f"`{node.target}` of order {order} cannot be written as ONNX. Export to .pt2 instead.")
    return g("ReduceL2", x, g.integers(axes), keepdims=int(keep))


def _deviation(g: OnnxGraph, node: fx.Node, x: str, axes: list[int], correction: int = 1, keepdim: bool = False) -> str:
    if correction:
        raise ExportError("A standard deviation with a correction cannot be written as ONNX. Export to .pt2 instead.")
    away = g("Sub", x, g("ReduceMean", x, g.integers(axes)))
    return g("Sqrt", g("ReduceMean", g("Mul", away, away), g.integers(axes), keepdims=int(keepdim)))


def _concatenation(g: OnnxGraph, node: fx.Node, parts: list[Any], axis: int = 0) -> str:
    arguments: Any = node.args[0]
    return g(
        "Concat", *(as_type(g, value(node).dtype, *each) for each in zip(parts, arguments, strict=True)), axis=axis
    )


def _stack(g: OnnxGraph, node: fx.Node, parts: list[str], axis: int = 0) -> str:
    return g("Concat", *(g("Unsqueeze", part, g.integers([axis])) for part in parts), axis=axis)


def _full(g: OnnxGraph, node: fx.Node, x: str, fill: float, **_: Any) -> str:  # noqa: ANN401
    return g("Expand", fill, shape_name(g, value(node).shape))


def _median(g: OnnxGraph, node: fx.Node, x: str, axis: int, keep: bool = False) -> tuple[str, str]:
    """The lower of the two middle values, as in torch: the largest of the smaller half."""
    smaller = g.integers([(source(node).shape[axis] + 1) // 2])
    values, places = g.several("TopK", 2, x, smaller, axis=axis, largest=0)
    last, axes = (g.integers([-1]), g.integers([torch.iinfo(torch.int64).max])), g.integers([axis])
    median = [g("Slice", each, *last, axes) for each in (values, places)]
    return tuple(each if keep else g("Squeeze", each, axes) for each in median)  # type: ignore[return-value]


def _clamp(g: OnnxGraph, node: fx.Node, x: str, min: int | float | None = None, max: int | float | None = None) -> str:
    return g("Clip", x, min, max)


def _slice(g: OnnxGraph, node: fx.Node, x: str, *limits: Any) -> str:  # noqa: ANN401
    axis, start, end, step = filled(limits, 0, None, None, 1)
    whole = source(node).shape[axis]
    if not start and step == 1 and (end is None or (isinstance(whole, int) and end >= whole)):
        return x
    largest = torch.iinfo(torch.int64).max
    limits = [start or 0], [largest if end is None else end], [axis], [step]
    return g("Slice", x, *map(g.integers, limits))


def _pad(g: OnnxGraph, node: fx.Node, x: str, widths: list[int], mode: str = "constant", fill: float = 0.0) -> str:
    before, after = widths[-2::-2], widths[::-2]
    others = [0] * (source(node).ndim - len(before))
    return g(
        "Pad",
        x,
        g.integers([*others, *before, *others, *after]),
        float(fill or 0.0) if mode == "constant" else None,
        mode={"replicate": "edge"}.get(mode, mode),
    )


def _roll(g: OnnxGraph, node: fx.Node, x: str, shifts: list[int], axes: list[int]) -> str:
    for shift, axis in zip(shifts, axes, strict=True):
        first, second = (
            g("Slice", x, g.integers([start]), g.integers([end]), g.integers([axis]))
            for start, end in ((-shift, torch.iinfo(torch.int64).max), (0, -shift))
        )
        x = g("Concat", first, second, axis=axis)
    return x


def _flip(g: OnnxGraph, node: fx.Node, x: str, axes: list[int]) -> str:
    if not axes:
        return x
    beyond = torch.iinfo(torch.int64).min
    start, end, step = (g.integers([each] * len(axes)) for each in (-1, beyond, -1))
    return g("Slice", x, start, end, g.integers(axes), step)


def reshape(g: OnnxGraph, node: fx.Node, x: str, *_: Any) -> str:  # noqa: ANN401
    """A value in the shape of the node's result."""
    return g("Reshape", x, g.integers(_reshape_target(value(node).shape)))


def _expand(g: OnnxGraph, node: fx.Node, x: str, *_: Any, **__: Any) -> str:  # noqa: ANN401
    return g("Expand", x, shape_name(g, value(node).shape))


def _zeros(g: OnnxGraph, node: fx.Node, *_: Any, **__: Any) -> str:  # noqa: ANN401
    return g("Expand", 0.0, shape_name(g, value(node).shape))


def _cast(g: OnnxGraph, node: fx.Node, x: str, *_: Any, **__: Any) -> str:  # noqa: ANN401
    return as_type(g, value(node).dtype, x, node.args[0])


def _transpose(g: OnnxGraph, node: fx.Node, x: str, one: int, other: int) -> str:
    axes = list(range(source(node).ndim))
    axes[one], axes[other] = axes[other], axes[one]
    return g("Transpose", x, perm=axes)


def _unbind(g: OnnxGraph, node: fx.Node, x: str, axis: int = 0) -> list[str]:
    axes, count = g.integers([axis]), source(node).shape[axis]
    return [g("Squeeze", part, axes) for part in g.several("Split", count, x, axis=axis, num_outputs=count)]


def _split(g: OnnxGraph, node: fx.Node, x: str, size: int, axis: int = 0) -> list[str]:
    lengths = [part.shape[axis] for part in value(node)]
    return g.several("Split", len(lengths), x, g.integers(lengths), axis=axis)


OPERATIONS: dict[Any, Handler] = {
    **dict.fromkeys((_aten.alias.default, _aten.clone.default, _aten.detach.default), _identity),
    **dict.fromkeys((_aten.view.default, _aten._unsafe_view.default, _aten.reshape.default), reshape),
    _aten.unsqueeze.default: reshape,
    **dict.fromkeys((_aten.new_zeros.default, _aten.zeros_like.default), _zeros),
    **dict.fromkeys((_aten._to_copy.default, _aten.to.dtype), _cast),
    _aten.abs.default: _plain("Abs"),
    _aten.add.Tensor: _sum("Add"),
    _aten.amax.default: _reduce("ReduceMax"),
    **dict.fromkeys((_aten.__and__.Tensor, _aten.bitwise_and.Tensor), lambda g, node, a, b: g("And", a, b)),
    _aten.cat.default: _concatenation,
    _aten.clamp.default: _clamp,
    _aten.complex.default: lambda g, node, real, imaginary: Pair(real, imaginary),
    _aten.div.Tensor: _plain("Div"),
    _aten.exp.default: _plain("Exp"),
    _aten.expand.default: _expand,
    _aten.flip.default: _flip,
    _aten.full_like.default: _full,
    **dict.fromkeys((_aten.ge.Tensor, _aten.ge.Scalar), _compare("GreaterOrEqual")),
    **dict.fromkeys((_aten.gt.Tensor, _aten.gt.Scalar), _compare("Greater")),
    _aten.lerp.Scalar: _lerp,
    _aten.linalg_vector_norm.default: _norm,
    _aten.log.default: _plain("Log"),
    **dict.fromkeys((_aten.lt.Tensor, _aten.lt.Scalar), _compare("Less")),
    _aten.matmul.default: _plain("MatMul"),
    _aten.maximum.default: _plain("Max"),
    _aten.mean.dim: _reduce("ReduceMean"),
    _aten.median.dim: _median,
    _aten.mul.Tensor: _plain("Mul"),
    _aten.pad.default: _pad,
    _aten.pow.Scalar: _plain("Pow"),
    _aten.pow.Tensor_Scalar: _plain("Pow"),
    _aten.reciprocal.default: _plain("Reciprocal"),
    _aten.relu.default: _plain("Relu"),
    _aten.roll.default: _roll,
    _aten.rsub.Scalar: lambda g, node, a, b: g("Sub", b, a),
    _aten.sigmoid.default: _plain("Sigmoid"),
    _aten.slice.Tensor: _slice,
    _aten.split.Tensor: _split,
    _aten.sqrt.default: _plain("Sqrt"),
    _aten.square.default: lambda g, node, x: g("Mul", x, x),
    _aten.stack.default: _stack,
    _aten.std.correction: _deviation,
    _aten.sub.Tensor: _sum("Sub"),
    _aten.sum.dim_IntList: _reduce("ReduceSum"),
    _aten.transpose.int: _transpose,
    _aten.unbind.int: _unbind,
    **dict.fromkeys((_aten.where.self, _aten.where.ScalarOther, _aten.where.ScalarSelf), _where),
}
"""Handlers of arithmetic, reductions and shapes."""

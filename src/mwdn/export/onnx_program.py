"""Conversion of a program of torch.export to ONNX, with real numbers only and Fourier transforms as matrix products.

Values that depend on no input are computed here, once. torch's own ONNX exporter is not used: it supports few complex
operations, leaves transforms to the runtime, and takes minutes for the thousand operations of an iterative method.
"""

import operator
import warnings
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor, fx
from torch.export import ExportedProgram

from mwdn.errors import ExportError
from mwdn.export import dft
from mwdn.export.loops import BEGIN, END
from mwdn.export.onnx_graph import OnnxGraph, Pair
from mwdn.export.onnx_layers import LAYERS
from mwdn.export.onnx_operations import OPERATIONS, Handler, filled, source, value

if TYPE_CHECKING:
    import onnx

REAL_HANDLERS = OPERATIONS | LAYERS
"""Handlers of operations on real tensors."""

_aten = torch.ops.aten
_ROWS, _COLUMNS = _aten.fft_rfft.default, _aten.fft_fft.default
_TO_ROWS, _TO_COLUMNS = _aten.fft_irfft.default, _aten.fft_ifft.default
_AXIS: dict[Any, int] = {_ROWS: -1, _COLUMNS: -2, _TO_ROWS: -1, _TO_COLUMNS: -2}
"""The transforms used by `mwdn.fourier`, and the axis of each."""


def to_onnx(program: ExportedProgram, outputs: Sequence[str] = ("scene",)) -> "onnx.ModelProto":
    """Convert a program to a model whose inputs have the names of the program's arguments.

    Args:
        program: from `torch.export.export`; its inputs and outputs are real. If its batch size is free, it is that of
            an argument ``measurement``.
        outputs: their names, in the program's order.

    Raises:
        ExportError: an operation is not supported.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FutureWarning)  # torch warns when it copies a program
        module = program.run_decompositions({}).module()
    values, steps = _fold_constants(module)
    g = OnnxGraph()
    inputs = {}
    in_loop: set[fx.Node] = set()  # nodes that depend on the state of the open loop
    arguments: Any
    for step in steps:
        if step.op == "placeholder":
            values[step] = step.name
            inputs[step.name] = _axes(value(step))
        elif step.op == "call_function":
            arguments, options = fx.map_arg((step.args, step.kwargs), values.get)
            if step.target is BEGIN:
                state, count = arguments
                values[step] = _like(state, g.begin_loop(_parts(state), count))
                in_loop = {step}
            elif step.target is END:
                (state,) = arguments
                values[step] = _like(state, g.end_loop(_parts(state)))
                in_loop = set()
            elif in_loop and in_loop.isdisjoint(step.all_input_nodes):
                with g.outside():
                    values[step] = _convert(g, step, arguments, options)
            else:
                values[step] = _convert(g, step, arguments, options)
                if in_loop:
                    in_loop.add(step)
        elif step.op == "output":
            results: Any = step.args[0]
            named = zip(outputs, results if isinstance(results, tuple | list) else [results], strict=True)
            return g.model(inputs, {name: (values[node], _axes(value(node))) for name, node in named})
    raise AssertionError("A program has an output.")


def _fold_constants(module: fx.GraphModule) -> tuple[dict[fx.Node, Any], list[fx.Node]]:
    """Values of all operations that depend on no input, complex ones as pairs, and the remaining operations."""
    values: dict[fx.Node, Any] = {}
    steps = []
    for node in module.graph.nodes:
        if node.op == "get_attr":
            values[node] = operator.attrgetter(str(node.target))(module)
        elif (
            node.op == "call_function"
            and node.target not in (BEGIN, END)
            and all(source in values for source in node.all_input_nodes)
        ):
            arguments, options = fx.map_arg((node.args, node.kwargs), values.__getitem__)
            values[node] = node.target(*arguments, **options)
        elif node.op != "call_module" and node.target is not _aten._assert_tensor_metadata.default:  # only checks
            steps.append(node)
    pairs = {node: Pair(v.real, v.imag) for node, v in values.items() if isinstance(v, Tensor) and v.is_complex()}
    return values | pairs, steps


def _parts(state: list[Any]) -> list[Any]:
    """The numbers of a state, complex ones in two parts."""
    return [part for each in state for part in (each if isinstance(each, Pair) else (each,))]


def _like(state: list[Any], parts: Sequence[str]) -> list[Any]:
    """The inverse of `_parts`."""
    names = iter(parts)
    return [Pair(next(names), next(names)) if isinstance(each, Pair) else next(names) for each in state]


def _axes(image: Tensor) -> list[int | str]:
    return [length if isinstance(length, int) else "batch" for length in image.shape]


def _convert(g: OnnxGraph, step: fx.Node, arguments: Any, options: Any) -> Any:  # noqa: ANN401
    """Add an operation to the graph; returns its result."""
    if not isinstance(value(step), Tensor | tuple | list):
        return None  # the batch size, which the shapes hold
    if step.target is operator.getitem or (step.target is _aten.select.int and isinstance(arguments[0], Pair)):
        return arguments[0][arguments[-1]]
    handlers = _TRANSFORMS if step.target in _AXIS else REAL_HANDLERS
    if step.target not in _AXIS and any(_is_complex(source) for source in step.all_input_nodes):
        handlers = _ON_PAIRS
    if step.target not in handlers:
        kind = "of complex numbers " if handlers is _ON_PAIRS else ""
        raise ExportError(f"`{step.target}` {kind}cannot be written as ONNX. Export to .pt2 instead.")
    return handlers[step.target](g, step, *arguments, **options)


def _is_complex(node: fx.Node) -> bool:
    return isinstance(value(node), Tensor) and value(node).is_complex()


def _length(node: fx.Node) -> int:
    """Length of a transform along the axis of `_AXIS`."""
    axis, dimensions = _AXIS[node.target], source(node).ndim
    _, n, along, norm = filled(node.args, None, None, -1, None)
    if along % dimensions != axis % dimensions or norm or node.kwargs:
        raise ExportError(f"`{node.target}` along another axis cannot be written as ONNX. Export to .pt2 instead.")
    return n or source(node).shape[axis]


def _kept(node: fx.Node) -> int:
    """Number of frequencies or points along its axis that are used: all users may slice off the others."""
    axis, ends = _AXIS[node.target], []
    whole = value(node).shape[axis]
    for user in node.users:
        ends.append(whole)
        if user.target is _aten.slice.Tensor:
            _, along, start, end, step = filled(user.args, None, 0, None, None, 1)
            if along % value(node).ndim == axis % value(node).ndim and not start and step == 1 and end is not None:
                ends[-1] = end
    return min(whole, max(ends, default=whole))


def _rows(g: OnnxGraph, node: fx.Node, image: str, *_: Any) -> Pair:  # noqa: ANN401
    both = g("MatMul", image, dft.row_matrix(source(node).shape[-1], _length(node)))
    return Pair(*g.several("Split", 2, both, axis=-1, num_outputs=2))


def _to_rows(g: OnnxGraph, node: fx.Node, rows: Pair, *_: Any) -> str:  # noqa: ANN401
    return g("MatMul", g("Concat", *rows, axis=-1), dft.inverse_row_matrix(_length(node), _kept(node)))


def _columns(g: OnnxGraph, node: fx.Node, columns: Pair, *_: Any) -> Pair:  # noqa: ANN401
    given, width = source(node).shape[-2:]
    kept = _kept(node)
    matrices = dft.column_matrices(_length(node), given, kept, inverse=node.target is _TO_COLUMNS)
    parts, points, below = matrices.parts, matrices.points, matrices.rows * matrices.points - given
    if below:
        columns = Pair(*(g("Pad", part, g.integers([0] * 6 + [below, 0])) for part in columns))
    stacked = g("Concat", *columns, axis=2)
    stacked = g("Reshape", stacked, g.integers([0, 0, 2 * matrices.rows, points * width]))
    sums = g("MatMul", matrices.first, stacked)
    sums = g("MatMul", matrices.second, g("Reshape", sums, g.integers([0, 0, parts, 2 * points, width])))
    sums = g("Reshape", sums, g.integers([0, 0, parts, 2, -1, width]))
    both = g("Reshape", g("Transpose", sums, perm=[0, 1, 3, 4, 2, 5]), g.integers([0, 0, -1, width]))
    computed = matrices.second.shape[1] // 2 * parts  # kept, rounded up to a multiple of N1
    if computed == kept:
        return Pair(*g.several("Split", 2, both, axis=2, num_outputs=2))
    starts = 0, computed  # of the real and the imaginary frequencies
    return Pair(*(g("Slice", both, g.integers([s]), g.integers([s + kept]), g.integers([2])) for s in starts))


_TRANSFORMS: dict[Any, Handler] = {_ROWS: _rows, _TO_ROWS: _to_rows, _COLUMNS: _columns, _TO_COLUMNS: _columns}


def _on_both(target: Any) -> Handler:  # noqa: ANN401
    return lambda g, node, pair, *arguments, **options: Pair(
        *(REAL_HANDLERS[target](g, node, part, *arguments, **options) for part in pair)
    )


def _multiply(g: OnnxGraph, node: fx.Node, a: Any, b: Any) -> Pair:  # noqa: ANN401
    if not (isinstance(a, Pair) and isinstance(b, Pair)):
        pair, factor = (a, b) if isinstance(a, Pair) else (b, a)
        factor = torch.tensor(factor) if isinstance(factor, float) else factor
        return Pair(g("Mul", pair.real, factor), g("Mul", pair.imaginary, factor))
    real = g("Sub", g("Mul", a.real, b.real), g("Mul", a.imaginary, b.imaginary))
    return Pair(real, g("Add", g("Mul", a.real, b.imaginary), g("Mul", a.imaginary, b.real)))


def _add(g: OnnxGraph, node: fx.Node, a: Pair, b: Pair, *, alpha: float = 1) -> Pair:
    scaled = b if alpha == 1 else _multiply(g, node, b, float(alpha))
    return Pair(*(g("Add", *each) for each in zip(a, scaled, strict=True)))


def _concatenate(g: OnnxGraph, node: fx.Node, pairs: list[Pair], axis: int = 0) -> Pair:
    return Pair(*(g("Concat", *parts, axis=axis) for parts in zip(*pairs, strict=True)))


_ON_PAIRS: dict[Any, Handler] = {
    **dict.fromkeys((_aten.alias.default, _aten.clone.default), lambda g, node, pair, **_: pair),
    **{each: _on_both(each) for each in (_aten.slice.Tensor, _aten.transpose.int)},
    _aten._conj.default: lambda g, node, a: Pair(a.real, g("Neg", a.imaginary)),
    _aten.abs.default: lambda g, node, a: g("Sqrt", g("Add", g("Mul", a[0], a[0]), g("Mul", a[1], a[1]))),
    _aten.add.Tensor: _add,
    _aten.cat.default: _concatenate,
    _aten.view_as_real.default: lambda g, node, pair: pair,  # of which one part is selected
    _aten.addcmul.default: lambda g, node, a, b, c: _add(g, node, a, _multiply(g, node, b, c)),
    _aten.div.Tensor: lambda g, node, a, b: Pair(*(g("Div", part, b) for part in a)),
    _aten.mul.Tensor: _multiply,
}
"""Handlers of complex operations."""

"""A graph of ONNX that is written operation by operation."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

if TYPE_CHECKING:
    import onnx

OPSET = 18
"""Version of the operations; onnxruntime has had it since 1.14 (2023)."""


class Pair(NamedTuple):
    """Real and imaginary part of a complex tensor."""

    real: Any
    imaginary: Any


class OnnxGraph:
    """Nodes and constants; what is calculated is a name, what is known a tensor or a number."""

    def __init__(self) -> None:
        self.nodes: list[onnx.NodeProto] = []
        self.constants: dict[tuple[str, tuple[int, ...], bytes], onnx.TensorProto] = {}
        self.count = 0

    def __call__(self, operation: str, *inputs: Any, **attributes: Any) -> str:  # noqa: ANN401
        """Add an operation of one result, and name that; ``None`` for an input that is left out."""
        return self.several(operation, 1, *inputs, **attributes)[0]

    def several(self, operation: str, results: int, *inputs: Any, **attributes: Any) -> list[str]:  # noqa: ANN401
        """Add an operation, and name its results."""
        from onnx import helper

        self.count += 1
        names = [f"{operation.lower()}_{self.count}_{index}" for index in range(results)]
        given = ["" if value is None else self.name(value) for value in inputs]
        self.nodes.append(helper.make_node(operation, given, names, name=names[0], **attributes))
        return names

    def name(self, value: str | Tensor | float) -> str:
        """The name of a result, or of a constant, which is kept once."""
        if isinstance(value, str):
            return value
        found = value.detach().cpu() if isinstance(value, Tensor) else torch.tensor(value, dtype=torch.float32)
        return self._constant(found.contiguous().numpy())

    def integers(self, values: Sequence[int]) -> str:
        """The name of a constant list of integers."""
        return self._constant(np.array(list(values), np.int64))

    def _constant(self, array: Any) -> str:  # noqa: ANN401
        from onnx import numpy_helper

        key = array.dtype.str, array.shape, array.tobytes()
        if key not in self.constants:
            self.constants[key] = numpy_helper.from_array(array, f"constant_{len(self.constants)}")
        return self.constants[key].name

    def model(self, result: str, shapes: Mapping[str, Sequence[int | str]]) -> "onnx.ModelProto":
        """The whole, of one input and one output of float32.

        Args:
            result: name of what is to be the output.
            shapes: of input and output by their names, in this order; a string is an axis of any length.
        """
        from onnx import TensorProto, helper

        given, found = (helper.make_tensor_value_info(n, TensorProto.FLOAT, s) for n, s in shapes.items())
        last = helper.make_node("Identity", [result], [found.name])
        graph = helper.make_graph([*self.nodes, last], "mwdn", [given], [found], list(self.constants.values()))
        return helper.make_model(graph, opset_imports=[helper.make_opsetid("", OPSET)], ir_version=8)

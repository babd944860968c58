"""Builder of ONNX graphs."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

if TYPE_CHECKING:
    import onnx

OPSET = 18
"""Version of the operations; onnxruntime supports it since 1.14 (2023)."""


class Pair(NamedTuple):
    """Real and imaginary part of a complex tensor."""

    real: Any
    imaginary: Any


class OnnxGraph:
    """An ONNX graph under construction: computed values are names, constants are tensors or numbers."""

    def __init__(self) -> None:
        self.nodes: list[onnx.NodeProto] = []
        self.constants: dict[tuple[str, tuple[int, ...], bytes], onnx.TensorProto] = {}
        self.count = 0
        self.around: list[onnx.NodeProto] = []
        self.loop: tuple[list[str], list[str], int] = [], [], 0

    def __call__(self, operation: str, *inputs: Any, **attributes: Any) -> str:  # noqa: ANN401
        """Add an operation with one result and return its name; ``None`` stands for a missing input."""
        return self.several(operation, 1, *inputs, **attributes)[0]

    def several(self, operation: str, results: int, *inputs: Any, **attributes: Any) -> list[str]:  # noqa: ANN401
        """Add an operation with several results and return their names."""
        from onnx import helper

        self.count += 1
        names = [f"{operation.lower()}_{self.count}_{index}" for index in range(results)]
        input_names = ["" if value is None else self.name(value) for value in inputs]
        self.nodes.append(helper.make_node(operation, input_names, names, name=names[0], **attributes))
        return names

    def name(self, value: str | Tensor | float | int) -> str:
        """Name of a computed value, or of a constant; equal constants are stored once."""
        if isinstance(value, str):
            return value
        tensor = value.detach().cpu() if isinstance(value, Tensor) else torch.tensor(value, dtype=torch.float32)
        return self._constant(tensor.contiguous().numpy())

    def integers(self, values: Sequence[int]) -> str:
        """Name of a constant list of integers."""
        return self._constant(np.array(list(values), np.int64))

    def _constant(self, array: Any) -> str:  # noqa: ANN401
        from onnx import numpy_helper

        key = array.dtype.str, array.shape, array.tobytes()
        if key not in self.constants:
            self.constants[key] = numpy_helper.from_array(array, f"constant_{len(self.constants)}")
        return self.constants[key].name

    def begin_loop(self, state: Sequence[Any], count: int) -> list[str]:
        """Begin the body of a loop of ``count`` iterations; returns the names of the state in it, all float32.

        Operations that do not depend on the state can be added outside of the body, see `outside`.
        """
        self.count += 1
        names = [f"state_{self.count}_{index}" for index in range(len(state))]
        self.loop = [self.name(value) for value in state], names, count
        self.around, self.nodes = self.nodes, []
        return names

    def end_loop(self, state: Sequence[Any]) -> list[str]:
        """End the body; returns the names of the state after the loop."""
        from onnx import TensorProto, helper

        start, names, count = self.loop
        results = [self("Identity", value) for value in state]
        given = helper.make_node("Identity", ["go_on"], ["goes_on"])
        number = helper.make_tensor_value_info("number", TensorProto.INT64, [])
        inputs, outputs = (
            [
                helper.make_tensor_value_info(flag, TensorProto.BOOL, []),
                *(helper.make_tensor_value_info(name, TensorProto.FLOAT, None) for name in floats),
            ]
            for flag, floats in (("go_on", names), ("goes_on", results))
        )
        body = helper.make_graph([*self.nodes, given], f"body_{self.count}", [number, *inputs], outputs)
        self.nodes = self.around
        return self.several("Loop", len(state), self.integers([count]), None, *start, body=body)

    @contextmanager
    def outside(self) -> Iterator[None]:
        """Add operations outside of the body that has begun, before the loop."""
        self.nodes, self.around = self.around, self.nodes
        yield
        self.nodes, self.around = self.around, self.nodes

    def model(
        self, inputs: Mapping[str, Sequence[int | str]], outputs: Mapping[str, tuple[Any, Sequence[int | str]]]
    ) -> "onnx.ModelProto":
        """The finished model, whose inputs and outputs are float32.

        Args:
            inputs: shape of each by name; a string is an axis of any length.
            outputs: value and shape of each by name.
        """
        from onnx import TensorProto, helper

        sources = [helper.make_tensor_value_info(name, TensorProto.FLOAT, shape) for name, shape in inputs.items()]
        targets = [helper.make_tensor_value_info(name, TensorProto.FLOAT, s) for name, (_, s) in outputs.items()]
        last = [helper.make_node("Identity", [self.name(value)], [name]) for name, (value, _) in outputs.items()]
        graph = helper.make_graph([*self.nodes, *last], "mwdn", sources, targets, list(self.constants.values()))
        return helper.make_model(graph, opset_imports=[helper.make_opsetid("", OPSET)], ir_version=8)

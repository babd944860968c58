"""Quantisation of an ONNX file's convolutions to eight bits."""

import logging
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from mwdn.inference.fusion import MIN_HALF_CHANNELS
from mwdn.types import Measurement


class _Captures:
    """Measurements in the form of onnxruntime's calibration: one input after the other, then ``None``."""

    def __init__(self, measurements: Measurement) -> None:
        self.remaining: Iterator[Measurement] = iter(measurements[:, None])

    def get_next(self) -> dict[str, Any] | None:
        measurement = next(self.remaining, None)
        return None if measurement is None else {"measurement": measurement.numpy()}


def quantise(file: Path, measurements: Measurement) -> None:
    """Replace a file by one whose convolutions have eight-bit inputs and outputs.

    Convolutions with few input channels, which see the picture itself, and the last one, which makes the picture, stay
    float32: eight bits would be visible there.

    Args:
        file: ONNX, from `mwdn.export`.
        measurements: (B, C, H, W), typical captures, which give the range of each layer.
    """
    import onnx
    from onnxruntime import quantization

    model = onnx.load(str(file))
    shapes = {constant.name: constant.dims for constant in model.graph.initializer}
    convolutions = [node for node in model.graph.node if node.op_type == "Conv"]
    kept = [
        node.name for node in convolutions if shapes[node.input[1]][1] < MIN_HALF_CHANNELS or node is convolutions[-1]
    ]
    level = logging.root.level
    logging.root.setLevel(logging.ERROR)  # hides onnxruntime's advice on models of other kinds
    try:
        quantization.quantize_static(
            model,
            str(file),
            _Captures(measurements),
            op_types_to_quantize=["Conv"],
            nodes_to_exclude=kept,
            per_channel=True,
            extra_options={"ForceQuantizeNoInputCheck": False},
        )
    finally:
        logging.root.setLevel(level)

"""Convolutions of an ONNX file in eight bits."""

import logging
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from mwdn.inference.fusion import MIN_HALF_CHANNELS
from mwdn.types import Measurement


class _Captures:
    """What onnxruntime's calibration asks for: one input after the other, then ``None``."""

    def __init__(self, measurements: Measurement) -> None:
        self.left: Iterator[Measurement] = iter(measurements[:, None])

    def get_next(self) -> dict[str, Any] | None:
        one = next(self.left, None)
        return None if one is None else {"measurement": one.numpy()}


def quantise(file: Path, measurements: Measurement) -> None:
    """Replace a file by one whose convolutions take and give eight bits, their ranges found with measurements.

    Left in float32 are convolutions of few channels, which see the picture itself, and the last one, which makes the
    picture: eight bits would show there.

    Args:
        file: ONNX, as `mwdn.export` writes it.
        measurements: (B, C, H, W), like those that the file will meet.
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
    logging.root.setLevel(logging.ERROR)  # advice about preparing models that are not ours
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

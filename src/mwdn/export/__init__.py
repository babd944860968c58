"""Export of methods to other runtimes: ONNX and torch.export."""

from mwdn.export.exporter import Exported, export
from mwdn.export.model_file import read_about, run_file

__all__ = ["Exported", "export", "read_about", "run_file"]

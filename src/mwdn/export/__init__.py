"""Networks written for other runtimes: ONNX and torch.export."""

from mwdn.export.exporter import Exported, export, read_about, run_file

__all__ = ["Exported", "export", "read_about", "run_file"]

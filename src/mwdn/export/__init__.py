"""Export of methods to other runtimes: ONNX, torch.export, and pages for browsers."""

from mwdn.export.exporter import Exported, export
from mwdn.export.model_file import read_about, run_file
from mwdn.export.site import export_site

__all__ = ["Exported", "export", "export_site", "read_about", "run_file"]

"""Metrics, protocols and the comparison of methods."""

from mwdn.evaluation.evaluate import First, evaluate, learnable_numbers
from mwdn.evaluation.metrics import Perceptual, Protocol, Variant, bootstrap, measure, psnr
from mwdn.evaluation.report import Report, Scores

__all__ = [
    "First",
    "Perceptual",
    "Protocol",
    "Report",
    "Scores",
    "Variant",
    "bootstrap",
    "evaluate",
    "learnable_numbers",
    "measure",
    "psnr",
]

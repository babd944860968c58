"""Metrics, protocols, and the comparison of methods."""

from mwdn.evaluation.consistency import Consistency, consistency
from mwdn.evaluation.distances import feature_mse, l1, log_mse, lpips, mse, ssim
from mwdn.evaluation.evaluate import First, evaluate, learnable_numbers
from mwdn.evaluation.metrics import Perceptual, Protocol, Variant, bootstrap, measure, psnr
from mwdn.evaluation.report import JSON, SHEET, Report, Scores

__all__ = [
    "JSON",
    "SHEET",
    "Consistency",
    "First",
    "Perceptual",
    "Protocol",
    "Report",
    "Scores",
    "Variant",
    "bootstrap",
    "consistency",
    "evaluate",
    "feature_mse",
    "l1",
    "learnable_numbers",
    "log_mse",
    "lpips",
    "measure",
    "mse",
    "psnr",
    "ssim",
]

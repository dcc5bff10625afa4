"""Perceptual metrics of images: LPIPS and FLIP; see docs/reference/metrics.md."""

from nerfro.evaluation.perceptual import flip, lpips

__all__ = ["flip", "lpips"]

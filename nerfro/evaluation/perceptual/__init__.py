"""Perceptual metrics of images: LPIPS and FLIP; see docs/reference/metrics.md."""

"""Scoring the pictures of a folder against those of another."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import torch
from tqdm import tqdm

from nerfro.data.image_files import Alpha
from nerfro.evaluation.error_sheets import write_error_sheet
from nerfro.evaluation.folders import PicturePair
from nerfro.evaluation.lpips import LpipsNetwork
from nerfro.evaluation.metrics import ImageMetrics
from nerfro.evaluation.results import EvaluationResult


def score_folders(
    pairs: list[PicturePair],
    alpha: Alpha,
    metrics: ImageMetrics,
    networks: Mapping[str, LpipsNetwork],
    folder: Path,
    device: torch.device,
) -> EvaluationResult:
    """Score each prediction on a device, and draw its error maps into `folder/errors`.

    A file that is damaged or does not fit its partner is told before anything is scored.
    """
    for pair in pairs:  # kept in memory for no longer than it takes
        pair.load(alpha)
    metrics = metrics.to(device)
    for pair in tqdm(pairs, unit="view", desc="evaluate", dynamic_ncols=True):
        prediction, reference, coverage = pair.load(alpha)
        prediction, reference = prediction.to(device), reference.to(device)
        metrics.update(prediction, reference, coverage=None if coverage is None else coverage.to(device))
        write_error_sheet(folder, pair.name, prediction, reference, networks)
    return metrics.result([pair.name for pair in pairs])

"""`python -m nerfro.evaluate checkpoint=...`: render and score the views of a trained model."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Optional

import rich
import torch
from omegaconf import MISSING, DictConfig, OmegaConf

from nerfro.callbacks import Throughput
from nerfro.cli import entry_point
from nerfro.config import build_model
from nerfro.errors import NerfroError
from nerfro.evaluation.lpips import find_lpips_network
from nerfro.evaluation.metrics import ImageMetrics
from nerfro.evaluation.render_view import Supersampling
from nerfro.evaluation.results import EvaluationResult, write_metrics_json
from nerfro.evaluation.score_views import score_views
from nerfro.evaluation.tables import to_rich, views_table, write_table
from nerfro.models.base import NerfModel
from nerfro.registry import build
from nerfro.run_folder import load_checkpoint


@dataclass
class EvaluateConfig:
    """What `python -m nerfro.evaluate` is asked.

    Attributes:
        checkpoint: file written by nerfro.train.
        split: of the data to render.
        root: folder of the data, if it has moved since training.
        out: folder for pictures and tables; beside the checkpoint's folder by default.
        chunk_size: rays rendered at once, which bounds the memory; the trained one by default.
        lpips_backbone: file of AlexNet weights, if torch's hub cache has none.
        supersample, divergence: rays per pixel (see docs/experiments.md); as trained by default.
        device: `cpu`, `cuda`, or `auto` for a GPU if there is one.
        overwrite: whether an earlier evaluation in `out` may be replaced.
    """

    checkpoint: str = MISSING
    split: str = "test"
    root: Optional[str] = None  # noqa: UP045 - OmegaConf on Python 3.10 wants Optional
    out: Optional[str] = None  # noqa: UP045
    chunk_size: Optional[int] = None  # noqa: UP045
    lpips_backbone: Optional[str] = None  # noqa: UP045
    supersample: Optional[int] = None  # noqa: UP045
    divergence: Optional[float] = None  # noqa: UP045
    device: str = "auto"
    overwrite: bool = False


@entry_point("evaluate", EvaluateConfig)
def main(config: DictConfig) -> None:
    """Load, check, render, score, print."""
    if OmegaConf.is_missing(config, "checkpoint"):
        raise NerfroError("which model? give checkpoint=RUN/checkpoints/last.ckpt")
    path = Path(config.checkpoint).expanduser()
    checkpoint, trained = load_checkpoint(path)
    folder = Path(config.out) if config.out else path.parent.parent / f"evaluate_{config.split}"
    if (folder / "metrics.json").exists() and not config.overwrite:
        raise NerfroError(f"{folder} holds an evaluation already; give another out=... or overwrite=true")
    if config.root is not None:
        trained.data.root = config.root
    for name in ("chunk_size", "lpips_backbone", "supersample", "divergence"):
        if config[name] is not None:
            trained.evaluation[name] = config[name]
    wanted = trained.evaluation
    supersampling = Supersampling(wanted.supersample, wanted.divergence)
    device = _device(config.device)
    views = build(trained.data).load(config.split)
    model = restore(checkpoint, trained).to(device)
    metrics = ImageMetrics(*find_lpips_network(wanted.lpips_backbone), prefix=config.split)
    result = score_views(model, views, metrics, folder, supersampling)
    throughput = Throughput()
    throughput.load_state_dict(checkpoint["callbacks"]["Throughput"])
    report(
        result,
        f"{trained.name} on {trained.data.root}, {config.split} views",
        folder,
        checkpoint["global_step"],
        throughput,
    )
    print(f"pictures and tables: {folder}")


def restore(checkpoint: dict, config: DictConfig) -> NerfModel:
    """The trained model of a checkpoint.

    Raises:
        NerfroError: the weights do not fit the configuration.
    """
    model = build_model(config)
    try:
        model.load_state_dict(checkpoint["state_dict"])
    except RuntimeError as error:
        reason = str(error).strip().split("\n")[-1].strip()
        raise NerfroError(
            f"the checkpoint's weights do not fit its configuration: {reason}; was nerfro updated?"
        ) from error
    return model.eval()


def report(result: EvaluationResult, title: str, folder: Path, steps: int, throughput: Throughput) -> None:
    """Write metrics.json and the tables into a folder and print the table.

    Args:
        result: scores.
        title: of the table.
        folder: where the files go.
        steps: optimiser steps of the model.
        throughput: of the training.
    """
    write_metrics_json(folder / "metrics.json", result, steps, throughput.seconds, throughput.rays_per_second)
    table = views_table(result, title)
    write_table(table, folder / "metrics")
    rich.print(to_rich(table))


def _device(name: str) -> torch.device:
    if name == "auto":
        name = "cuda" if torch.cuda.is_available() else "cpu"
    try:
        device = torch.device(name)
        torch.zeros(1, device=device)
    except (RuntimeError, AssertionError) as error:
        raise NerfroError(f"device={name} cannot be used; choose cpu, cuda or auto") from error
    return device


if __name__ == "__main__":
    main()

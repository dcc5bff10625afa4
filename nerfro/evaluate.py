"""`python -m nerfro.evaluate checkpoint=...` or `predictions=DIR references=DIR`: score a model, or any pictures."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Optional

import rich
import torch
from omegaconf import DictConfig
from torch import Tensor
from tqdm import tqdm

from nerfro.cli import entry_point
from nerfro.errors import NerfroError
from nerfro.evaluation.error_maps import error_maps
from nerfro.evaluation.error_sheets import error_sheet
from nerfro.evaluation.folders import match_folders
from nerfro.evaluation.lpips import LpipsNetwork, find_lpips_networks
from nerfro.evaluation.metrics import ImageMetrics
from nerfro.evaluation.render_view import Supersampling
from nerfro.evaluation.results import FULL, EvaluationResult, write_metrics_json
from nerfro.evaluation.score_tables import regions_table, views_table
from nerfro.evaluation.score_views import score_views
from nerfro.evaluation.tables import to_rich, write_table
from nerfro.files.atomic import refuse_existing
from nerfro.files.images import load_png, save_png
from nerfro.models.base import NerfModel
from nerfro.registry import build
from nerfro.training.callbacks import Throughput
from nerfro.training.config import build_model
from nerfro.training.run_folder import load_checkpoint


@dataclass
class EvaluateConfig:
    """What `python -m nerfro.evaluate` is asked: to score a trained model, or pictures that any program rendered.

    Attributes:
        checkpoint: file written by nerfro.train, to render and score.
        split: of the data to render.
        root: folder of the data, if it has moved since training.
        chunk_size: rays rendered at once, which bounds the memory; the trained one by default.
        supersample, divergence: rays per pixel (see docs/experiments.md); as trained by default.
        predictions: folder of pictures to score, instead of a checkpoint.
        references: folder of pictures of the same names, compared with `predictions`.
        masks: folder of masks of the same names; by default those that lie with the references, or their transparency.
        alpha: what becomes of transparency in `predictions` and `references`: `drop`, or composite over `white` or
            `black`.
        out: folder for pictures and tables; by default beside the checkpoint's folder, or `scores` in `predictions`.
        protocol: `8bit` rounds predictions to what a PNG holds before they are scored, `float` does not.
        lpips_backbone: file of AlexNet weights, if torch's hub cache has none.
        lpips_vgg_backbone: file of VGG-16 weights, if torch's hub cache has none.
        device: `cpu`, `cuda`, or `auto` for a GPU if there is one.
        overwrite: whether an earlier evaluation in `out` may be replaced.
    """

    checkpoint: Optional[str] = None  # noqa: UP045 - OmegaConf on Python 3.10 wants Optional
    split: str = "test"
    root: Optional[str] = None  # noqa: UP045
    chunk_size: Optional[int] = None  # noqa: UP045
    supersample: Optional[int] = None  # noqa: UP045
    divergence: Optional[float] = None  # noqa: UP045
    predictions: Optional[str] = None  # noqa: UP045
    references: Optional[str] = None  # noqa: UP045
    masks: Optional[str] = None  # noqa: UP045
    alpha: str = "drop"
    out: Optional[str] = None  # noqa: UP045
    protocol: str = "8bit"
    lpips_backbone: Optional[str] = None  # noqa: UP045
    lpips_vgg_backbone: Optional[str] = None  # noqa: UP045
    device: str = "auto"
    overwrite: bool = False


@entry_point("evaluate", EvaluateConfig)
def main(config: DictConfig) -> None:
    """Load, check, render if there is a model, score, print."""
    _require_one_task(config)
    folder = _evaluate_folder(config) if config.checkpoint is None else _evaluate_checkpoint(config)
    print(f"pictures and tables: {folder}")


def _evaluate_checkpoint(config: DictConfig) -> Path:
    path = Path(config.checkpoint).expanduser()
    checkpoint, trained = load_checkpoint(path)
    folder = _free_folder(config, path.parent.parent / f"evaluate_{config.split}")
    if config.root is not None:
        trained.data.root = config.root
    for name in ("chunk_size", "lpips_backbone", "lpips_vgg_backbone", "supersample", "divergence"):
        if config[name] is not None:
            trained.evaluation[name] = config[name]
    wanted = trained.evaluation
    supersampling = Supersampling(wanted.supersample, wanted.divergence)
    device = _device(config.device)
    views = build(trained.data).load(config.split)
    model = restore(checkpoint, trained).to(device)
    # Checkpoints from before there was LPIPS over VGG-16 lack the option.
    networks, reasons = find_lpips_networks(wanted.lpips_backbone, wanted.get("lpips_vgg_backbone"))
    metrics = ImageMetrics(networks, reasons, config.protocol == "8bit", prefix=config.split)
    result = score_views(model, views, metrics, folder, supersampling)
    for index, view in enumerate(result.views):
        prediction = load_png(folder / "images" / f"{view.name}.png")
        _write_errors(folder, view.name, prediction, views.images[index], networks)
    throughput = Throughput()
    throughput.load_state_dict(checkpoint["callbacks"]["Throughput"])
    title = f"{trained.name} on {trained.data.root}, {config.split} views"
    report(result, title, folder, checkpoint["global_step"], throughput)
    return folder


def _evaluate_folder(config: DictConfig) -> Path:
    predictions, references = Path(config.predictions).expanduser(), Path(config.references).expanduser()
    masks = None if config.masks is None else Path(config.masks).expanduser()
    pairs = match_folders(predictions, references, masks)
    folder = _free_folder(config, predictions / "scores")
    device = _device(config.device)
    for pair in pairs:  # a damaged file is told before anything is scored, and kept in memory for no longer than that
        pair.load(config.alpha)
    networks, reasons = find_lpips_networks(config.lpips_backbone, config.lpips_vgg_backbone)
    metrics = ImageMetrics(networks, reasons, config.protocol == "8bit").to(device)
    for pair in tqdm(pairs, unit="view", desc="evaluate", dynamic_ncols=True):
        prediction, reference, coverage = pair.load(config.alpha)
        prediction, reference = prediction.to(device), reference.to(device)
        metrics.update(prediction, reference, coverage=None if coverage is None else coverage.to(device))
        _write_errors(folder, pair.name, prediction, reference, networks)
    result = metrics.result([pair.name for pair in pairs])
    report(result, f"{predictions} against {references}", folder, None, None)
    return folder


def _require_one_task(config: DictConfig) -> None:
    """Refuse options that contradict each other, or that would be passed over."""
    if (config.checkpoint is None) == (config.predictions is None):
        raise NerfroError(
            "what is to be scored? give checkpoint=RUN/checkpoints/last.ckpt, or predictions=DIR and references=DIR"
        )
    if config.predictions is not None and config.references is None:
        raise NerfroError(f"predictions={config.predictions} are compared with what? give references=DIR")
    others: tuple[str, ...]
    if config.checkpoint is None:
        task, others = "predictions", ("split", "root", "chunk_size", "supersample", "divergence")
    else:
        task, others = "checkpoint", ("references", "masks", "alpha")
    for name in others:
        if config[name] != getattr(EvaluateConfig, name):
            raise NerfroError(f"{name}={config[name]} means nothing with {task}=...; leave it out")
    for name, allowed in (("protocol", ("8bit", "float")), ("alpha", ("drop", "white", "black"))):
        if config[name] not in allowed:
            raise NerfroError(f"{name}={config[name]} is not allowed; choose one of {', '.join(allowed)}")


def _free_folder(config: DictConfig, default: Path) -> Path:
    folder = default if config.out is None else Path(config.out).expanduser()
    refuse_existing([folder / "metrics.json"], config.overwrite)
    return folder


def _write_errors(
    folder: Path, name: str, prediction: Tensor, reference: Tensor, networks: Mapping[str, LpipsNetwork]
) -> None:
    """Write a view's error maps."""
    maps = error_maps(prediction, reference, networks)
    save_png(folder / "errors" / f"{name}.png", error_sheet(prediction, reference, maps))


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


def report(
    result: EvaluationResult, title: str, folder: Path, steps: int | None, throughput: Throughput | None
) -> None:
    """Write metrics.json and the tables into a folder, and print the views' and the regions' table.

    Args:
        result: scores.
        title: of the table.
        folder: where the files go.
        steps: optimiser steps of the model; None for pictures of another program.
        throughput: of the training; None for pictures of another program.
    """
    seconds, rays_per_second = (None, None) if throughput is None else (throughput.seconds, throughput.rays_per_second)
    write_metrics_json(folder / "metrics.json", result, steps, seconds, rays_per_second)
    for region in result.regions:
        full = region == FULL
        table = views_table(result, title if full else f"{title}, {region}", region)
        write_table(table, folder / ("metrics" if full else f"metrics_{region}"))
    rich.print(to_rich(views_table(result, title)))
    if len(result.regions) > 1:
        rich.print(to_rich(regions_table(result, "means of the full images, of the object's mask, and of the crop")))


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

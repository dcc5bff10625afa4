"""What `python -m nerfro.evaluate` can be asked."""

# ruff: noqa: UP045 - OmegaConf on Python 3.10 wants Optional

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Optional

import torch
from omegaconf import DictConfig

from nerfro.allowed import Count, NotNegative, Positive
from nerfro.errors import NerfroError
from nerfro.files.atomic import refuse_existing
from nerfro.paths import user_path


@dataclass
class EvaluateConfig:
    """What `python -m nerfro.evaluate` is asked: to score a trained model, or pictures that any program rendered."""

    checkpoint: Optional[str] = None  # file written by nerfro.train, to render and score
    split: str = "test"  # of the data to render
    root: Optional[str] = None  # folder of the data, if it has moved since training
    chunk_size: Optional[Count] = None  # rays rendered at once, which bounds the memory; the trained one by default
    # Rays per pixel (see docs/experiments.md); as trained by default.
    supersample: Optional[Count] = None
    divergence: Optional[NotNegative] = None
    contrast: Optional[Positive] = None
    predictions: Optional[str] = None  # folder of pictures to score, instead of a checkpoint
    references: Optional[str] = None  # folder of pictures of the same names, compared with `predictions`
    # Folder of masks of the same names; by default those that lie with the references, or their transparency.
    masks: Optional[str] = None
    alpha: str = "drop"  # what becomes of transparency in both: `drop`, or composite over `white` or `black`
    # Folder for pictures and tables; by default beside the checkpoint's folder, or `scores` in `predictions`.
    out: Optional[str] = None
    protocol: str = "8bit"  # `8bit` rounds predictions to what a PNG holds before they are scored, `float` does not
    lpips_backbone: Optional[str] = None  # file of AlexNet weights, if torch's hub cache has none
    lpips_vgg_backbone: Optional[str] = None  # file of VGG-16 weights, if torch's hub cache has none
    device: str = "auto"  # `cpu`, `cuda`, or `auto` for a GPU if there is one
    overwrite: bool = False  # whether an earlier evaluation in `out` may be replaced


def require_one_task(config: DictConfig) -> None:
    """Refuse options that contradict each other, or that would be passed over."""
    if (config.checkpoint is None) == (config.predictions is None):
        raise NerfroError(
            "what is to be scored? give checkpoint=RUN/checkpoints/last.ckpt, or predictions=DIR and references=DIR"
        )
    if config.predictions is not None and config.references is None:
        raise NerfroError(f"predictions={config.predictions} are compared with what? give references=DIR")
    others: tuple[str, ...]
    if config.checkpoint is None:
        task, others = "predictions", ("split", "root", "chunk_size", "supersample", "divergence", "contrast")
    else:
        task, others = "checkpoint", ("references", "masks", "alpha")
    for name in others:
        if config[name] != getattr(EvaluateConfig, name):
            raise NerfroError(f"{name}={config[name]} means nothing with {task}=...; leave it out")
    for name, allowed in (("protocol", ("8bit", "float")), ("alpha", ("drop", "white", "black"))):
        if config[name] not in allowed:
            raise NerfroError(f"{name}={config[name]} is not allowed; choose one of {', '.join(allowed)}")


def free_folder(config: DictConfig, default: Path) -> Path:
    """Where the scores go; refused if an earlier evaluation lies there and may not be replaced."""
    folder = default if config.out is None else user_path(config.out)
    refuse_existing([folder / "metrics.json"], config.overwrite)
    return folder


def find_device(name: str) -> torch.device:
    """The device of a name, or with `auto` the GPU if there is one; refused if it cannot be used."""
    if name == "auto":
        name = "cuda" if torch.cuda.is_available() else "cpu"
    try:
        device = torch.device(name)
        torch.zeros(1, device=device)
    except (RuntimeError, AssertionError) as error:
        raise NerfroError(f"device={name} cannot be used; choose cpu, cuda or auto") from error
    return device

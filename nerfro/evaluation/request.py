"""What `python -m nerfro.evaluate` can be asked."""

# ruff: noqa: UP045 - OmegaConf on Python 3.10 wants Optional

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal, Optional

import torch
from omegaconf import DictConfig, OmegaConf

from nerfro.allowed import Natural, NotNegative, NumRays, Positive, Side
from nerfro.errors import Interrupted, NerfroError
from nerfro.files.atomic import refuse_existing, write_atomically
from nerfro.files.owned import held, remove_unfinished, require_own
from nerfro.paths import user_path

REQUEST_FILE = "evaluate.yaml"


@dataclass
class EvaluateConfig:
    """What `python -m nerfro.evaluate` is asked: to score a trained model, or pictures that any program rendered."""

    checkpoint: Optional[str] = None  # file written by nerfro.train, to render and score
    split: str = "test"  # of the data to render
    root: Optional[str] = None  # folder of the data, if it has moved since training
    chunk_size: Optional[NumRays] = None  # rays rendered at once, which bounds the memory; the trained one by default
    # Rays per pixel (see docs/experiments.md); as trained by default.
    supersample: Optional[Side] = None
    divergence: Optional[NotNegative] = None
    contrast: Optional[Positive] = None
    # Steps in which the views' cameras are refined on left halves, to be scored on right ones; as trained by default.
    refine_steps: Optional[Natural] = None
    predictions: Optional[str] = None  # folder of pictures to score, instead of a checkpoint
    references: Optional[str] = None  # folder of pictures of the same names, compared with `predictions`
    # Folder of masks of the same names; by default those that lie with the references, or their transparency.
    masks: Optional[str] = None
    # What becomes of transparency in both: `drop`, or composite over `white` or `black`.
    alpha: Annotated[str, Literal["drop", "white", "black"]] = "drop"
    # Folder for pictures and tables; by default beside the checkpoint's folder, or `scores` in `predictions`.
    out: Optional[str] = None
    # `8bit` rounds predictions to what a PNG holds before they are scored, `float` does not.
    protocol: Annotated[str, Literal["8bit", "float"]] = "8bit"
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


@contextmanager
def own_folder(config: DictConfig, default: Path) -> Iterator[Path]:
    """Hold the folder that the scores go to; refused if it holds anything else than an evaluation to be replaced."""
    folder = default if config.out is None else user_path(config.out)
    if not (folder / REQUEST_FILE).is_file():
        require_own(folder, (), "it is no evaluation's folder; give another out=...")
    refuse_existing([folder / "metrics.json"], config.overwrite)
    with held(folder, "out"):
        remove_unfinished(folder)
        try:
            yield folder
        except KeyboardInterrupt:
            raise Interrupted("the same command begins it again") from None


def record(folder: Path, config: DictConfig) -> None:
    """Write what is evaluated, before anything else of it: from then on the folder is an evaluation's."""
    write_atomically(folder / REQUEST_FILE, OmegaConf.to_yaml(config, resolve=True))


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

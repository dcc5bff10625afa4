"""Configuration and output folder of `python -m nerfro.evaluate`."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import torch
from omegaconf import OmegaConf

from nerfro.core.errors import Interrupted, NerfroError, warn
from nerfro.core.paths import user_path
from nerfro.files.atomic import lock_folder, refuse_existing, require_only, write_atomically
from nerfro.kernels.available import find_gpu
from nerfro.registry.allowed import Natural, NumRays, refuse_unused
from nerfro.samplers.subdivision import SubdivisionChanges

REQUEST_FILE = "evaluate.yaml"


@dataclass
class EvaluateConfig:
    """Options of `python -m nerfro.evaluate`, which scores a trained model or images of any program.

    Attributes:
        checkpoint: run folder or checkpoint of nerfro.train to render and score.
        split: split to render.
        root: folder of the data set of the run, if it has moved since training.
        chunk_size: rays rendered at once, which limits memory; by default as in training.
        subdivision: which pixels get several rays (see docs/concepts/background.md); by default as in training.
        predictions: folder of images to score, instead of a checkpoint.
        references: folder of reference images with the same names as `predictions`.
        masks: folder of masks with the same names; by default the masks beside the references, or their
            transparency.
        mask_labels: labels of the object in the masks; by default all but the background.
        alpha: treatment of transparency in both folders: `drop` ignores it, `white` and `black` composite over
            this colour.
        out: folder for images and tables; by default beside the folder of checkpoints, or `scores` in
            `predictions`.
        device: `cpu` or `cuda`; `auto` means the CPU.
        overwrite: whether to replace an earlier evaluation in `out`.
    """

    checkpoint: str | None = None
    split: str = "test"
    root: str | None = None
    chunk_size: NumRays | None = None
    subdivision: SubdivisionChanges = dataclasses.field(default_factory=SubdivisionChanges)
    predictions: str | None = None
    references: str | None = None
    masks: str | None = None
    mask_labels: list[Natural] | None = None
    alpha: Literal["drop", "white", "black"] = "drop"
    out: str | None = None
    device: str = "auto"
    overwrite: bool = False


def require_one_task(options: EvaluateConfig) -> None:
    """Refuse options without effect, and options with contradictory values."""
    if (options.checkpoint is None) == (options.predictions is None):
        raise NerfroError("give either checkpoint=RUN, or predictions=DIR and references=DIR, to score")
    if options.predictions is not None and options.references is None:
        raise NerfroError(f"predictions={options.predictions} need references; give references=DIR")
    others: tuple[str, ...]
    if options.checkpoint is None:
        task, others = "predictions", ("split", "chunk_size", "subdivision")
    else:
        task, others = "checkpoint", ("references", "masks", "mask_labels", "alpha")
    refuse_unused(options, others, f"with {task}=...")


@contextmanager
def own_folder(options: EvaluateConfig, default: Path) -> Iterator[Path]:
    """Lock the output folder; raises an error unless the folder is empty or holds a replaceable evaluation."""
    folder = default if options.out is None else user_path(options.out)
    with lock_folder(folder, "out"):
        if not (folder / REQUEST_FILE).is_file():
            require_only(folder, (), "it is not the folder of an evaluation; give another out=...")
        refuse_existing([folder / "metrics.json"], options.overwrite)
        try:
            yield folder
        except KeyboardInterrupt:
            raise Interrupted("run the same command to start again") from None


def record(folder: Path, options: EvaluateConfig) -> None:
    """Write the options, which marks the folder as that of an evaluation, before any other file."""
    write_atomically(folder / REQUEST_FILE, OmegaConf.to_yaml(OmegaConf.create(dataclasses.asdict(options))))


def find_device(name: str) -> torch.device:
    """Return the device of a name; `auto` means the CPU, as in training.

    Raises:
        NerfroError: the device cannot be used.
    """
    if name == "auto":
        name = "cpu"
        if find_gpu() is not None:
            warn(
                "the CPU is used, because nerfro has no GPU kernels and its speed on a GPU is unknown; "
                "set device=cuda to use the GPU nevertheless"
            )
    try:
        device = torch.device(name)
        torch.zeros(1, device=device)
    except (RuntimeError, AssertionError) as error:
        raise NerfroError(f"device={name} cannot be used; choose cpu, cuda or auto") from error
    return device

"""Folder of a run: lock, records for repeating the run, checkpoints, and the trained scene."""

from __future__ import annotations

import pickle
import platform
import shlex
import subprocess
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf
from torch import Tensor, nn

from nerfro.cli.overrides import as_overrides, command_line
from nerfro.core.errors import Interrupted, NerfroError, first_of, warn
from nerfro.core.paths import PACKAGE_DIR, user_path
from nerfro.core.provenance import AlgorithmSettings, command_of_process, versions
from nerfro.data.base import Views
from nerfro.evaluation.request import find_device
from nerfro.files.atomic import lock_folder, require_only, require_room, write_atomically, write_json
from nerfro.files.reading import foreign_config, read_foreign_config, reading
from nerfro.kernels.available import fast_bfloat16, gpu_name
from nerfro.optimizers.config import MOMENTS, OPTIMIZERS
from nerfro.registry.registration import discover
from nerfro.rendering import Renderer
from nerfro.samplers.subdivision import Subdivision
from nerfro.training.config import build_data, build_model, check_trained, training_device
from nerfro.training.content import describe
from nerfro.training.derivation import describe_backdrop
from nerfro.training.inputs import (
    changed_file,
    compared_by_content,
    copy_files,
    recorded_cameras,
    relocated,
    require_files,
    require_same_inputs,
)
from nerfro.training.settings import RESUMING, first_difference, settings
from nerfro.viewing.trained_scene import TrainedScene

LAST_CHECKPOINT = Path("checkpoints", "last.ckpt")
CONFIG_FILE, CELL_FILE = "config.yaml", "cell.json"  # configuration of the run; its state in a sweep
# Required entries of a checkpoint and their types.
_REQUIRED_KEYS = {
    "nerfro_config": str,
    "state_dict": dict,
    "optimizer_states": list,
    "lr_schedulers": list,
    "callbacks": dict,
    "global_step": int,
    "loops": dict,
}


@contextmanager
def lock_run(folder: Path, config: DictConfig) -> Iterator[Path | None]:
    """Lock the folder of a run, and yield the checkpoint from which the run resumes, or None.

    Raises:
        NerfroError: another process writes to the folder, or the folder holds files of something else.
    """
    from lightning.pytorch.utilities import rank_zero_only  # loading a run must not import Lightning

    checkpoint = find_checkpoint(config.ckpt_path, folder)
    if rank_zero_only.rank != 0:  # type: ignore[attr-defined]  # the first process checks the folder
        yield checkpoint
        return
    with lock_folder(folder, "hydra.run.dir"):
        begun = folder if checkpoint is None else checkpoint.parent.parent
        if config.ckpt_path is None or begun.resolve() != folder.resolve():
            advice = "resume a run (ckpt_path=last) or choose another folder (hydra.run.dir=...)"
            require_only(folder, (CELL_FILE,), advice)
        try:
            yield checkpoint
        except KeyboardInterrupt:  # before training, or after it
            if (folder / CONFIG_FILE).is_file():
                raise Interrupted(resume_advice(folder)) from None
            raise


def resume_advice(folder: Path) -> str:
    """Return how to resume a run."""
    options = shlex.join(as_overrides({"hydra.run.dir": folder, "ckpt_path": "last"}))
    return "to resume, repeat the command" + ("" if in_sweep() else f" with {options}")


def in_sweep() -> bool:
    """Check whether the current run is a cell of a sweep."""
    return HydraConfig.initialized() and HydraConfig.get().mode == RunMode.MULTIRUN


def begin(folder: Path, config: DictConfig, renderer: Renderer, has_steps: bool) -> None:
    """Check the disk space, write the records of a run, and print a summary.

    If the run has further training steps (`has_steps`), the scores of its last checkpoint are removed.
    """
    require_room(folder, needed_bytes(renderer), "hydra.run.dir")
    scored = ("metrics.*", "index.html", "evaluate_*/metrics.*")
    for scores in (file for pattern in scored for file in folder.glob(pattern)) if has_steps else ():
        scores.unlink()
    record(folder, config)
    copy_files(folder, config)
    from_data = f"{describe(config)}{describe_backdrop(config)}"
    print(f"nerfro: {config.name} on {config.data.root} -> {folder}\n{from_data}", end="", flush=True)


def next_steps(folder: Path, split: str | None) -> str:
    """Return the lines about results at the end of a run: an image, the page and the tables of scores."""
    checkpoint = as_overrides({"checkpoint": folder})
    lines = [f"page: {command_line('view', checkpoint)}"]
    if split is None:
        lines.append(f"scores: {command_line('evaluate', checkpoint)}")
    else:
        lines.insert(0, f"image: {folder / 'images' / f'{split}_000.png'}")
        lines.append(f"tables: {folder}/metrics.md, .csv and .tex for each view, metrics.json, and index.html for all")
    if in_sweep():
        lines.append(f"table of the sweep: {command_line('summary', as_overrides({'runs': folder.parent}))}")
    return "\n".join(lines)


def needed_bytes(renderer: Renderer) -> int:
    """Estimate the size of a run: weights and two moments of Adam, in an old and a new checkpoint."""
    weights = sum(parameter.numel() * parameter.element_size() for parameter in renderer.parameters())
    return 2 * 3 * weights + 64 * 2**20  # the last are images and logs


def record(folder: Path, config: DictConfig) -> None:
    """Write the records of a run: config.yaml (resolved), run.json (command, versions, algorithms), git.diff."""
    write_atomically(folder / CONFIG_FILE, OmegaConf.to_yaml(config, resolve=True))
    commit, diff, device = _git("rev-parse", "HEAD"), _git("diff", "HEAD"), training_device(config)
    facts = {
        "command": _command(),
        "seed": config.seed,
        "commit": commit,
        "modified": bool(diff),
        "python": platform.python_version(),
        "machine": platform.machine(),
        "threads": torch.get_num_threads(),
        "gpu": None if device == "cpu" else gpu_name(torch.device(device)),
        "fast_bfloat16": fast_bfloat16(device),
        "versions": versions(),
        "algorithms": list(AlgorithmSettings.used.values()),
    }
    write_json(folder / "run.json", facts, indent=2)
    if diff:
        write_atomically(folder / "git.diff", diff + "\n")


def find_checkpoint(ckpt_path: str | None, folder: Path) -> Path | None:
    """Find the checkpoint to resume from: a file, or for `last` the checkpoint of this folder or the newest beside it.

    Returns:
        The checkpoint; None without `ckpt_path`, or for a run in this folder that ended before its first checkpoint.
    """
    if ckpt_path is None:
        return None
    if ckpt_path != "last":
        path = user_path(ckpt_path)
        if not path.is_file():
            raise NerfroError(f"checkpoint {path} does not exist; give a .ckpt file or ckpt_path=last")
        return path
    if (folder / LAST_CHECKPOINT).is_file():
        return folder / LAST_CHECKPOINT
    if (folder / CONFIG_FILE).is_file():
        return None
    siblings = sorted(folder.parent.glob(f"*/{LAST_CHECKPOINT}"), key=lambda p: p.stat().st_mtime)
    if not siblings:
        raise NerfroError(
            f"ckpt_path=last: no checkpoint in {folder} or beside it; leave ckpt_path out to start from the beginning"
        )
    return siblings[-1]


def load_checkpoint(path: Path) -> tuple[dict[str, Any], DictConfig]:
    """Read a checkpoint without executing pickled code, and its configuration."""
    trouble, missing = "is not a readable nerfro checkpoint", f"it is usually RUN/{LAST_CHECKPOINT}"
    with reading(path, "checkpoint ", trouble, "train the run again", missing):
        try:
            checkpoint = torch.load(path, map_location="cpu", weights_only=True)
        except pickle.UnpicklingError as error:  # the message of torch recommends unsafe loading
            raise NerfroError(f"checkpoint {path} {trouble} (it holds more than numbers)") from error
        absent = _REQUIRED_KEYS.keys() - checkpoint.keys()
        if absent:
            raise NerfroError(f"{path} lacks {first_of(sorted(absent))}, so it is no checkpoint of nerfro.train")
        for name, kind in _REQUIRED_KEYS.items():
            if not isinstance(checkpoint[name], kind):
                raise NerfroError(f"{path} holds a {type(checkpoint[name]).__name__} as {name}; it is damaged")
        require_finite(checkpoint["state_dict"], path)
        return checkpoint, check_trained(foreign_config(checkpoint["nerfro_config"], path), path)


def load_run(checkpoint: Path, root: str | Path | None = None) -> tuple[dict[str, Any], DictConfig]:
    """Read a checkpoint of a run, and its configuration with the present places of its files.

    Args:
        checkpoint: file of the checkpoint, RUN/checkpoints/NAME.
        root: folder of the data, if it has moved since training.
    """
    content, config = load_checkpoint(checkpoint)
    return content, relocated(config, checkpoint.parent.parent, root)


def run_config(folder: Path, root: str | Path | None = None) -> DictConfig:
    """Read the configuration of a run folder, with the present places of its files; see `load_run`."""
    file = folder / CONFIG_FILE
    return relocated(check_trained(read_foreign_config(file), file), folder, root)


def require_finite(weights: Mapping[str, Any], path: Path) -> None:
    """Refuse weights that are not tensors, or not finite."""
    for name, weight in weights.items():
        if not isinstance(weight, Tensor):
            raise NerfroError(f"{path} holds a {type(weight).__name__} as {name}; it is damaged")
    if (infinite := first_not_finite(weights)) is not None:
        raise NerfroError(f"{path} holds infinite numbers or NaN in {infinite}; train the run again, with another seed")


def first_not_finite(weights: Mapping[str, Tensor]) -> str | None:
    """Return the name of the first tensor with infinite numbers or NaN, if there is one."""
    return next((name for name, weight in weights.items() if not weight.isfinite().all()), None)


def require_optimizer_fits(checkpoint: Mapping[str, Any], optimizer: torch.optim.Optimizer, path: Path) -> None:
    """Refuse the state of another optimizer, or with moments of wrong shape or infinite values."""
    kinds = [(parameter, group["kind"]) for group in optimizer.param_groups for parameter in group["params"]]

    def state_fits(state: Mapping[str, Any], parameter: nn.Parameter, kind: str) -> bool:
        name = kind.partition(" ")[0]
        tensors = [state[moment] for moment in MOMENTS.get(name, ())]
        tensors += [value for value in state.values() if isinstance(value, Tensor)]
        is_own = not OPTIMIZERS[name].__module__.startswith("torch.")  # states of plugins have any shape
        return all(
            (is_own or tensor.numel() == 1 or tensor.shape == parameter.shape) and bool(tensor.isfinite().all())
            for tensor in tensors
        )

    try:
        (saved,) = checkpoint["optimizer_states"]
        fits = all(state_fits(state, *kinds[number]) for number, state in saved["state"].items()) and all(
            # The rates, and the numbers that a scheduler changes, may differ.
            group[name] == value or (type(group[name]) is type(value) and not isinstance(value, str))
            for group, own in zip(saved["param_groups"], optimizer.param_groups, strict=True)
            for name, value in own.items()
            if name != "params"
        )
    except (AttributeError, IndexError, KeyError, TypeError, ValueError):
        fits = False
    if not fits:
        raise NerfroError(f"{path} has an optimizer state that does not fit its weights; start without ckpt_path")


def restore(checkpoint: dict, config: DictConfig) -> Renderer:
    """Build the trained model of a checkpoint."""
    prefix = "renderer."
    weights = {n.removeprefix(prefix): w for n, w in checkpoint["state_dict"].items() if n.startswith(prefix)}
    require_files(checkpoint, config)
    renderer = build_model(config)
    changed = changed_file(checkpoint, config)
    if changed is not None:
        warn(f"the content of the file {changed} has changed since the training, so rays now meet another surface")
    try:
        renderer.load_state_dict(weights)
    except RuntimeError as error:
        reason = str(error).strip().split("\n")[-1].strip()
        raise NerfroError(
            f"the checkpoint's weights do not fit its configuration: {reason}; was nerfro updated?"
        ) from error
    return renderer.eval()


def require_same_run(
    folder: Path,
    checkpoint: Path | None,
    config: DictConfig,
    optimizer: torch.optim.Optimizer,
    views: Views,
) -> int:
    """Refuse to resume from an unsuitable checkpoint, or in the folder of another run.

    Args:
        folder: folder of the run.
        checkpoint: checkpoint to resume from, if there is one.
        config: configuration of the run.
        optimizer: optimizer of the run.
        views: training views.

    Returns:
        Number of steps of the checkpoint; 0 for a run that starts from the beginning.
    """
    begun = folder / CONFIG_FILE
    if checkpoint is not None:
        content, trained = load_checkpoint(checkpoint)
        require_same_configuration(checkpoint, trained, config, compared_by_content(content))
        require_same_inputs(content, checkpoint, config, views)
        require_optimizer_fits(content, optimizer, checkpoint)
        done, most = content["global_step"], config.trainer.max_steps
        if 0 <= most < done:
            raise NerfroError(f"{checkpoint} has {done} steps, and trainer.max_steps={most}; give at least {done}")
        return done
    if config.ckpt_path is not None:
        require_same_configuration(begun, read_foreign_config(begun), config)
    return 0


def require_same_configuration(
    path: Path, trained: DictConfig, wanted: DictConfig, others: Collection[str] = ()
) -> None:
    """Raise an error if two configurations differ in settings with influence on the result, except for `others`."""
    old, new = (
        {name: value for name, value in settings(config, RESUMING).items() if name not in others}
        for config in (trained, wanted)
    )
    key = first_difference(old, new)
    if key is not None:
        raise NerfroError(
            f"{path} was trained with {key}={old.get(key)}, this run has {new.get(key)}; "
            "use the same experiment and overrides, or start without ckpt_path"
        )


def _git(*command: str) -> str | None:
    """Return the output of a git command in the checkout of nerfro; None outside of a checkout."""
    if not (PACKAGE_DIR.parent / ".git").exists():
        return None
    try:
        done = subprocess.run(
            ["git", "-C", str(PACKAGE_DIR.parent), *command], capture_output=True, text=True, timeout=10, check=True
        )
    except (OSError, subprocess.SubprocessError):
        return None
    return done.stdout.strip()


def _command() -> str:
    """Return the command line for repeating this run; for a cell of a sweep, without the other cells."""
    if in_sweep():
        # In a launcher's worker this process has another main module and other arguments.
        return shlex.join(["python", "-m", "nerfro.train", *HydraConfig.get().overrides.task])
    return command_of_process()


def load(run: str | Path, device: str = "auto", root: str | Path | None = None) -> TrainedScene:
    """Load the trained scene of a run.

    The run folder contains the surface of the object and the training cameras, so the scene can be rendered along a
    path and exported without the data.

    Args:
        run: folder of the run, or one of its checkpoints.
        device: `cpu` or `cuda`; `auto` means the CPU.
        root: folder of the data, if it has moved since training.

    Raises:
        NerfroError: the checkpoint cannot be read, or files of the run are missing.
    """
    discover()
    checkpoint, config = load_run(checkpoint_of(run), root)
    return scene_of(checkpoint, config, find_device(device))


def checkpoint_of(run: str | Path) -> Path:
    """Return the checkpoint of a run: the file itself, or the last checkpoint of a run folder."""
    path = user_path(run)
    return path / LAST_CHECKPOINT if path.is_dir() else path


def scene_of(checkpoint: dict[str, Any], config: DictConfig, device: torch.device) -> TrainedScene:
    """Build the scene of a checkpoint from a configuration, whose data and evaluation may differ from training."""
    renderer, cameras = restore(checkpoint, config).to(device), recorded_cameras(checkpoint)
    subdivision = Subdivision(**config.evaluation.subdivision)
    name = config.name
    if "current_model_state" in checkpoint:  # the latest weights, besides the average
        name = f"{name}, average of weights"
        print("weights: moving average over the steps of the run (weight_averaging)", flush=True)
    return TrainedScene(renderer, build_data(config), subdivision, name, cameras)

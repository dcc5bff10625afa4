"""Cells of a sweep. A cell is one training run, and is trained at most once.

Hydra's sweeper chooses the settings of the cells, and its launcher runs them. The folder of a cell contains its state,
so that repeating the command of a sweep continues the sweep.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf

from nerfro.cli.failures import in_one_line
from nerfro.core.errors import NerfroError
from nerfro.core.paths import resolve_path, scene_name
from nerfro.data.image_files import VIEW_SUFFIXES
from nerfro.evaluation.results import RunMetrics, read_metrics_json
from nerfro.files.atomic import lock_folder, write_json
from nerfro.files.reading import read_json
from nerfro.training.inputs import file_hashes
from nerfro.training.run_folder import CELL_FILE, CONFIG_FILE, in_sweep
from nerfro.training.settings import RESULT, first_difference, settings, with_values

# For `hydra.sweep.subdir` in conf/train.yaml.
OmegaConf.register_new_resolver("scene_name", scene_name, replace=True)


def identity_of(config: DictConfig, sweep: Path | None = None) -> dict[str, Any]:
    """Return the settings that determine the result of a run, and hashes of the files of data set and medium.

    Args:
        config: configuration of the run.
        sweep: folder of the sweep, which is no part of the data set around it.
    """
    data = _hash_of_files(resolve_path(config.data.root), sweep)
    return {"settings": settings(config, RESULT), "data": data, "files": file_hashes(config)}


def run_cell(config: DictConfig, folder: Path, train: Callable[[DictConfig], RunMetrics | None]) -> RunMetrics | None:
    """Return the metrics of a run. In a sweep, a finished run in the folder is not trained again.

    A cell of a sweep that was interrupted resumes from its checkpoint.

    Args:
        config: configuration of the run.
        folder: folder of the run.
        train: trains and scores the run of a configuration, in which `ckpt_path` is set if the cell resumes.

    Raises:
        NerfroError: the folder holds a run with other settings or data, or another process trains the cell.
    """
    if not in_sweep():
        return train(config)
    identity = identity_of(config, Path(HydraConfig.get().sweep.dir))
    with lock_folder(folder, "hydra.sweep.dir"):
        if (folder / CONFIG_FILE).is_file():
            _require_same_cell(folder, identity)
            if (folder / "metrics.json").is_file():
                print(f"nerfro: {folder.name} is finished", flush=True)
                return read_metrics_json(folder / "metrics.json")
            config = with_values(config, {"ckpt_path": "last"})
        _record(folder, identity)
        try:
            return train(config)
        except Exception as error:
            _record(folder, {**identity, "reason": in_one_line(error)})
            raise


def _record(folder: Path, record: Mapping[str, Any]) -> None:
    write_json(folder / CELL_FILE, record, indent=2)


def _require_same_cell(folder: Path, identity: Mapping[str, Any]) -> None:
    """Refuse a folder that holds a run with other results."""
    advice = "choose another hydra.sweep.dir or remove the folder"
    if not (folder / CELL_FILE).exists():
        raise NerfroError(f"{folder} holds a run that is no cell of a sweep; {advice}")
    try:
        record = read_json(folder / CELL_FILE, advice)
        by_content = {"data.root", *(name.partition("[")[0] for name in record["files"])}
        old, new = (
            {name: value for name, value in values.items() if name not in by_content}
            for values in (settings(record["settings"], RESULT), identity["settings"])
        )
        same_data = record["data"] == identity["data"]
        changed = first_difference(record["files"], identity["files"])
    except (NerfroError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise NerfroError(f"{folder / CELL_FILE} is damaged; {advice}") from error
    key = first_difference(old, new)
    if key is not None:
        raise NerfroError(f"{folder} holds a run with {key}={old.get(key)}, not {new.get(key)}; {advice}")
    if changed is not None:
        raise NerfroError(f"{folder} holds a run with another content of the file {changed}; {advice}")
    if not same_data:
        raise NerfroError(f"{folder} holds a run with other files in its data folder; {advice}")


def _hash_of_files(root: Path, sweep: Path | None) -> str:
    """Hash the names and sizes of all files below a folder, and the content of files other than images."""
    digest = hashlib.sha256()
    for file in sorted(_visible_files(root, sweep)):
        num_bytes = file.stat().st_size
        digest.update(f"{file.relative_to(root).as_posix()}:{num_bytes};".encode())
        # Larger data files are identified by name and size, because reading them would take minutes.
        if file.suffix.lower() not in VIEW_SUFFIXES and num_bytes <= 64 * 2**20:
            digest.update(file.read_bytes())
    return digest.hexdigest()[:16]


def _visible_files(root: Path, sweep: Path | None) -> Iterator[Path]:
    inner = None if sweep is None else os.path.relpath(sweep.resolve(), root.resolve())
    omitted = root if inner in (None, ".") else root / inner
    files = (path for path in root.rglob("*") if path.is_file() and not path.name.startswith("."))
    return (path for path in files if omitted == root or not path.is_relative_to(omitted))

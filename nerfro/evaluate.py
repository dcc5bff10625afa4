"""`python -m nerfro.evaluate checkpoint=RUN` or `predictions=DIR references=DIR`: score a model, or any images.

Examples:
    nerfro evaluate checkpoint=outputs/first split=val
    nerfro evaluate predictions=outputs/first/images references=data/test out=scores
"""

from __future__ import annotations

import functools
from pathlib import Path

from omegaconf import DictConfig

import nerfro.cli.startup  # noqa: F401 - before the other imports, which take seconds
from nerfro.cli.entry import entry_point
from nerfro.core.errors import NerfroError
from nerfro.core.paths import user_path
from nerfro.evaluation.error_sheets import write_error_sheet
from nerfro.evaluation.folders import match_folders
from nerfro.evaluation.metrics import ImageMetrics
from nerfro.evaluation.request import EvaluateConfig, find_device, own_folder, record, require_one_task
from nerfro.evaluation.results import RunMetrics
from nerfro.evaluation.scoring import score_folders
from nerfro.evaluation.tables import write_scores
from nerfro.evaluation.treatments import score_split
from nerfro.files.foreign_config import read_foreign_config
from nerfro.files.images import load_png
from nerfro.training.callbacks import Throughput, steps_by_phase
from nerfro.training.config import build_data, check_trained
from nerfro.training.load import checkpoint_of, scene_of
from nerfro.training.run_folder import CONFIG_FILE, load_checkpoint


@entry_point("evaluate", EvaluateConfig)
def main(config: DictConfig) -> None:
    """Score the test views of a checkpoint, or a folder of images."""
    require_one_task(config)
    evaluate = _evaluate_folder if config.checkpoint is None else _evaluate_checkpoint
    evaluate(config)


def _evaluate_checkpoint(config: DictConfig) -> None:
    path = checkpoint_of(config.checkpoint)
    checkpoint, trained = load_checkpoint(path)
    if config.root is not None:
        trained.data.root = config.root
    if config.chunk_size is not None:
        trained.evaluation.chunk_size = config.chunk_size
    trained.evaluation.subdivision.update({k: v for k, v in config.subdivision.items() if v is not None})
    device = find_device(config.device)
    with own_folder(config, path.parent.parent / f"evaluate_{config.split}") as folder:
        scene = scene_of(checkpoint, trained, device)
        views = scene.views(config.split).checked()
        metrics = ImageMetrics()
        record(folder, config)
        result, treated = score_split(scene.renderer, views, metrics, folder, scene.subdivision, config.split)
        for index, view in enumerate(result.views):
            prediction = load_png(folder / "images" / f"{view.name}.png")
            write_error_sheet(folder, view.name, prediction, views.images[index], metrics.metrics)
        spent = Throughput()
        if "Throughput" in checkpoint["callbacks"]:  # absent if another Trainer has trained the module
            spent.load_state_dict(checkpoint["callbacks"]["Throughput"])
        title = f"{trained.name} on {trained.data.root}, {config.split} views"
        spending = checkpoint["global_step"], spent.seconds, spent.rays_per_second
        phases = steps_by_phase(checkpoint["callbacks"], checkpoint["global_step"])
        write_scores(RunMetrics(result, *spending, treated, phases), title, folder)
    print(f"images and tables: {folder}")


def _evaluate_folder(config: DictConfig) -> None:
    predictions, references = user_path(config.predictions), user_path(config.references)
    masks = None if config.masks is None else user_path(config.masks)
    run_config = predictions.parent / CONFIG_FILE
    if config.root is not None and not run_config.is_file():
        raise NerfroError(f"root={config.root} has no effect, because {run_config} does not exist; remove it")
    read_names = functools.partial(_names_in_run, run_config, config.root)
    pairs = match_folders(predictions, references, masks, config.mask_labels, read_names)
    for pair in pairs:  # damaged or mismatched images are reported before the scoring starts
        pair.load(config.alpha)
    device = find_device(config.device)
    with own_folder(config, predictions / "scores") as folder:
        metrics = ImageMetrics()
        record(folder, config)
        result = score_folders(pairs, config.alpha, metrics, folder, device)
        write_scores(RunMetrics(result), f"{predictions} against {references}", folder)
    print(f"images and tables: {folder}")


def _names_in_run(file: Path, root: str | None) -> dict[str, str]:
    """Return the names of the images of a run by their names in the data set; empty for images of other programs."""
    if not file.is_file():
        return {}
    config = check_trained(read_foreign_config(file), file)
    if root is not None:
        config.data.root = root
    split = config.evaluation.split
    names = build_data(config).load(split).names
    return {Path(name).stem: f"{split}_{number:03d}" for number, name in enumerate(names)}


if __name__ == "__main__":
    main()

"""Scores of trained models and of images of other programs: `nerfro.evaluate`."""

from __future__ import annotations

import functools
from pathlib import Path
from typing import cast

from nerfro.cli.calls import changed_settings, options_of
from nerfro.core.errors import NerfroError
from nerfro.core.paths import user_path
from nerfro.data.image_files import Alpha
from nerfro.evaluation.folders import match_folders
from nerfro.evaluation.request import EvaluateConfig, find_device, own_folder, record, require_one_task
from nerfro.evaluation.results import RunMetrics
from nerfro.evaluation.scoring import ImageMetrics, score_folders, score_split, write_error_sheet
from nerfro.evaluation.tables import write_scores
from nerfro.files.images import load_png
from nerfro.training.callbacks import Throughput, steps_by_phase
from nerfro.training.config import build_data
from nerfro.training.run import Run
from nerfro.training.run_folder import CONFIG_FILE, checkpoint_of, load_run, run_config, scene_of


def evaluate(
    checkpoint: Run | str | Path | None = None, options: EvaluateConfig | None = None, **settings: object
) -> RunMetrics:
    """Score the test views of a run, or a folder of images, and write images and tables.

    Args:
        checkpoint: run, run folder or checkpoint; None to score `predictions` against `references`.
        options: the options of `python -m nerfro.evaluate`.
        **settings: options by name, as in `evaluate(run, split="val")`.

    Raises:
        NerfroError: the checkpoint or the images cannot be read, or files exist.
    """
    options = options_of(EvaluateConfig, options, settings, checkpoint=checkpoint)
    require_one_task(options)
    if options.checkpoint is not None:
        return _evaluate_checkpoint(options, checkpoint_of(options.checkpoint))
    return _evaluate_folder(options, user_path(str(options.predictions)), user_path(str(options.references)))


def _evaluate_checkpoint(options: EvaluateConfig, path: Path) -> RunMetrics:
    checkpoint, trained = load_run(path, options.root)
    if options.chunk_size is not None:
        trained.evaluation.chunk_size = options.chunk_size
    trained.evaluation.subdivision.update(changed_settings(options.subdivision))
    device = find_device(options.device)
    run = path.parent.parent if (path.parent.parent / CONFIG_FILE).is_file() else path.parent
    with own_folder(options, run / f"evaluate_{options.split}") as folder:
        scene = scene_of(checkpoint, trained, device)
        views = scene.views(options.split).checked()
        metrics = ImageMetrics()
        record(folder, options)
        result, treated = score_split(scene.renderer, views, metrics, folder, scene.subdivision, options.split)
        for index, view in enumerate(result.views):
            prediction = load_png(folder / "images" / f"{view.name}.png")
            write_error_sheet(folder, view.name, prediction, views.images[index], metrics.metrics)
        spent = Throughput()
        if "Throughput" in checkpoint["callbacks"]:  # absent if another Trainer has trained the module
            spent.load_state_dict(checkpoint["callbacks"]["Throughput"])
        title = f"{trained.name} on {trained.data.root}, {options.split} views"
        spending = checkpoint["global_step"], spent.seconds, spent.rays_per_second
        phases = steps_by_phase(checkpoint["callbacks"], checkpoint["global_step"])
        scores = RunMetrics(result, *spending, treated, phases)
        write_scores(scores, title, folder)
    print(f"images and tables: {folder}")
    return scores


def _evaluate_folder(options: EvaluateConfig, predictions: Path, references: Path) -> RunMetrics:
    alpha = cast(Alpha, options.alpha)
    masks = None if options.masks is None else user_path(options.masks)
    run_config = predictions.parent / CONFIG_FILE
    if options.root is not None and not run_config.is_file():
        raise NerfroError(f"root={options.root} has no effect, because {run_config} does not exist; remove it")
    read_names = functools.partial(_names_in_run, run_config, options.root)
    pairs = match_folders(predictions, references, masks, options.mask_labels, read_names)
    for pair in pairs:  # damaged or mismatched images are reported before the scoring starts
        pair.load(alpha)
    device = find_device(options.device)
    with own_folder(options, predictions / "scores") as folder:
        metrics = ImageMetrics()
        record(folder, options)
        result, treated = score_folders(pairs, alpha, metrics, folder, device)
        scores = RunMetrics(result, treatments=treated)
        write_scores(scores, f"{predictions} against {references}", folder)
    print(f"images and tables: {folder}")
    return scores


def _names_in_run(file: Path, root: str | None) -> dict[str, str]:
    """Return the names of the images of a run by their names in the data set; empty for images of other programs."""
    if not file.is_file():
        return {}
    config = run_config(file.parent, root)
    split = config.evaluation.split
    names = build_data(config).load(split).names
    return {Path(name).stem: f"{split}_{number:03d}" for number, name in enumerate(names)}

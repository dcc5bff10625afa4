"""The chain from photographs to a trained scene, a report and a page: `nerfro.reconstruct`.

Stages exchange values. Each leaves files, from which a repeated reconstruction reads the values of completed stages.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from omegaconf import DictConfig, OmegaConf

from nerfro.capture.preprocess import preprocess
from nerfro.capture.preprocess_options import MESH
from nerfro.cli.calls import Composition, changed_settings, composed, options_of, values_of
from nerfro.cli.overrides import as_overrides, is_given, not_given, of_groups
from nerfro.core.errors import NerfroError, warn
from nerfro.core.paths import resolve_path, user_path
from nerfro.data.capture import Capture
from nerfro.data.lazy_images import decoded_once
from nerfro.evaluation.results import read_metrics_json
from nerfro.files.atomic import lock_folder, write_atomically
from nerfro.files.images import save_image
from nerfro.masks.mask_files import read_outlines
from nerfro.masks.segment import segment
from nerfro.pipeline.export import export
from nerfro.pipeline.hypotheses import Hypothesis, hypotheses, worth_a_trial
from nerfro.pipeline.options import ReconstructConfig, common_options, have_poses, stage_options
from nerfro.pipeline.stage import Stage, is_older, move_aside
from nerfro.pipeline.trials import PICTURE, Trial, decide, draw_trials, validation_views
from nerfro.poses.calibrate import calibrate
from nerfro.poses.calibrated_data import PLOT, REPORT
from nerfro.poses.collection import collect_photographs
from nerfro.poses.options import CalibrateConfig
from nerfro.rendering.scene_file import SCENE, SceneFile, read_scene_file, with_scene
from nerfro.report.summary import SummaryConfig, summarize
from nerfro.silhouettes.agreement import SHEET
from nerfro.training.build import composed_training
from nerfro.training.run import Run, run_training
from nerfro.training.run_folder import CONFIG_FILE
from nerfro.viewing.exports import ExportConfig

_MIN_PHOTOGRAPHS = 3


def reconstruct(overrides: Sequence[str] = (), **settings: object) -> Run:
    """Reconstruct a scene from photographs: all stages that are not done.

    Args:
        overrides: settings as on the command line of `python -m nerfro.reconstruct`, such as `["medium.ior=1.33"]`.
        **settings: options by name, as in `reconstruct(images="photographs", masks="masks", out="outputs/glass")`.

    Returns:
        The trained run, `run` in the output folder.

    Raises:
        NerfroError: options are missing or contradict each other, or a stage failed.
    """
    arguments = [*as_overrides(settings), *overrides]
    with composed("reconstruct", ReconstructConfig, arguments, with_scene) as composition:
        return reconstruct_composed(composition)


def reconstruct_composed(composition: Composition) -> Run:
    """Run all stages that are not done, for composed options."""
    config, posed = composition.config, have_poses(composition.config, composition.overrides)
    out = user_path(config.out)
    read_outlines(config.outlines)  # refuses wrong outlines before the poses are estimated
    with lock_folder(out, "out"), decoded_once():
        capture = Capture.of(composition)
        if not posed:
            capture = _calibrate(config, capture, out)
        if config.outlines or config.mask:
            capture = _segment(config, capture)
        scene = _preprocess(composition, capture, out / "surface")
        run = _train(composition, scene, out)
        _report(run, out)
    return run


def _calibrate(config: DictConfig, capture: Capture, out: Path) -> Capture:
    """Estimate the poses of the photographs."""
    photographs = collect_photographs(config, out)
    if len(photographs) < _MIN_PHOTOGRAPHS:
        raise NerfroError(
            f"{len(photographs)} photographs do not determine poses and shape; take at least {_MIN_PHOTOGRAPHS}, "
            "better 60, from all sides"
        )
    if not config.outlines and "view=true" not in stage_options("mask", config) and not capture.masks:
        raise NerfroError(
            "the photographs have no masks; add mask='view=true' to draw the outline of the object in two to five "
            f"images in the browser, outlines={{{photographs[0].stem}:[[COLUMN,ROW],...],...}}, or masks=FOLDER"
        )
    settings = {"images": out / "images", "out": out, "target": "colmap", "overwrite": True}
    settings |= {"mask_labels": capture.settings.get("mask_labels")} | values_of(stage_options("calibrate", config))
    options = options_of(CalibrateConfig, None, settings)
    stage = Stage("calibrate", as_overrides(changed_settings(options)), out / REPORT, out / PLOT)
    return replace(stage.run(lambda: calibrate(options), lambda: Capture(out)), settings=capture.settings)


def _segment(config: DictConfig, capture: Capture) -> Capture:
    """Make the missing masks."""
    outlines = OmegaConf.to_container(config.outlines) if OmegaConf.is_config(config.outlines) else config.outlines
    options = [*as_overrides({"outlines": outlines} if outlines else {}), *stage_options("mask", config)]
    sheet = resolve_path(capture.root) / "masks.png"
    stage = Stage("mask", [*capture.overrides, *options], sheet, sheet)
    return stage.run(lambda: segment(capture, options), lambda: capture)


def _preprocess(composition: Composition, capture: Capture, folder: Path) -> SceneFile:
    """Reconstruct surface and index in a folder."""
    root, medium = resolve_path(capture.root), composition.config.medium
    inputs = [*root.glob("transforms*.json"), *capture.masks]
    own = stage_options("preprocess", composition.config)
    automatic = [*as_overrides({"out": folder}), "refine=true", "wrong_masks=null", "overwrite=true"]
    automatic += [] if is_given("mesh", own) else ["symmetry=auto"]
    if "wall" not in medium and "shell_voxels" in medium and medium.get("bodies") is None:
        automatic.append("vessel=true")
    options = [*of_groups(("medium",), composition.overrides), *not_given(automatic, own), *own]
    stage = Stage("preprocess", [*capture.overrides, *options], folder / SCENE, folder / SHEET, inputs)
    return stage.run(lambda: preprocess(capture, options), lambda: read_scene_file(folder / SCENE))


def _train(composition: Composition, scene: SceneFile, out: Path) -> Run:
    """Train with the hypothesis that `hypothesis=` names or that the trials prefer, or with a given experiment."""
    file = out / "surface" / SCENE
    inputs = [file, file.with_name(MESH)]
    common = common_options(composition.config, composition.overrides, scene.photograph)
    if is_given("experiment", common):
        options, stated = [], [option for option in common if is_given("experiment", [option])]
    else:
        hypothesis, trials = _find_hypothesis(composition, scene, common, out)
        options = stated = hypothesis.options
        inputs += [trial.run.folder / "metrics.json" for trial in trials]
    _set_aside_other_hypothesis(stated, out)
    return _run_training(scene, [*options, *common], inputs, out / "run")


def _find_hypothesis(
    composition: Composition, scene: SceneFile, common: Sequence[str], out: Path
) -> tuple[Hypothesis, list[Trial]]:
    """Return the hypothesis of the final training, and the trials that decided."""
    config, file = composition.config, out / "surface" / SCENE
    if scene.surroundings is None:
        raise NerfroError(
            f"{file} does not tell whether the surroundings are near, because no stage needed them; write "
            '"surroundings": "near" (an object in a room) or "far" into the file, and repeat this command'
        )
    candidates = hypotheses(scene)
    if config.hypothesis is None and config.trial_steps == 0:
        return candidates[1], []
    candidates = worth_a_trial(_selected(candidates, config.hypothesis, file), scene.provenance.unsupported)
    if len(candidates) == 1 or config.trial_steps == 0:
        return candidates[0], []
    trials, inputs = [], [file, file.with_name(MESH)]
    for hypothesis in candidates:
        print(f"\nhypothesis: {hypothesis.name}")
        short = hypothesis.trial_options(config.trial_steps)
        options = [*hypothesis.options, *not_given(common, short), *short]
        run = _run_training(scene, options, inputs, out / "trials" / hypothesis.folder)
        trials.append(Trial(hypothesis, run))
    best = decide(trials, composition.overrides)
    _draw(trials, out / "trials" / PICTURE)
    return best.hypothesis, trials


def _draw(trials: Sequence[Trial], picture: Path) -> None:
    """Draw the trials beside photographs, and print where; a picture that cannot be drawn is a warning."""
    if not picture.is_file() or is_older(picture, [trial.run.folder / "metrics.json" for trial in trials]):
        try:
            save_image(picture, draw_trials(trials, validation_views(trials[0].run.folder)))
        except NerfroError as error:
            warn(f"the hypotheses were not drawn: {error}")
            picture.unlink(missing_ok=True)  # of earlier trials
            return
    print(f"each hypothesis beside photographs: {picture}")


def _selected(candidates: Sequence[Hypothesis], choice: str | None, file: Path) -> list[Hypothesis]:
    """Return the hypotheses that `hypothesis=` names, or all without it."""
    selected = [hypothesis for hypothesis in candidates if choice in (None, hypothesis.choice)]
    if not selected:
        possible = " or ".join(dict.fromkeys(f"hypothesis={hypothesis.choice}" for hypothesis in candidates))
        raise NerfroError(
            f"hypothesis={choice} does not fit the bodies and the medium of {file}, which allow {possible}; for a "
            "vessel without fitted lengths, delete this file and add medium=vessel medium.wall=LENGTH "
            "(docs/guides/vessels.md)"
        )
    return selected


def _set_aside_other_hypothesis(options: Sequence[str], out: Path) -> None:
    """Record the options that state the hypothesis, and rename a run that was trained with others."""
    record, run, text = out / "hypothesis.json", out / "run", json.dumps(list(options))
    recorded = record.read_text(encoding="utf-8") if record.is_file() else None
    if run.exists() and text != recorded:
        print(f"\ntrain: the hypothesis of {run} is another one or unknown; it is kept as {move_aside(run)}")
    write_atomically(record, text)


def _run_training(scene: SceneFile, options: Sequence[str], inputs: Sequence[Path], folder: Path) -> Run:
    """Train, or resume an interrupted training if the inputs have not changed; the first input is the scene file."""
    options, started = [*options, *as_overrides({"hydra.run.dir": folder})], folder / CONFIG_FILE
    result = folder / "metrics.json"
    stage = Stage("train", [*as_overrides({"scene": inputs[0]}), *options], result, folder / "images", inputs)
    if started.is_file() and not stage.is_done:
        if is_older(started, inputs):
            print(f"\ntrain: the surface or a trial is newer than {folder}, which is kept as {move_aside(folder)}")
        else:
            options = [*options, "ckpt_path=last"]
            stage = replace(stage, options=[*stage.options, "ckpt_path=last"])
    return stage.run(lambda: train_scene(scene, options), lambda: Run(folder, read_metrics_json(result)))


def train_scene(scene: SceneFile, overrides: Sequence[str]) -> Run:
    """Train like `nerfro.train`, without warnings of settings that have no effect in some of the trainings."""
    with composed_training(None, overrides, scene) as composition:
        return run_training(composition)


def _report(run: Run, out: Path) -> None:
    """Write the report and the interactive page, and print where they are; a page that cannot be made is a warning."""
    report, page, inputs = out / "report" / "report.html", out / "page.html", [run.folder / "metrics.json"]
    picture = out / "trials" / PICTURE
    pictures = [str(picture)] if picture.is_file() else []
    options = SummaryConfig(
        runs=[str(run.folder)], out=str(report.parent), report=True, pictures=pictures, overwrite=True
    )
    summary = Stage("summary", as_overrides(changed_settings(options)), report, report, inputs)
    summary.run(lambda: summarize(options), lambda: None)
    exported = ExportConfig(checkpoint=str(run.folder), what="page", out=str(page), overwrite=True)
    try:
        stage = Stage("export", as_overrides(changed_settings(exported)), page, page, inputs)
        stage.run(lambda: export(options=exported), lambda: page)
    except NerfroError as error:
        warn(f"no page was written: {error}")
        page.unlink(missing_ok=True)  # of an earlier run
    print(f"\nreport: {report}")
    if page.is_file():
        print(f"page: {page}")

"""The chain from photographs to a trained scene, a report and a page: `nerfro.reconstruct`.

Stages exchange values. Each leaves files, from which a repeated reconstruction reads the values of completed stages.
"""

from __future__ import annotations

import shlex
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
from nerfro.evaluation.results import EXPOSED, FULL, read_metrics_json
from nerfro.files.folder_lock import lock_folder
from nerfro.masks.segment import segment
from nerfro.pipeline.export import export
from nerfro.pipeline.hypotheses import Hypothesis, hypotheses
from nerfro.pipeline.options import ReconstructConfig, common_options, have_poses
from nerfro.pipeline.stage import Stage, is_older, move_aside
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

# Smallest gain of bent rays over straight rays in short trainings, in dB. On a simulated empty glass, a gain of 0.33 dB
# in the trial became a gain of 0.75 dB after four minutes (docs/lab/simulated_glassware.md).
_MIN_GAIN = 0.25
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
    if not config.outlines and "view=true" not in shlex.split(config.mask) and not capture.masks:
        raise NerfroError(
            "the photographs have no masks; add mask='view=true' to draw the outline of the object in two to five "
            f"images in the browser, outlines={{{photographs[0].stem}:[[COLUMN,ROW],...],...}}, or masks=FOLDER"
        )
    settings = {"images": out / "images", "out": out, "target": "colmap", "overwrite": True}
    settings |= {"mask_labels": capture.settings.get("mask_labels")} | values_of(shlex.split(config.calibrate))
    options = options_of(CalibrateConfig, None, settings)
    stage = Stage("calibrate", as_overrides(changed_settings(options)), out / REPORT, out / PLOT)
    return replace(stage.run(lambda: calibrate(options), lambda: Capture(out)), settings=capture.settings)


def _segment(config: DictConfig, capture: Capture) -> Capture:
    """Make the missing masks."""
    outlines = OmegaConf.to_container(config.outlines) if OmegaConf.is_config(config.outlines) else config.outlines
    options = [*as_overrides({"outlines": outlines} if outlines else {}), *shlex.split(config.mask)]
    sheet = resolve_path(capture.root) / "masks.png"
    stage = Stage("mask", [*capture.overrides, *options], sheet, sheet)
    return stage.run(lambda: segment(capture, options), lambda: capture)


def _preprocess(composition: Composition, capture: Capture, folder: Path) -> SceneFile:
    """Reconstruct surface and index in a folder."""
    root, medium = resolve_path(capture.root), composition.config.medium
    inputs = [*root.glob("transforms*.json"), *capture.masks]
    own = shlex.split(composition.config.preprocess)
    automatic = [*as_overrides({"out": folder}), "refine=true", "wrong_masks=null", "overwrite=true"]
    automatic += [] if is_given("mesh", own) else ["symmetry=auto"]
    if "wall" not in medium and "shell_voxels" in medium and medium.get("bodies") is None:
        automatic.append("vessel=true")
    options = [*of_groups(("medium",), composition.overrides), *not_given(automatic, own), *own]
    stage = Stage("preprocess", [*capture.overrides, *options], folder / SCENE, folder / SHEET, inputs)
    return stage.run(lambda: preprocess(capture, options), lambda: read_scene_file(folder / SCENE))


def _train(composition: Composition, scene: SceneFile, out: Path) -> Run:
    """Train with the hypothesis that predicts the validation photographs best."""
    config, file = composition.config, out / "surface" / SCENE
    inputs = [file, file.with_name(MESH)]
    common = common_options(config, composition.overrides, scene.photograph)
    candidates = hypotheses(scene)
    if is_given("experiment", common):
        options = []
    elif scene.surroundings is None:
        raise NerfroError(
            f"{file} does not tell whether the surroundings are near, because no stage needed them; write "
            '"surroundings": "near" (an object in a room) or "far" into the file, and repeat this command'
        )
    elif config.trial_steps == 0:
        options = candidates[1].options
    else:
        unsupported = scene.provenance.unsupported
        candidates = [hypothesis for hypothesis in candidates if hypothesis.name not in unsupported]
        trials = []
        for hypothesis in candidates if len(candidates) > 1 else []:
            print(f"\nhypothesis: {hypothesis.name}")
            short = hypothesis.trial_options(config.trial_steps)
            options = [*hypothesis.options, *not_given(common, short), *short]
            trials.append(_run_training(scene, options, inputs, out / "trials" / hypothesis.folder))
        options = _best_hypothesis(candidates, trials, _advice(scene)).options
        inputs += [trial.folder / "metrics.json" for trial in trials]
    return _run_training(scene, [*options, *common], inputs, out / "run")


def _advice(scene: SceneFile) -> str:
    """Say how to train with bent rays although straight rays were chosen."""
    solid = "to use bent rays nevertheless, add trial_steps=0"
    if not scene.vessel:
        return solid
    experiment = "glass_room" if scene.surroundings == "near" else "glass"
    return f"{solid} for a solid body, or train='+experiment={experiment} medium=vessel' for the fitted vessel"


def _best_hypothesis(tried: Sequence[Hypothesis], runs: Sequence[Run], advice: str) -> Hypothesis:
    """Print the scores of the trials, and return the hypothesis with the best mean of image and object.

    Bent rays have to be better than straight rays by `_MIN_GAIN`, because scores of five views vary.

    Args:
        tried: the hypotheses, straight rays first.
        runs: trial of each hypothesis; empty if there are only straight rays.
        advice: how to train with bent rays if straight rays are chosen, for the message.
    """
    if not runs:
        print(f"\ntraining continues with: {tried[0].name}")
        print(f"no body explains the pixels of the object better; {advice}")
        return tried[0]
    scores = []
    print("\nPSNR of short trainings on validation photographs, in dB:")
    print(f"  {'hypothesis':<20}{'image':>9}{'object':>9}{'mean':>9}")
    for hypothesis, run in zip(tried, runs, strict=True):
        assert run.scores is not None  # of validation photographs
        # The exposures of validation photographs are unknown. Their right halves may lack the object.
        result = run.scores.treatments.get(EXPOSED, run.scores.result)
        result = run.scores.result if result.mean("psnr", "mask") is None else result
        image, inside = result.mean("psnr", FULL) or 0.0, result.mean("psnr", "mask")
        scores.append(image if inside is None else 0.5 * (image + inside))
        shown = "n/a" if inside is None else f"{inside:.2f}"
        print(f"  {hypothesis.name:<20}{image:>9.2f}{shown:>9}{scores[-1]:>9.2f}")
    bent = max(range(1, len(tried)), key=scores.__getitem__)
    best = tried[bent if scores[bent] >= scores[0] + _MIN_GAIN else 0]
    print(f"training continues with: {best.name}")
    if best is tried[0]:
        doubts = [hypothesis.doubt for hypothesis in tried if hypothesis.doubt]
        reason = doubts[0] if doubts else "the surface or the index is not accurate enough, or the object is opaque"
        print(f"the mean of bent rays is not higher by {_MIN_GAIN} dB: {reason}; {advice}")
    return best


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
    options = SummaryConfig(runs=[str(run.folder)], out=str(report.parent), report=True, overwrite=True)
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

"""The stages of `nerfro.reconstruct`. A stage runs a command, unless the result exists and is newer than the inputs."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from omegaconf import DictConfig

from nerfro.capture.preprocess_options import MESH
from nerfro.cli.overrides import as_overrides, is_given, not_given
from nerfro.core.errors import NerfroError, warn
from nerfro.evaluation.results import EXPOSED, FULL, read_metrics_json
from nerfro.pipeline.hypotheses import Hypothesis, hypotheses
from nerfro.pipeline.options import common_options
from nerfro.pipeline.stage import Stage, is_older, move_aside
from nerfro.poses import calibrated_data
from nerfro.poses.collection import collect_photographs
from nerfro.rendering.scene_file import SCENE, SceneFile, read_scene_file
from nerfro.silhouettes.overlaps import SHEET
from nerfro.training.run_folder import CONFIG_FILE

# Smallest gain of bent rays over straight rays in short trainings, in dB. On a simulated empty glass, a gain of 0.33 dB
# in the trial became a gain of 0.75 dB after four minutes (docs/lab/simulated_glassware.md).
_MIN_GAIN = 0.25
_MIN_PHOTOGRAPHS = 3
_MASKS = ("masks/*", "masks/*/*", "mask_*", "*/mask_*")  # where loaders search for masks


def calibrate(config: DictConfig, data: list[str], out: Path) -> list[str]:
    """Estimate the poses of the photographs, and return the options of the resulting data set."""
    linked = collect_photographs(config, out)
    if len(linked) < _MIN_PHOTOGRAPHS:
        raise NerfroError(
            f"{len(linked)} photographs do not determine poses and shape; take at least {_MIN_PHOTOGRAPHS}, "
            "better 60, from all sides"
        )
    draws = "view=true" in shlex.split(config.mask)
    if not config.outlines and not draws and not any(file for place in _MASKS for file in out.glob(place)):
        raise NerfroError(
            "the photographs have no masks; add mask='view=true' to draw the outline of the object in two to five "
            f"images in the browser, outlines={{{linked[0].stem}:[[COLUMN,ROW],...],...}}, or masks=FOLDER"
        )
    report, plot = out / calibrated_data.REPORT, out / calibrated_data.PLOT
    options = [*as_overrides({"images": out / "images", "out": out}), "target=colmap", "overwrite=true"]
    options += [text.removeprefix("data.") for text in data if text.startswith("data.mask_labels=")]
    Stage("calibrate", [*options, *shlex.split(config.calibrate)], report, plot).run()
    return [*as_overrides({"data.root": out}), *data]


def segment(config: DictConfig, options: list[str], root: Path) -> None:
    """Make the missing masks, if outlines are given."""
    if config.outlines or config.mask:
        sheet = root / "masks.png"
        Stage("mask", [*options, *shlex.split(config.mask)], sheet, sheet).run()


def preprocess(config: DictConfig, options: list[str], root: Path, folder: Path) -> Path:
    """Reconstruct surface and index in a folder, and return the scene file."""
    inputs = [*root.glob("transforms*.json"), *(file for place in _MASKS for file in root.glob(place))]
    given = shlex.split(config.preprocess)
    automatic = [*as_overrides({"out": folder}), "refine=true", "wrong_masks=null", "overwrite=true"]
    automatic += [] if is_given("mesh", given) else ["symmetry=auto"]
    if "wall" not in config.medium and "shell_voxels" in config.medium and config.medium.get("bodies") is None:
        automatic.append("vessel=true")
    options = [*options, *not_given(automatic, given), *given]
    scene = folder / SCENE
    Stage("preprocess", options, scene, folder / SHEET, inputs).run()
    return scene


def train(config: DictConfig, overrides: list[str], scene: Path, out: Path) -> None:
    """Train with the hypothesis that predicts the validation photographs best."""
    inputs = [scene, scene.with_name(MESH)]
    content = read_scene_file(scene)
    common, candidates = common_options(config, overrides, scene, content.photograph), hypotheses(content)
    if is_given("experiment", common):
        options = []
    elif content.surroundings is None:
        raise NerfroError(
            f"{scene} does not tell whether the surroundings are near, because no stage needed them; write "
            '"surroundings": "near" (an object in a room) or "far" into the file, and repeat this command'
        )
    elif config.trial_steps == 0:
        options = candidates[1].options
    else:
        unsupported = content.provenance.unsupported
        candidates = [hypothesis for hypothesis in candidates if hypothesis.name not in unsupported]
        trials = [out / "trials" / hypothesis.folder for hypothesis in candidates] if len(candidates) > 1 else []
        for hypothesis, trial in zip(candidates, trials, strict=False):
            print(f"\nhypothesis: {hypothesis.name}")
            short = hypothesis.trial_options(config.trial_steps)
            _run_training([*hypothesis.options, *not_given(common, short), *short], inputs, trial)
        options = _best_hypothesis(candidates, trials, _advice(content)).options
        inputs += [trial / "metrics.json" for trial in trials]
    _run_training([*options, *common], inputs, out / "run")


def _advice(scene: SceneFile) -> str:
    """Say how to train with bent rays although straight rays were chosen."""
    solid = "to use bent rays nevertheless, add trial_steps=0"
    if not scene.vessel:
        return solid
    experiment = "glass_room" if scene.surroundings == "near" else "glass"
    return f"{solid} for a solid body, or train='+experiment={experiment} medium=vessel' for the fitted vessel"


def _best_hypothesis(tried: Sequence[Hypothesis], runs: Sequence[Path], advice: str) -> Hypothesis:
    """Print the scores of the trials, and return the hypothesis with the best mean of image and object.

    Bent rays have to be better than straight rays by `_MIN_GAIN`, because scores of five views vary.

    Args:
        tried: the hypotheses, straight rays first.
        runs: run folder of the trial of each hypothesis; empty if there are only straight rays.
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
        metrics = read_metrics_json(run / "metrics.json")
        # The exposures of validation photographs are unknown. Their right halves may lack the object.
        result = metrics.treatments.get(EXPOSED, metrics.result)
        result = metrics.result if result.mean("psnr", "mask") is None else result
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


def _run_training(options: list[str], inputs: list[Path], run: Path) -> None:
    """Train, or resume an interrupted training if the inputs have not changed."""
    started = run / CONFIG_FILE
    options = [*options, *as_overrides({"hydra.run.dir": run})]
    stage = Stage("train", options, run / "metrics.json", run / "images", inputs)
    if started.is_file() and not stage.is_done:
        if is_older(started, inputs):
            print(f"\ntrain: the surface or a trial is newer than {run}, which is kept as {move_aside(run)}")
        else:
            stage = replace(stage, options=[*options, "ckpt_path=last"])
    stage.run()


def report(out: Path) -> None:
    """Write the report and the interactive page, and print where they are; a page that cannot be made is a warning."""
    report, page, run = out / "report" / "report.html", out / "page.html", out / "run"
    options = [*as_overrides({"runs": [run], "out": report.parent}), "report=true", "overwrite=true"]
    Stage("summary", options, report, report, [run / "metrics.json"]).run()
    options = as_overrides({"checkpoint": run, "what": "page", "out": page, "overwrite": True})
    try:
        Stage("export", options, page, page, [run / "metrics.json"]).run()
    except NerfroError as error:
        warn(f"no page was written: {error}")
        page.unlink(missing_ok=True)  # of an earlier run
    print(f"\nreport: {report}")
    if page.is_file():
        print(f"page: {page}")

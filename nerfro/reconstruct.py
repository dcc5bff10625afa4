"""`python -m nerfro.reconstruct images=PHOTOS masks=MASKS out=DIR`: from photographs to a scene and a report."""

from __future__ import annotations

import shlex
from dataclasses import replace
from pathlib import Path

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from nerfro.capture.calibrated_data import PLOT, REPORT
from nerfro.capture.overlaps import SHEET
from nerfro.capture.preprocess_options import FOUND, MESH, is_given
from nerfro.capture.reconstruct_options import (
    ReconstructConfig,
    have_poses,
    of_groups,
    read_result,
    training_options,
)
from nerfro.capture.stages import Stage, gather, is_older, move_aside, option
from nerfro.cli import entry_point
from nerfro.files.owned import held
from nerfro.paths import resolve_path, user_path
from nerfro.training.run_folder import CONFIG_FILE

_MASKS = ("masks/*", "masks/*/*", "mask_*", "*/mask_*")  # where loaders look for them


@entry_point("reconstruct", ReconstructConfig, verbatim=("calibrate", "mask", "preprocess", "train"))
def main(config: DictConfig) -> None:
    """Run the stages that are not done, one after the other."""
    overrides = list(HydraConfig.get().overrides.task)
    posed, out = have_poses(config, overrides), user_path(config.out)
    with held(out, "out"):
        root = resolve_path(config.data.root) if posed else out
        data = of_groups(("data",), overrides)
        if not posed:
            data = _place(config, data, out)
        if not is_given("data", data):
            data = ["data=opencv", *data]
        outlines = of_groups(("outlines",), overrides)
        if outlines or config.mask:
            options = [*data, *outlines, *shlex.split(config.mask)]
            Stage("mask", options, root / "masks.png", root / "masks.png").run()
        _train(config, overrides, _surface(config, [*data, *of_groups(("medium",), overrides)], root, out), out / "run")
        _report(out)


def _place(config: DictConfig, data: list[str], out: Path) -> list[str]:
    """Photographs get poses; returns the options of the data set that they become."""
    gather(user_path(config.images), None if config.masks is None else user_path(config.masks), out)
    options = [option("images", out / "images"), option("out", out), "target=colmap", "overwrite=true"]
    Stage("calibrate", [*options, *shlex.split(config.calibrate)], out / REPORT, out / PLOT).run()
    reach = read_result(out / REPORT, {"options"})["options"]
    return [option("data.root", out), *(text for text in reach if not is_given(text.split("=")[0], data)), *data]


def _surface(config: DictConfig, options: list[str], root: Path, out: Path) -> Path:
    """Surface and index; returns the folder where they are."""
    folder = out / "surface"
    made_of = [*root.glob("transforms*.json"), *(file for place in _MASKS for file in root.glob(place))]
    told = [option("out", folder), "refine=true", "wrong_masks=null", "symmetry=auto", "overwrite=true"]
    options = [*options, *told, *shlex.split(config.preprocess)]
    Stage("preprocess", options, folder / FOUND, folder / SHEET, made_of).run()
    return folder


def _train(config: DictConfig, overrides: list[str], surface: Path, run: Path) -> None:
    made_of, begun = (surface / FOUND, surface / MESH), run / CONFIG_FILE
    options = [*training_options(config, overrides, surface / FOUND), option("hydra.run.dir", run)]
    stage = Stage("train", options, run / "metrics.json", run / "images", made_of)
    if begun.is_file() and not stage.is_done:
        if is_older(begun, made_of):
            print(f"\ntrain: the surface is newer than {run}, which is kept as {move_aside(run)}")
        else:
            stage = replace(stage, options=[*options, "ckpt_path=last"])
    stage.run()


def _report(out: Path) -> None:
    page, run = out / "report" / "report.html", out / "run"
    options = [f"runs=[{option('', run)[1:]}]", option("out", page.parent), "report=true", "overwrite=true"]
    Stage("summary", options, page, page, [run / "metrics.json"]).run()
    turn = ["python", "-m", "nerfro.export", option("checkpoint", run), "what=page", option("out", out / "page.html")]
    print(f"a page on which to turn the object: {shlex.join(turn)}")


if __name__ == "__main__":
    main()

"""The simulated capture: photographs match the separate ground truth, and the commands recover it."""

import json
import math
import re
import shlex
import shutil
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from types import ModuleType

import pytest
import torch

from benchmarks.capture import measure
from nerfro.data.formats.transforms import OpenCVData
from nerfro.geometry.mesh import load_mesh
from nerfro.registry.registration import discover
from nerfro.synthetic import path_tracer
from nerfro.synthetic.scenes import dolphin_capture, photographs
from nerfro.synthetic.synthesis import synthesize
from tests.conftest import Runner
from tests.exact_silhouettes import overlaps_of_convex_body
from tests.test_synthesize import configured

discover()


def photograph(folder: Path, **options: object) -> Path:
    """Render a capture into a folder."""
    return synthesize(configured(scene="dolphin_capture", out=str(folder), **options)).folder


@pytest.fixture(scope="module", autouse=True)
def _built_quickly() -> Iterator[None]:
    """The scene is built once, its room is blurred and its light noisy: poses and outlines do not depend on these."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(photographs, "BAKING_SPP", 8)
        panels = dolphin_capture.room_panels
        patch.setattr(dolphin_capture, "room_panels", lambda spacing: panels(5 * spacing))
        patch.setattr(dolphin_capture, "build", cache(dolphin_capture.build))
        yield


@pytest.fixture(scope="module")
def few(mitsuba: ModuleType, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two photographs, large enough to find tags in."""
    return photograph(tmp_path_factory.mktemp("few"), resolution=400, photographs=2, spp=4)


@pytest.mark.slow
def test_poses_are_written_only_to_the_truth(few: Path) -> None:
    beside = [path.relative_to(few).parts[0] for path in few.rglob("*") if path.is_file()]
    assert set(beside) == {"images", "masks", "truth", ".lock"}
    assert len(list((few / "images").iterdir())) == len(list((few / "masks").iterdir())) == 2


@pytest.mark.slow
def test_masks_match_the_true_surface_in_the_true_cameras(few: Path) -> None:
    views = OpenCVData(str(few / "truth")).load("train")
    assert min(overlaps_of_convex_body(views, load_mesh(few / "truth" / "mesh.ply").vertices)) > 0.99


@pytest.mark.slow
@pytest.mark.usefixtures("mitsuba")
def test_commands_lead_from_photographs_to_scores(
    request: pytest.FixtureRequest,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    run_here: Runner,
    train_here: Runner,
) -> None:
    """The commands of docs/lab/simulated_capture.md as each prints the next, with few small photographs."""
    pytest.importorskip("pyapriltags")
    # Shares of pixels to 1 / 16 are enough for a hull of 48 voxels.
    monkeypatch.setattr(path_tracer, "SILHOUETTE_PLACES", path_tracer.SILHOUETTE_PLACES[::8])
    kept = request.config.cache.mkdir("dolphin_capture") / "photographs"
    photograph(kept, resolution=400, photographs=24, spp=4, overwrite=True)
    data = tmp_path / "data"

    for name in ("images", "masks", "truth"):
        shutil.copytree(kept / name, data / name)
    printed = run_here("calibrate", f"images={data / 'images'}", "target=apriltag", f"out={data}").out
    hull = ["resolution=48", "medium.resolution=48", "medium.cache=false", "medium.ior=1.33"]
    printed = run_here("preprocess", *printed_command("next", printed), *hull).out
    figures = measure(data, data)
    assert figures["photographs with a pose"] == 24
    assert figures["rotation, median error in degrees"] <= 0.1
    assert figures["position, median error in % of the distance"] <= 0.3
    assert figures["reprojection, mean over photographs in pixels"] <= 0.5
    assert figures["focal length, error in %"] <= 0.15
    assert figures["hull, intersection over union with the object"] >= 0.93
    run_folder = tmp_path / "run"
    train_here(
        "+experiment=glass_room",
        *printed_command("train on it", printed),
        *("trainer.max_steps=60", "trainer.max_time=null", "trainer.accelerator=cpu", "logger=none"),
        *("data.downscale=10", "batches.size=512", "evaluation.subdivision.side=1"),
        *("field.num_levels=6", "field.log2_table_size=13"),
        f"hydra.run.dir={run_folder}",
    )
    crop = json.loads((run_folder / "metrics.json").read_text())["regions"]["crop"]
    # One grey for all pixels would reach the second figure.
    views = OpenCVData(str(data), downscale=10).load("test")
    flat = -10 * math.log10(float(torch.stack(list(views.images)).var(correction=0)))
    assert crop["psnr"] > flat + 1


def printed_command(label: str, printed: str) -> list[str]:
    """The options of the command that a command prints."""
    return shlex.split(re.findall(f"{label}: (.*)", printed)[0])[3:]

"""The loaders from the command line."""

from __future__ import annotations

import json

import pytest
import trimesh
from omegaconf import OmegaConf

from nerfro.errors import NerfroError
from nerfro.registry import discover, find

from .photographs import POINTS, save_picture, world_to_camera
from .test_colmap import OPENCV, write_binary

TINY = [
    "sampler.points.num_samples=8",
    "sampler.points.num_bins=16",
    "sampler.points.resolution=16",
    "field.num_levels=4",
    "field.log2_table_size=10",
    "field.width=16",
    "medium.resolution=32",
    "medium.cache=false",
    "batches.size=32",
    "evaluation.supersample=1",
    "trainer.accelerator=cpu",
    "trainer.max_steps=2",
    "trainer.max_time=null",
    "logger=none",
]


def test_a_reconstruction_with_a_distorting_lens_trains_in_a_room(train_here, tmp_path):
    root = tmp_path / "capture"
    images = []
    for i in range(6):
        save_picture(root / f"images/v{i}.png", i)
        images.append((f"v{i}.png", 1, world_to_camera(i)))
    write_binary(root / "sparse/0", {1: OPENCV}, images, POINTS)
    trimesh.creation.icosphere(2, 0.3).export(root / "mesh.ply")
    run = tmp_path / "run"
    finished = train_here(
        "+experiment=refractive_room", "data=colmap", f"data.root={root}", "data.test_every=3", *TINY,
        f"hydra.run.dir={run}",
    )  # fmt: skip
    assert finished.code == 0, finished.err
    rows = json.loads((run / "metrics.json").read_text())["views"]
    assert len(rows) == 2
    config = OmegaConf.load(run / "config.yaml")
    middle = [0.5 * (low + high) for low, high in zip(config.field.box_min, config.field.box_max, strict=True)]
    assert middle == pytest.approx([0, 0, 0], abs=1e-4)  # of the mesh
    assert config.field.radius == config.sampler.points.radius > 0.5


@pytest.mark.parametrize(
    "options",
    [
        ["data=colmap"],
        ["data=llff"],
        ["data=nerfstudio", "data.near=1", "data.far=2"],
        ["data=idr"],
        ["data=nerrf"],
        ["data=refref"],
    ],
    ids=lambda options: options[0],
)
def test_a_folder_that_is_not_there_is_one_line(train_here, tmp_path, options):
    finished = train_here(*options, f"data.root={tmp_path / 'gone'}", *TINY[:3], "logger=none")
    assert finished.code == 1
    (line,) = finished.err.strip().splitlines()
    assert f"data.root={tmp_path / 'gone'}" in line


@pytest.mark.parametrize("data", ["colmap", "llff", "idr", "nerrf", "refref"])
def test_zero_is_no_far_bound_and_not_an_unknown_one(data):
    discover()
    with pytest.raises(NerfroError, match=r"data.far=0.0 are no interval"):
        find("data", data).cls(root="anywhere", far=0.0)

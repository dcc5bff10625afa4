"""Poses that are wrong come back with the hull that is made of their masks."""

from __future__ import annotations

import json
import math
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch
import trimesh

import nerfro.preprocess
from benchmarks.cameras import disturbed
from nerfro.camera.similarity import motion_between
from nerfro.capture import camera_refinement
from nerfro.data.base import Views
from nerfro.files.images import save_png
from nerfro.geometry.mesh import TriangleMesh
from nerfro.light import to_srgb
from tests.ball_photographs import NUM_VIEWS, RADIUS, SIZE, cameras, save, sky, soft_masks

TRUE = cameras()


def box_of_wood() -> TriangleMesh:
    """A rounded body that is not alike from any two sides."""
    made = trimesh.creation.icosphere(4, RADIUS)
    stretched = made.vertices * [1.0, 0.75, 0.55]
    bump = 1 + 0.15 * torch.sigmoid(torch.from_numpy(8 * (made.vertices @ [0.5, 0.6, 0.62] - 0.5))).numpy()
    return TriangleMesh(stretched * bump[:, None], made.faces)


def save_photographs(folder: Path, poses: torch.Tensor) -> None:
    """Photographs and masks as the true cameras take them, with these poses."""
    masks, images = soft_masks(box_of_wood()), []
    for view in range(NUM_VIEWS):
        image = to_srgb(sky(TRUE.image_rays(view).directions)).view(SIZE, SIZE, 3)
        mask = masks[view][..., None].expand(-1, -1, 3)
        images.append(image * (1 - mask) + 0.3 * mask)
        save_png(folder / "masks" / "train" / f"r_{view}.png", mask)
    names = [str(view) for view in range(NUM_VIEWS)]
    save(Views(replace(TRUE, camera_to_world=poses.float()), torch.stack(images), None, names), folder)


@pytest.mark.slow
def test_poses_come_back_with_the_hull(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    moved = disturbed(TRUE, math.radians(0.5), 0.01, 0)
    save_photographs(tmp_path, moved)
    monkeypatch.setattr(camera_refinement, "_ROUNDS", 2)
    monkeypatch.setattr(camera_refinement, "_VOXELS", 32)  # of masks that are 40 pixels wide
    out = tmp_path / "out"
    options = [f"data.root={tmp_path}", f"out={out}", "data.near=0.5", "resolution=32", "medium.ior=1.5"]
    options += ["refine_cameras=true", "medium.cache=false", "medium.resolution=32"]
    monkeypatch.setattr(sys, "argv", ["nerfro.preprocess", *options])
    nerfro.preprocess.main()
    printed = capsys.readouterr().out
    assert "cameras refined" in printed
    assert "camera=refined" in printed.splitlines()[-1]
    assert "camera=refined" in json.loads((out / "preprocess.json").read_text("utf-8"))["options"]
    frames = json.loads((out / "cameras.json").read_text("utf-8"))["frames"]
    found = torch.tensor([frame["transform_matrix"][:3] for frame in frames], dtype=torch.float64)
    before, after = motion_between(TRUE.camera_to_world, moved), motion_between(TRUE.camera_to_world, found)
    for old, new in zip(before, after, strict=True):
        assert float(new.median()) < 0.4 * float(old.median())

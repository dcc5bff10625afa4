"""`python -m nerfro.preprocess data.root=DIR`: an object's surface by its silhouettes, its index by its pictures."""

from __future__ import annotations

import shlex

import numpy as np
import torch
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from nerfro.capture.index_report import CURVE, INDEX, search_index
from nerfro.capture.overlaps import REPORT, SHEET, report_overlaps
from nerfro.capture.pose_conventions import require_consistent_poses
from nerfro.capture.preprocess_options import (
    MESH,
    PreprocessConfig,
    build_medium,
    claim,
    index_settings,
    is_given,
    surface_settings,
    train_command,
)
from nerfro.capture.surface import make_mesh, read_silhouettes
from nerfro.cli import entry_point
from nerfro.data.masks import masked_views
from nerfro.errors import NerfroError
from nerfro.geometry.mesh import load_mesh
from nerfro.media.solid import Solid
from nerfro.paths import resolve_path
from nerfro.registry import build


@entry_point("preprocess", PreprocessConfig)
@torch.no_grad()
def main(config: DictConfig) -> None:
    """Carve, fit, compare with the masks, find the index; whatever can be refused is refused before that."""
    mesh = None if config.mesh is None else load_mesh(resolve_path(config.mesh))
    overrides = list(HydraConfig.get().overrides.task)
    folder = claim(config, overrides)
    views = masked_views(build(config.data).load(config.split))
    box = None if config.box_min is None else np.array([config.box_min, config.box_max], np.float64)
    location, written = config.mesh, []
    if mesh is None or views.masks is not None:
        silhouettes = read_silhouettes(views, box is not None)
        require_consistent_poses(silhouettes, views.names, config.wrong_masks)
        carved = mesh is None
        if mesh is None:
            mesh = make_mesh(silhouettes, box, config.resolution, config.wrong_masks, config.keep, config.smoothing)
            location, written = str(folder / MESH), [MESH]
            mesh.save(folder / MESH)
        # Pictures and figures first: they help to find out what is wrong with a mesh that the medium then refuses.
        report_overlaps(config.split, views, mesh, silhouettes, config.wrong_masks if carved else None, folder)
        written += [SHEET, REPORT]
    settings = surface_settings(config, views.cameras, mesh, location, overrides)
    if is_given("medium.ior", overrides):
        iors, told = [config.medium.ior, *config.medium.get("inner_iors", [])], True
        build_medium(config, settings, location, iors)
    else:
        num_bodies = 1 + len(config.medium.get("inner_meshes", []))
        medium = build_medium(config, settings, location, [1.5] * num_bodies)
        if not isinstance(medium, Solid):
            raise NerfroError("the index of this medium is not searched for; give medium.ior=, or take medium=object")
        found = search_index(views, mesh, medium, config.room, folder)
        written += [INDEX, CURVE]
        iors, told = found.iors.tolist(), not found.doubts
    print(f"wrote {', '.join(str(folder / name) for name in written)}")
    if told:
        settings = {f"medium.{name}": value for name, value in index_settings(iors).items()} | settings
    else:
        print("give medium.ior=N yourself")
    print("where the surroundings are near, add +experiment=refractive_room; the baseline is +experiment=mipnerf")
    print(f"train on it: {shlex.join(train_command(settings, overrides))}")


if __name__ == "__main__":
    main()

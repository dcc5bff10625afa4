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
from nerfro.capture.refined_mesh import ERRORS, refine_mesh
from nerfro.capture.silhouettes import mesh_silhouettes
from nerfro.capture.surface import make_mesh, read_silhouettes
from nerfro.capture.visual_hull import Silhouettes
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
    every_view = build(config.data).load(config.split)
    views = masked_views(every_view)
    box = None if config.box_min is None else np.array([config.box_min, config.box_max], np.float64)
    location, written, silhouettes = config.mesh, [], None
    allowed = config.wrong_masks if mesh is None else None  # what the hull forgives, for advice
    if mesh is None or views.masks is not None:
        silhouettes = read_silhouettes(views, box is not None)
        require_consistent_poses(silhouettes, views.names, config.wrong_masks)
        if mesh is None:
            mesh = make_mesh(silhouettes, box, config.resolution, config.wrong_masks, config.keep, config.smoothing)
            location = str(folder / MESH)
            mesh.save(folder / MESH)
            written = [MESH]
        # Pictures and figures first: they help to find out what is wrong with a mesh that the medium then refuses.
        report_overlaps(config.split, views, mesh, silhouettes, folder, allowed)
        written += [SHEET, REPORT]
    settings = surface_settings(config, views.cameras, mesh, location, overrides)
    num_bodies = 1 + len(config.medium.get("inner_meshes", []))
    if not is_given("medium.ior", overrides):
        medium = build_medium(config, settings, location, [1.5] * num_bodies)
        if not isinstance(medium, Solid):
            raise NerfroError("the index of this medium is not searched for; give medium.ior=, or take medium=object")
        found = search_index(every_view, mesh, medium, config.room, folder)
        written += [INDEX, CURVE]
        iors, told = found.iors.tolist(), not found.doubts
    else:
        iors, told = [config.medium.ior, *config.medium.get("inner_iors", [])], True
        build_medium(config, settings, location, iors)
    if config.refine:
        if num_bodies > 1:
            raise NerfroError("refine=true takes one body; refine the outer surface without medium.inner_meshes")
        outlines = silhouettes or Silhouettes.of(views.cameras, mesh_silhouettes(mesh, views.cameras, 1).float())
        mesh = refine_mesh(views, mesh, outlines, iors[0], config.room, config.resolution, folder)
        mesh.save(folder / MESH)
        location = str(folder / MESH)
        if silhouettes is not None:
            report_overlaps(config.split, views, mesh, silhouettes, folder, allowed)
        settings = surface_settings(config, views.cameras, mesh, location, overrides)
        written = list(dict.fromkeys([MESH, *written, ERRORS]))
    if told:
        settings = {f"medium.{name}": value for name, value in index_settings(iors).items()} | settings
    else:
        print("give medium.ior=N yourself")
    print(f"wrote {', '.join(str(folder / name) for name in written)}")
    print("where the surroundings are near, add +experiment=refractive_room; the baseline is +experiment=mipnerf")
    print(f"train on it: {shlex.join(train_command(settings, overrides))}")


if __name__ == "__main__":
    main()

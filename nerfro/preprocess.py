"""`python -m nerfro.preprocess data.root=DIR`: an object's surface by its silhouettes, its index by its pictures."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from nerfro.capture.camera_refinement import refine_cameras
from nerfro.capture.medium_search import find_medium, refinable
from nerfro.capture.overlaps import REPORT, SHEET, draw_overlays, report_overlaps, settled_wrong_masks
from nerfro.capture.pose_conventions import require_consistent_poses
from nerfro.capture.preprocess_options import (
    CAMERAS,
    MESH,
    PreprocessConfig,
    claim,
    conclude,
    searches_index,
    surface_settings,
)
from nerfro.capture.refinement_report import FIGURES, PICTURES, refine
from nerfro.capture.silhouettes import mesh_silhouettes
from nerfro.capture.surface import make_mesh, read_silhouettes, surfaces_inside
from nerfro.capture.surroundings import Around
from nerfro.capture.visual_hull import Silhouettes
from nerfro.cli import entry_point, warn
from nerfro.data.masks import masked_views
from nerfro.errors import NerfroError
from nerfro.geometry.mesh import TriangleMesh, load_mesh
from nerfro.paths import resolve_path
from nerfro.registry import build
from nerfro.viewing.camera_files import write_cameras


@entry_point("preprocess", PreprocessConfig)
@torch.no_grad()
def main(config: DictConfig) -> None:
    """Carve, fit, compare with the masks, find the index; whatever can be refused is refused before that."""
    mesh = None if config.mesh is None else load_mesh(resolve_path(config.mesh))
    overrides = list(HydraConfig.get().overrides.task)
    folder = claim(config, overrides)
    views = masked_views(build(config.data).load(config.split))
    box = None if config.box_min is None else np.array([config.box_min, config.box_max], np.float64)
    location, written, overlaps, silhouettes = config.mesh, [], None, None
    if mesh is None or views.masks is not None or config.refine_cameras:
        silhouettes = read_silhouettes(views, box is not None)
        wrong_masks = settled_wrong_masks(silhouettes, config.wrong_masks)
        require_consistent_poses(silhouettes, views.names, wrong_masks)
        carved = mesh is None

        def hull(silhouettes: Silhouettes, voxels: int = config.resolution) -> TriangleMesh:
            return make_mesh(silhouettes, box, voxels, wrong_masks, config.keep, config.smoothing, config.symmetry)

        if config.refine_cameras:
            camera = refine_cameras(views, silhouettes, wrong_masks, hull if mesh is None else mesh)
            write_cameras(folder / CAMERAS, camera, views)
            written.append(CAMERAS)
            views = replace(views, cameras=camera.estimated(views.cameras))
            silhouettes = replace(silhouettes, cameras=views.cameras)
        if mesh is None:
            mesh, location = hull(silhouettes), str(folder / MESH)
            written.append(MESH)
            mesh.save(folder / MESH)
        # Pictures and figures first: they help to find out what is wrong with a mesh that the medium then refuses.
        overlaps = report_overlaps(config.split, views, mesh, silhouettes, wrong_masks if carved else None, folder)
        written += [SHEET, REPORT]
    settings = surface_settings(config, views.cameras, mesh, location, overrides)
    around = Around(views, mesh, config.room)
    found = find_medium(config, overrides, around, location, settings, folder)
    if config.refine:
        if silhouettes is None:
            silhouettes = Silhouettes.of(views.cameras, mesh_silhouettes(mesh, views.cameras, 1).float())
        before, location = mesh, str(folder / MESH)
        written = [MESH, *(name for name in written if name != MESH)]
        try:
            mesh = refine(around, mesh, refinable(found), silhouettes, searches_index(config, overrides), folder).mesh
            written += [FIGURES, PICTURES]
        except NerfroError as reason:  # all that is known by now is worth keeping
            warn(f"surface unchanged: {reason}")
        mesh.save(folder / MESH)
        settings = surface_settings(config, views.cameras, mesh, location, overrides)
        if mesh is not before:
            if overlaps is not None:
                overlaps = report_overlaps(config.split, views, mesh, silhouettes, None, folder, list_all=False)
            found = find_medium(config, overrides, around, location, settings, folder)
    inside = surfaces_inside(found.medium)
    if overlaps is not None and inside:
        draw_overlays(views, mesh, overlaps, inside, folder)
    settings |= found.settings | ({"camera": "refined"} if config.refine_cameras else {})
    conclude(folder, [*written, *found.written], settings, overrides, found.doubtful, around.near, views.cameras)


if __name__ == "__main__":
    main()

"""`python -m nerfro.preprocess data.root=DIR medium.ior=1.33`: an object's surface from its silhouettes."""

from __future__ import annotations

import json
import shlex

import numpy as np
import torch
from hydra.core.hydra_config import HydraConfig
from jaxtyping import Float
from omegaconf import DictConfig

from nerfro.capture.overlays import contact_sheet
from nerfro.capture.pose_conventions import GOOD_OVERLAP, better_wrong_masks, overlap, require_consistent_poses
from nerfro.capture.preprocess_options import MESH, REPORT, SHEET, PreprocessConfig, claim, train_command
from nerfro.capture.surface import make_mesh, read_silhouettes
from nerfro.capture.visual_hull import Silhouettes
from nerfro.cli import entry_point, warn
from nerfro.data.masks import masked_views
from nerfro.errors import first_of
from nerfro.files.atomic import write_atomically
from nerfro.files.images import save_picture
from nerfro.geometry.mesh import load_mesh
from nerfro.paths import resolve_path
from nerfro.registry import build

_MAX_PIXELS = 256


@entry_point("preprocess", PreprocessConfig)
@torch.no_grad()
def main(config: DictConfig) -> None:
    """Carve, fit, compare with the masks, and say how to train; whatever can be refused is refused before that."""
    mesh = None if config.mesh is None else load_mesh(resolve_path(config.mesh))
    folder = claim(config)
    views = masked_views(build(config.data).load(config.split))
    box = None if config.box_min is None else np.array([config.box_min, config.box_max], np.float64)
    silhouettes = read_silhouettes(views, box is not None)
    require_consistent_poses(silhouettes, views.names, config.wrong_masks)
    location, written = config.mesh, [SHEET, REPORT]
    if mesh is None:
        mesh = make_mesh(silhouettes, box, config.resolution, config.wrong_masks, config.keep, config.smoothing)
        location, written = str(folder / MESH), [MESH, *written]
    overlaps = overlap(mesh, silhouettes, _MAX_PIXELS)
    _report(overlaps, views.names)
    _warn_of_bad(overlaps, views.names, silhouettes, config)
    # Pictures and figures first: they help to find out what is wrong with a mesh that the medium then refuses.
    save_picture(folder / SHEET, contact_sheet(views, mesh, overlaps, _MAX_PIXELS))
    each = dict(zip(views.names, (round(float(x), 4) for x in overlaps), strict=True))
    figures = {"split": config.split, "mean": round(float(overlaps.mean()), 4), "views": each}
    write_atomically(folder / REPORT, json.dumps(figures, indent=1) + "\n")
    if MESH in written:
        mesh.save(folder / MESH)
    print(f"wrote {', '.join(str(folder / name) for name in written)}")
    command = train_command(config, silhouettes, mesh, location, list(HydraConfig.get().overrides.task))
    print("where the surroundings are near, add +experiment=refractive_room; the baseline is +experiment=mipnerf")
    print(f"train on it: {shlex.join(command)}")


def _report(overlaps: Float[np.ndarray, "V"], names: list[str]) -> None:
    print("overlap (intersection over union) of the surface's silhouette with each mask:")
    for name, value in zip(names, overlaps, strict=True):
        print(f"  {value:.4f}  {name}")
    worst = int(overlaps.argmin())
    print(f"  {overlaps.mean():.4f}  mean; {overlaps[worst]:.4f} lowest, {names[worst]}")


def _warn_of_bad(
    overlaps: Float[np.ndarray, "V"], names: list[str], silhouettes: Silhouettes, config: DictConfig
) -> None:
    bad = [names[view] for view in np.argsort(overlaps, kind="stable") if overlaps[view] < GOOD_OVERLAP]
    if not bad:
        return
    better = better_wrong_masks(silhouettes, config.wrong_masks) if config.mesh is None else None
    advice = (
        "" if better is None else f"; where few masks are wrong, the others make a better hull: wrong_masks={better}"
    )
    warn(f"overlaps below {GOOD_OVERLAP}: {first_of(bad)}; look at {SHEET}, and correct their masks or poses{advice}")


if __name__ == "__main__":
    main()

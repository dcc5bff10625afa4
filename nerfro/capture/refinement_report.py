"""Refinement of a surface with progress bar, report file and comparison images."""

from __future__ import annotations

import json
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from nerfro.capture.refinement import refine_surface
from nerfro.capture.silhouettes import mesh_silhouettes
from nerfro.capture.surroundings import VALIDATION_EVERY, Observations, Surroundings
from nerfro.capture.visual_hull import Silhouettes
from nerfro.cli import warn
from nerfro.errors import Interrupted, NerfroError
from nerfro.files.atomic import write_atomically
from nerfro.files.drawing import sheet
from nerfro.files.images import save_image
from nerfro.geometry.mesh import TriangleMesh
from nerfro.light import to_srgb
from nerfro.media.sdf_grid import SdfGrid
from nerfro.progress import bar
from nerfro.rays import Rays
from nerfro.samplers.snell import Snell

FIGURES, PICTURES = "refinement.json", "refinement.png"
RECORD = "refinement.state"  # state of an unfinished refinement
_NUM_PICTURES = 4
_WIDTH = 256  # width of an image, in pixels


def refine(
    observations: Observations,
    mesh: TriangleMesh,
    medium: SdfGrid,
    silhouettes: Silhouettes | None,
    learn_index: bool,
    folder: Path,
) -> TriangleMesh:
    """Refine a surface with a progress bar, write refinement.json and refinement.png, and print the improvement.

    Args:
        observations: observations of the object and its surroundings.
        mesh, medium, learn_index: see `refine_surface`.
        silhouettes: silhouettes of the masks; None uses projections of the mesh.
        folder: output folder.

    Returns:
        The refined surface; the given one without a significant improvement, or if the refinement is impossible.
    """
    through, surroundings, cameras = observations.through, observations.surroundings, observations.views.cameras
    if silhouettes is None:
        silhouettes = Silhouettes.of(cameras, mesh_silhouettes(mesh, cameras, 1).float())
    try:
        with bar("surface") as progress:
            refined = refine_surface(
                mesh, medium, silhouettes, through, surroundings, learn_index, progress, folder / RECORD
            )
    except KeyboardInterrupt:
        raise Interrupted("to resume the refinement, repeat the command with overwrite=true") from None
    except NerfroError as reason:  # keep the results of the other steps
        warn(f"surface unchanged: {reason}")
        return mesh
    before, after = refined.errors[0], min(refined.errors)
    change = f"validation error {before:.4f} -> {after:.4f} (0 exact, 1 unrelated)"
    if refined.mesh is mesh:
        print(f"surface unchanged: {change}, which is no significant improvement")
    else:
        moved = float(torch.from_numpy(refined.mesh.vertices - mesh.vertices).norm(dim=-1).median())
        print(f"surface refined: {change}; median displacement {moved:.2g} world units")
    figures = {"steps": refined.steps, "held_back_error": [round(error, 5) for error in refined.errors]}
    write_atomically(folder / FIGURES, json.dumps(figures, indent=1) + "\n")
    _draw(observations, medium, refined.medium, folder / PICTURES)
    return refined.mesh


def _draw(observations: Observations, before: SdfGrid, after: SdfGrid, file: Path) -> None:
    """Draw validation photographs beside the surroundings as refracted by both surfaces."""
    views, cameras, every = observations.views, observations.through.cameras, VALIDATION_EVERY
    validation = range(every - 1, len(views), every) if len(views) >= every else range(len(views))
    pictures, captions = [], []
    for view in list(validation)[:: max(1, len(validation) // _NUM_PICTURES)][:_NUM_PICTURES]:
        pictures.append(views.images[view])
        captions.append(f"photograph {views.names[view][-16:]}")
        for state, medium in (("before", before), ("after", after)):
            rays = cameras.image_rays(view)
            radiance = _seen_through(observations.surroundings, medium, rays)
            pictures.append(to_srgb(radiance.view(cameras.height, cameras.width, 3)).clamp(0, 1))
            captions.append(f"{state}, nothing inside")
    save_image(file, sheet(pictures, captions, _WIDTH, 3, "surroundings as refracted by the surface"))


@torch.no_grad()
def _seen_through(surroundings: Surroundings, medium: SdfGrid, rays: Rays) -> Float[Tensor, "R 3"]:
    return surroundings.radiance(Snell()(rays, medium).exits())[0]

"""A surface's refinement: its bar, its figures, and pictures of what is seen through the surface before and after."""

from __future__ import annotations

import json
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from nerfro.capture.refinement import Refined, refine_surface
from nerfro.capture.surroundings import HELD_BACK, Around, Surroundings
from nerfro.capture.visual_hull import Silhouettes
from nerfro.errors import Interrupted
from nerfro.files.atomic import write_atomically
from nerfro.files.drawing import sheet
from nerfro.files.images import save_picture
from nerfro.geometry.mesh import TriangleMesh
from nerfro.light import to_srgb
from nerfro.media.sdf_grid import SdfGrid
from nerfro.progress import bar
from nerfro.rays import Rays
from nerfro.samplers.snell import Snell

FIGURES, PICTURES = "refinement.json", "refinement.png"
RECORD = "refinement.state"  # while it goes on, and after it was interrupted
_NUM_PICTURES = 4
_WIDTH = 256  # pixels across each picture


def refine(
    around: Around, mesh: TriangleMesh, medium: SdfGrid, silhouettes: Silhouettes, learn_index: bool, folder: Path
) -> Refined:
    """Refine a surface with a progress bar; write refinement.json and refinement.png, and print what was gained.

    Args:
        around: what photographs show.
        mesh, medium, silhouettes, learn_index: see `refine_surface`.
        folder: to write to.
    """
    through, surroundings = around.through, around.surroundings
    try:
        with bar("surface") as done:
            refined = refine_surface(
                mesh, medium, silhouettes, through, surroundings, learn_index, done, folder / RECORD
            )
    except KeyboardInterrupt:
        raise Interrupted("to go on with the refinement, repeat the command with overwrite=true") from None
    before, after = refined.errors[0], min(refined.errors)
    told = f"held-back pixels are off by {after:.4f} instead of {before:.4f} (0 right, 1 unrelated)"
    if refined.mesh is mesh:
        print(f"the surface stays as it is: at best {told}, which is too little to trust")
    else:
        moved = float(torch.from_numpy(refined.mesh.vertices - mesh.vertices).norm(dim=-1).median())
        print(f"surface refined: {told}; half of it moved by {moved:.2g} or more")
    figures = {"steps": refined.steps, "held_back_error": [round(error, 5) for error in refined.errors]}
    write_atomically(folder / FIGURES, json.dumps(figures, indent=1) + "\n")
    _draw(around, medium, refined.medium, folder / PICTURES)
    return refined


def _draw(around: Around, before: SdfGrid, after: SdfGrid, file: Path) -> None:
    """Photographs that were held back, and what the surroundings would show through both surfaces in their place."""
    views, cameras = around.views, around.through.cameras
    held_back = range(HELD_BACK - 1, len(views), HELD_BACK) if len(views) >= HELD_BACK else range(len(views))
    pictures, captions = [], []
    for view in list(held_back)[:: max(1, len(held_back) // _NUM_PICTURES)][:_NUM_PICTURES]:
        pictures.append(views.images[view])
        captions.append(f"photograph {views.names[view][-16:]}")
        for what, medium in (("before", before), ("after", after)):
            rays = cameras.image_rays(view)
            radiance = _seen_through(around.surroundings, medium, rays)
            pictures.append(to_srgb(radiance.view(cameras.height, cameras.width, 3)).clamp(0, 1))
            captions.append(f"{what}, nothing inside")
    save_picture(file, sheet(pictures, captions, _WIDTH, 3, "the surroundings as they are seen through the surface"))


@torch.no_grad()
def _seen_through(surroundings: Surroundings, medium: SdfGrid, rays: Rays) -> Float[Tensor, "R 3"]:
    return surroundings.radiance(Snell()(rays, medium).exits())[0]

"""Interactive page of a trained scene: one self-contained HTML file that traces bent rays with WebGL2."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from markupsafe import Markup
from PIL import Image
from torch import Tensor

from nerfro.core.cameras import Cameras, up_direction
from nerfro.core.errors import NerfroError
from nerfro.core.light import ColourSpace
from nerfro.core.paths import ASSETS_DIR, scene_name
from nerfro.data.lazy_images import LazyImages
from nerfro.files.atomic import write_atomically
from nerfro.files.images import data_uri, to_8bit
from nerfro.files.templates import fill_template
from nerfro.geometry.space import Box, Space
from nerfro.samplers.subdivision import Subdivision
from nerfro.viewing.baking import Baked, bake_sky, bake_surface, bake_volume
from nerfro.viewing.exports import EXPORTS, Export, ExportConfig
from nerfro.viewing.trained_scene import TrainedScene
from nerfro.viewing.volume import MIN_OPTICAL_DEPTH, RESOLUTION, sample_field

_TEMPLATES = ASSETS_DIR / "_page"
_MAX_PHOTOGRAPHS = 24  # photographs on the page, spread evenly over the cameras
_PHOTOGRAPH_SIDE = 256  # maximum size of the longer side, pixels
_SEARCH_RESOLUTION = 64  # grid vertices per side for the search for the content of an unbounded field
_SPLITS = ("test", "val", "train")  # the cameras are those of the first split that the data set has


def make_page(scene: TrainedScene, resolution: int) -> str:
    """Make the page of a trained scene, with `resolution` grid vertices along the longest side of the volume.

    Raises:
        NerfroError: the medium has no surface, or the position of the scene is unknown.
    """
    split = page_split(scene)
    views = scene.views(split) if scene.has_data else None
    cameras = scene.cameras(split) if views is None else views.cameras
    images = None if views is None else views.images
    parts = bake_parts(scene, cameras, resolution, progress=True)
    poster = _poster(scene, cameras) if len(cameras) else None
    return assemble_page(scene, static_parts(scene, cameras, images, split), parts, poster=poster)


def page_split(scene: TrainedScene) -> str:
    """Return the split whose cameras are on the page; without data, only the training cameras are known."""
    if not scene.has_data:
        return "train"
    source = scene.source
    return next((name for name in _SPLITS if name in source.splits), source.splits[0])


def bake_parts(
    scene: TrainedScene, cameras: Cameras, resolution: int, surface: bool = True, progress: bool = False
) -> dict[str, Baked]:
    """Convert everything that training may change: sky, volume and, if `surface` is set, the bodies."""
    renderer = scene.renderer
    parts = {"surface": bake_surface(renderer)} if surface else {}
    volume = sample_field(scene, resolution, volume_space(scene, cameras), progress)
    return {
        **parts,
        "volume": bake_volume(volume, renderer.scene.colour_space),
        "sky": bake_sky(renderer.scene.background, renderer.scene.device),
    }


def assemble_page(
    shown: TrainedScene, static: dict[str, Any], parts: dict[str, Baked], live: bool = False, poster: str | None = None
) -> str:
    """Fill the template with `static_parts` and `bake_parts`; a live page asks its server for updates.

    `poster` is a picture that browsers show before the first frame, and without WebGL2.
    """
    title = scene_name(shown.source.root).replace("_", " ").capitalize() or shown.name or "Scene"
    scene = {**static, **{name: part.metadata for name, part in parts.items()}, "live": live}
    arrays = {name: uri for part in parts.values() for name, uri in part.packed().items()}

    def asset(name: str) -> Markup:
        return Markup((_TEMPLATES / name).read_text(encoding="utf-8"))

    template = _TEMPLATES / "page.html.jinja"
    return fill_template(template, title=title, scene=scene, arrays=arrays, poster=poster, asset=asset)


def static_parts(
    scene: TrainedScene, cameras: Cameras, images: LazyImages | Float[Tensor, "V H W 3"] | None, split: str
) -> dict[str, Any]:
    """Collect the data that is constant during training: cameras, photographs, and the position of the scene.

    Args:
        scene: the scene.
        cameras: cameras on the page.
        images: their photographs, sRGB in [0, 1]; None without data.
        split: name of the split of the cameras.
    """
    renderer = scene.renderer
    space, box = renderer.scene.space, renderer.scene.medium.content_box.float().cpu()
    if not (box[1] > box[0]).all():
        box = scene.bounds if space.has_box else volume_space(scene, cameras).box
    # Arc length at which the integration along a ray begins.
    near = float(cameras.near if space.near is None else space.near)
    with_photograph = set(range(len(cameras)))
    if len(cameras) > _MAX_PHOTOGRAPHS:
        with_photograph = {i * len(cameras) // _MAX_PHOTOGRAPHS for i in range(_MAX_PHOTOGRAPHS)}
    return {
        "pinhole": cameras.distortion is None,
        "linear": renderer.scene.colour_space is not ColourSpace.SRGB,
        "origin": scene.source.origin.tolist(),
        "reflection": renderer.path_sampler.branching.max_split_events > 0,
        "turntable": cameras.turntable,
        "orbit": {
            "target": box.mean(0).tolist(),
            "radius": float((box[1] - box[0]).norm() / 2),
            "halfWidth": float((box[1] - box[0]).min() / 2),
            "up": up_direction(cameras.camera_to_world[:, :, 1]).tolist(),
            "near": near,
        },
        "cameras": [
            {
                "name": f"{split}_{view:03d}",
                "eye": cameras.camera_to_world[view, :, 3].tolist(),
                "axes": cameras.camera_to_world[view, :, :3].T.flatten().tolist(),
                "focal": [float(cameras.fx[view]), float(cameras.fy[view])],
                "principal": [float(cameras.cx[view]), float(cameras.cy[view])],
                "size": [cameras.width, cameras.height],
                "near": near,
                "photograph": _thumbnail(images[view]) if images is not None and view in with_photograph else None,
            }
            for view in range(len(cameras))
        ],
    }


def _poster(scene: TrainedScene, cameras: Cameras) -> str:
    """Render the first camera as a small picture."""
    longest = max(cameras.width, cameras.height)
    scale = min(2.0, 384 / longest)  # at most 384 pixels
    size = [max(1, round(scale * side)) for side in (cameras.width, cameras.height)]
    rgb = scene.render(cameras.select([0]).resized(*size), Subdivision()).rgb[0]
    return data_uri(to_8bit(rgb).cpu().numpy(), "JPEG", quality=85)


def _thumbnail(rgb: Float[Tensor, "H W 3"]) -> str:
    image = Image.fromarray(to_8bit(rgb).cpu().numpy())
    image.thumbnail((_PHOTOGRAPH_SIDE, _PHOTOGRAPH_SIDE))
    return data_uri(np.asarray(image), "JPEG", quality=90)


def volume_space(scene: TrainedScene, cameras: Cameras) -> Space:
    """Return the space of the volume on the page: that of the scene, or the box of the dense cells among the cameras.

    Raises:
        NerfroError: the space of the scene has no box, and all cameras are at one position.
    """
    if scene.renderer.scene.space.has_box:
        return scene.renderer.scene.space
    eyes = cameras.camera_to_world[..., 3].float().cpu()
    centre, half = (eyes.amax(0) + eyes.amin(0)) / 2, float((eyes.amax(0) - eyes.amin(0)).max()) / 2
    if half == 0:
        raise NerfroError(
            "the position of the scene is unknown: its space has no box, and all cameras are at one position; "
            "train with content.box_min and content.box_max"
        )
    box = torch.stack([centre - half, centre + half])
    density = sample_field(scene, _SEARCH_RESOLUTION, Box(box), progress=False).density
    cell = 2 * half / (_SEARCH_RESOLUTION - 1)
    dense = (density * cell > MIN_OPTICAL_DEPTH).nonzero()
    if not len(dense):
        return Box(box)
    corners = box[0] + cell * torch.stack([dense.amin(0) - 1, dense.amax(0) + 1])
    return Box(torch.maximum(torch.minimum(corners, box[1]), box[0]))


def _write(scene: TrainedScene, out: Path, options: ExportConfig) -> str:
    page = make_page(scene, options.resolution or RESOLUTION)
    write_atomically(out, page)
    return f"an interactive page of {len(page) / 1e6:.1f} MB"


EXPORTS["page"] = Export((".html",), _write, uses=("resolution", "sky"))

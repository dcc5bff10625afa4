"""A trained scene as one HTML file that loads nothing: bent rays in any browser with WebGL2, see docs/page.md."""

from __future__ import annotations

import base64
import io
from typing import Any

import torch
from jaxtyping import Float
from markupsafe import Markup
from PIL import Image
from torch import Tensor

from nerfro.cameras import Cameras
from nerfro.data.base import DataSource, Views
from nerfro.errors import NerfroError
from nerfro.files.images import to_8bit
from nerfro.files.templates import fill_template
from nerfro.paths import ASSETS_DIR
from nerfro.rendering import ColourSpace
from nerfro.viewing.baking import Baked, bake_sky, bake_surface, volume_arrays
from nerfro.viewing.trained_scene import TrainedScene
from nerfro.viewing.volume import UNSEEN, bake

_TEMPLATES = ASSETS_DIR / "_page"
_PHOTOGRAPHS = 24  # at most, evenly spread
_PHOTOGRAPH_SIDE = 256  # pixels of the longer side, at most
_SEARCH_RESOLUTION = 64  # of the grid on which a field without bounds is looked for
_SPLITS = ("test", "val", "train")  # of which the first that the data has gives the cameras


def page_of(scene: TrainedScene, resolution: int) -> str:
    """The page of a trained scene, the inside with `resolution` vertices along its longest side.

    Raises:
        NerfroError: the medium has no surface, or nothing says where the scene is.
    """
    split = page_split(scene.source)
    views = scene.views(split)
    parts = parts_of(scene, views.cameras, resolution, progress=True)
    return document(scene.name, frame_of(scene, views, split), parts)


def page_split(source: DataSource) -> str:
    """The split whose cameras a page shows."""
    return next((name for name in _SPLITS if name in source.splits), source.splits[0])


def parts_of(
    scene: TrainedScene, cameras: Cameras, resolution: int, surface: bool = True, progress: bool = False
) -> dict[str, Baked]:
    """All that a model may change: sky and inside, and the surface on demand."""
    renderer = scene.renderer
    parts = {"surface": bake_surface(renderer)} if surface else {}
    inside = bake(scene, resolution, volume_box(scene, cameras), progress, contracted_beyond(scene))
    return {
        **parts,
        "volume": volume_arrays(inside, renderer.scene.colour_space),
        "sky": bake_sky(renderer.scene.boundary, renderer.scene.device),
    }


def document(title: str, frame: dict[str, Any], parts: dict[str, Baked], live: bool = False) -> str:
    """The page of what was baked (`parts_of`), within its frame (`frame_of`); `live` asks its server for news."""
    scene = {**frame, **{name: part.facts for name, part in parts.items()}, "live": live}
    arrays = {name: uri for part in parts.values() for name, uri in part.packed().items()}

    def asset(name: str) -> Markup:
        return Markup((_TEMPLATES / name).read_text(encoding="utf-8"))

    return fill_template(_TEMPLATES / "page.html.jinja", title=title, scene=scene, arrays=arrays, asset=asset)


def frame_of(scene: TrainedScene, views: Views, split: str) -> dict[str, Any]:
    """All that does not change while a model learns: cameras, photographs, and where the scene is."""
    renderer, cameras = scene.renderer, views.cameras
    box = renderer.scene.medium.content_box.float().cpu()
    if not (box[1] > box[0]).all():
        box = volume_box(scene, cameras)
        if contracted_beyond(scene) is not None:  # what is seen sharply is half as wide as contracted space
            box = box.mean(0) + 0.5 * (box - box.mean(0))
    # Where light begins to be added up along a ray.
    near = float(cameras.near) if contracted_beyond(scene) is None else float(renderer.point_sampler.near)  # type: ignore[arg-type]
    return {
        "linear": renderer.scene.colour_space is ColourSpace.LINEAR,
        "reflection": renderer.path_sampler.branching.num_events > 0,
        "orbit": {
            "target": box.mean(0).tolist(),
            "radius": float((box[1] - box[0]).norm() / 2),
            "halfWidth": float((box[1] - box[0]).min() / 2),
            "up": upwards(cameras).tolist(),
            "near": near,
        },
        "cameras": [_camera(views, view, f"{split}_{view:03d}", near) for view in range(len(views))],
    }


def _camera(views: Views, view: int, name: str, near: float) -> dict[str, Any]:
    cameras, count = views.cameras, len(views)
    pose = cameras.camera_to_world[view].cpu()
    shown = count <= _PHOTOGRAPHS or view in {i * count // _PHOTOGRAPHS for i in range(_PHOTOGRAPHS)}
    return {
        "name": name,
        "eye": pose[:, 3].tolist(),
        "axes": pose[:, :3].T.flatten().tolist(),
        "focal": [float(cameras.fx[view]), float(cameras.fy[view])],
        "principal": [float(cameras.cx[view]), float(cameras.cy[view])],
        "size": [cameras.width, cameras.height],
        "near": near,
        "photograph": _photograph(views.images[view]) if shown else None,
    }


def _photograph(rgb: Float[Tensor, "H W 3"]) -> str:
    picture = Image.fromarray(to_8bit(rgb).cpu().numpy())
    picture.thumbnail((_PHOTOGRAPH_SIDE, _PHOTOGRAPH_SIDE))
    file = io.BytesIO()
    picture.save(file, "JPEG", quality=90)
    return "data:image/jpeg;base64," + base64.b64encode(file.getvalue()).decode()


def volume_box(scene: TrainedScene, cameras: Cameras) -> Float[Tensor, "2 3"]:
    """Bounds of what the field holds: those of its samples, or, where these know none, found among the cameras.

    Where space is contracted, they are those of the cube around contracted space.

    Raises:
        NerfroError: nothing says where to look.
    """
    box = getattr(scene.renderer.point_sampler, "box", None)
    if isinstance(box, Tensor):
        return box.float().cpu()
    eyes = cameras.camera_to_world[..., 3].float().cpu()
    middle, half = (eyes.amax(0) + eyes.amin(0)) / 2, float((eyes.amax(0) - eyes.amin(0)).max()) / 2
    if half == 0:
        raise NerfroError("nothing says where this scene is: its samples have no box, and all cameras one place")
    box = torch.stack([middle - half, middle + half])
    density = bake(scene, _SEARCH_RESOLUTION, box, progress=False).density
    cell = 2 * half / (_SEARCH_RESOLUTION - 1)
    held = (density * cell > UNSEEN).nonzero()
    if not len(held):
        return box
    corners = box[0] + cell * torch.stack([held.amin(0) - 1, held.amax(0) + 1])
    return torch.maximum(torch.minimum(corners, box[1]), box[0])


def contracted_beyond(scene: TrainedScene) -> float | None:
    """Radius of the ball that samples see as it is, where they lie in all of space; None where they are in a box."""
    radius: float | None = getattr(scene.renderer.point_sampler, "radius", None)
    return radius


def upwards(cameras: Cameras) -> Float[Tensor, "3"]:
    """The direction that is up for most cameras, an axis of the world where one is near."""
    mean = cameras.camera_to_world[:, :, 1].double().mean(0).cpu()
    if float(mean.norm()) < 0.1:  # they look from everywhere
        return torch.tensor([0.0, 0.0, 1.0])
    up = mean / mean.norm()
    axis = int(up.abs().argmax())
    return (torch.eye(3)[axis] * up[axis].sign()).float() if up[axis].abs() > 0.9 else up.float()

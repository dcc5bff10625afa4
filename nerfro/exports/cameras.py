"""Export of the training cameras, as trained, with points of the scene: COLMAP model, and transforms of nerfstudio."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import scipy
import torch
from jaxtyping import Float, UInt8

from nerfro.core.cameras import Cameras
from nerfro.core.errors import NerfroError
from nerfro.core.paths import relative_path
from nerfro.exports.meshes import colours_of, glass_meshes, inside_mesh
from nerfro.files.atomic import write_atomically, write_json
from nerfro.viewing.camera_paths import transforms_document
from nerfro.viewing.exports import EXPORTS, Export, ExportConfig
from nerfro.viewing.trained_scene import TrainedScene

Points = tuple[Float[np.ndarray, "N 3"], UInt8[np.ndarray, "N 3"]]
_MAX_POINTS = 50_000


def write_colmap(scene: TrainedScene, out: Path, options: ExportConfig) -> str:
    """Write cameras, images and points3D as text files of COLMAP to `sparse/0`, with one camera per image."""
    cameras, images = _training_cameras(scene)
    model = out / "sparse" / "0"
    names = [f"{image.stem}.png" if root is None else relative_path(image, root) for image, root in images]
    lenses = [_colmap_lens(cameras, view) for view in range(len(cameras))]
    _write_lines(model / "cameras.txt", [f"{i} {lens}" for i, lens in enumerate(lenses, 1)])
    rotations, centres = _poses(scene, cameras)
    # COLMAP stores world-to-camera poses with axes right, down and forward, and the scalar part of quaternions first.
    inverse = scipy.spatial.transform.Rotation.from_matrix(rotations * [1.0, -1.0, -1.0]).inv()
    quaternions, shifts = inverse.as_quat()[:, [3, 0, 1, 2]], -inverse.apply(centres)
    poses = [" ".join(map(repr, pose)) for pose in np.hstack([quaternions, shifts]).tolist()]
    # The second line of an image has its features.
    _write_lines(
        model / "images.txt",
        [f"{i} {pose} {i} {name}\n" for i, (pose, name) in enumerate(zip(poses, names, strict=True), 1)],
    )
    positions, colours = _points(scene, options)
    rows = zip(positions.tolist(), colours.tolist(), strict=True)
    _write_lines(
        model / "points3D.txt",
        [f"{i} {' '.join(map(repr, point))} {' '.join(map(str, rgb))} 0" for i, (point, rgb) in enumerate(rows, 1)],
    )
    return f"{len(cameras)} cameras and {len(positions)} points as a COLMAP model, {model}"


def write_transforms(scene: TrainedScene, out: Path, options: ExportConfig) -> str:
    """Write `transforms.json` of nerfstudio and its points, `points.ply`."""
    cameras, images = _training_cameras(scene)
    names = [str(image) if root is None else relative_path(image, out) for image, root in images]
    document = transforms_document(cameras, names, scene.source.origin)
    write_json(out / "transforms.json", document | {"ply_file_path": "points.ply"})
    positions, colours = _points(scene, options)
    import trimesh

    cloud = trimesh.PointCloud(positions, colors=colours)
    write_atomically(out / "points.ply", cloud.export(file_type="ply"))
    return f"{len(cameras)} cameras and {len(positions)} points for nerfstudio"


def _training_cameras(scene: TrainedScene) -> tuple[Cameras, list[tuple[Path, Path | None]]]:
    """Return the cameras as trained, and photograph and folder of the data of each, or a name if these are unknown."""
    cameras = scene.cameras("train").to("cpu")
    views = scene.views("train") if scene.has_data else None
    if views is not None and views.frames:
        # Views that were held back from the training have no trained camera, and refined cameras have moved a little.
        of_data = views.cameras.to("cpu").camera_to_world
        frame = torch.cdist(cameras.camera_to_world.flatten(1), of_data.flatten(1)).argmin(1).tolist()
        if len({*frame}) == len(cameras):
            return cameras, [(views.frames[number].image, scene.source.root) for number in frame]
    return cameras, [(Path(f"train_{view:03d}.png"), None) for view in range(len(cameras))]


def _poses(scene: TrainedScene, cameras: Cameras) -> tuple[Float[np.ndarray, "V 3 3"], Float[np.ndarray, "V 3"]]:
    poses = cameras.camera_to_world.double().numpy()
    return poses[:, :, :3], poses[:, :, 3] + scene.source.origin


def _colmap_lens(cameras: Cameras, view: int) -> str:
    """Return model, image size and parameters of a camera."""
    numbers = [float(value[view]) for value in (cameras.fx, cameras.fy, cameras.cx, cameras.cy)]
    model = "PINHOLE"
    if cameras.distortion is not None and bool(cameras.distortion[view].any()):
        k1, k2, k3, highest, p1, p2, k4, k5, k6 = cameras.distortion[view].tolist()
        if highest != 0:
            raise NerfroError(f"COLMAP has no coefficient of r^8 ({highest} of view {view}); take what=cameras")
        model, numbers = "FULL_OPENCV", [*numbers, k1, k2, p1, p2, k3, k4, k5, k6]
    return " ".join([model, str(cameras.width), str(cameras.height), *map(repr, numbers)])


def _points(scene: TrainedScene, options: ExportConfig) -> Points:
    """Return points of the dense content with their colours, or of the glass if there is none; world units, sRGB."""
    inside = inside_mesh(scene, options.resolution, options.half_depth)
    if inside is not None:
        positions, colours = np.asarray(inside.vertices), colours_of(inside)
    else:
        positions = np.concatenate([np.zeros((0, 3)), *(mesh.vertices for mesh in glass_meshes(scene))])
        colours = np.full(positions.shape, 128, np.uint8)
    if len(positions) > _MAX_POINTS:
        selected = np.random.default_rng(0).choice(len(positions), _MAX_POINTS, replace=False)
        positions, colours = positions[selected], colours[selected]
    return np.asarray(positions, np.float64) + scene.source.origin, colours


def _write_lines(file: Path, lines: list[str]) -> None:
    write_atomically(file, "\n".join(lines) + "\n")


EXPORTS["colmap"] = Export(("",), write_colmap, uses=("resolution", "half_depth"))
EXPORTS["cameras"] = Export(("",), write_transforms, uses=("resolution", "half_depth"))

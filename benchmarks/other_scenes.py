"""Render two data sets of assets that other people modelled: a glass of water with a straw, and a cake in amber.

    python benchmarks/other_scenes.py straw glass_with_straw.glb vestibule_1k.hdr DIR
    python benchmarks/other_scenes.py amber glass_with_straw.glb noon_grass_1k.hdr DIR

The objects are from `demos/caustics` of https://github.com/pmndrs/examples (CC-BY-4.0), and the panoramas from
https://polyhaven.com (CC0). DIR becomes a data set of the format `blender` with a mesh for each body. Each view is the
mean of two renderings; their difference gives the noise of the test views, which `meta.json` states.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import trimesh
from skimage import data, transform
from trimesh.intersections import slice_faces_plane

from nerfro.core.light import to_srgb
from nerfro.core.progress import track
from nerfro.files.atomic import write_json
from nerfro.geometry.gltf import Z_UP_TO_Y_UP
from nerfro.synthetic.dataset import look_at_origin, write_image
from nerfro.synthetic.gltf_scene import GltfScene
from nerfro.synthetic.path_tracer import PathTracer, Pinhole
from nerfro.synthetic.scene import Panel, Part, Sky, SurfaceMesh, SyntheticScene, join
from nerfro.synthetic.synthesis import load_sky

GLASS, WATER, AMBER = 1.5, 1.33, 1.55
ABSORPTION = (0.15, 0.5, 1.4)  # of the amber, per world unit
SCALE, MIDDLE = 1.25, 0.7  # world units per unit of the file, and height of the origin in the file
LEVEL, CUT = 0.8, 1.3  # heights of the water and of the upper end of the amber in the file
GROUND, GAP = -SCALE * MIDDLE, 0.004  # lowest point of the glass, and its distance from the floor, world units
FLOOR_TILES, TILE, TEXELS = 4, 3.0, 160  # tiles of the floor in a row; side of a tile; texels per world unit
PICTURE = 144  # side of a picture on the mat, texels
MEDIAN, BRIGHTEST = 0.3, 4.0  # radiance of the panoramas after scaling and clipping
ANGLE, DISTANCE = 0.7, 4.0  # width of the images in radians, and distance of the cameras
SPLITS = "train", "val", "test"
COVERAGE = [((k + 0.5) / 36, (k * 0.618034) % 1) for k in range(36)]  # points in a pixel


@dataclass(frozen=True)
class AssetScene:
    """A scene of the assets.

    Attributes:
        parts: interfaces of two media, and opaque contents, for rendering.
        bodies: closed bodies, for training; the last body at a point decides.
        panels: the floor, if there is one.
        heights: sines of the lowest and the highest elevation of the cameras.
    """

    parts: tuple[Part, ...]
    bodies: tuple[Part, ...]
    panels: tuple[Panel, ...] = ()
    heights: tuple[float, float] = (-0.98, 0.98)


def straw(assets: dict[str, Part]) -> AssetScene:
    """Model a straw in a glass of water on a floor, beside another straw and a bouquet."""
    place = SCALE, (0.0, 0.0, GROUND)
    upper, outer, inner = divide(move(assets["glass"], *place).surface, SCALE * (LEVEL - MIDDLE))
    water = turn_inside_out(inner)
    level = lid(water)
    parts = [
        Part("dry", join([upper, outer]), GLASS),
        Part("wet", inner, GLASS, outer_ior=WATER),
        Part("level", level, WATER),
        *(move(assets[name], *place) for name in ("straw", "straw_2", "straw_001", "straw_001_2")),
        move(assets["flowers"], 0.6, (1.75, -1.9, GROUND)),
    ]
    bodies = Part("glass", join([upper, outer, inner]), GLASS), Part("water", join([water, level]), WATER)
    return AssetScene(tuple(parts), bodies, (floor(),), tuple(np.sin(np.radians([4.0, 70.0]))))


def amber(assets: dict[str, Part]) -> AssetScene:
    """Model a cake in amber, which has the outer surface of the glass."""
    _, outer, _ = divide(move(assets["glass"], SCALE, (0.0, 0.0, GROUND)).surface, SCALE * (CUT - MIDDLE))
    solid = Part("amber", join([outer, lid(outer)]), AMBER, ABSORPTION)
    cake = move(assets["cake"], 0.75, (0.0, 0.0, 0.0), Z_UP_TO_Y_UP)
    corners = np.stack([cake.surface.vertices.min(0), cake.surface.vertices.max(0)])
    cake = replace(move(cake, 1.0, [0.0, 0.0, 0.15] - corners.mean(0)), outer_absorption=ABSORPTION)
    return AssetScene((solid, cake), (solid,))


SCENES: dict[str, Callable[[dict[str, Part]], AssetScene]] = {"straw": straw, "amber": amber}


def move(part: Part, scale: float, shift: Sequence[float] | np.ndarray, rotation: np.ndarray | None = None) -> Part:
    """Turn a part by a matrix [3, 3], scale it, and move it."""
    turn, surface = np.eye(3) if rotation is None else rotation, part.surface
    vertices = (scale * surface.vertices @ turn.T + shift).astype(np.float32)
    normals = (surface.normals @ turn.T).astype(np.float32)
    return replace(part, surface=replace(surface, vertices=vertices, normals=normals))


def divide(vessel: SurfaceMesh, height: float) -> list[SurfaceMesh]:
    """Smooth a vessel and divide it below its rim: all above `height`, and the outer and the inner surface below."""
    smooth = trimesh.Trimesh(vessel.vertices, vessel.faces).subdivide_loop(2)
    halves = [slice_faces_plane(smooth.vertices, smooth.faces, [0, 0, side], [0, 0, height])[:2] for side in (1, -1)]
    cut = trimesh.util.concatenate([trimesh.Trimesh(*half) for half in halves])
    cut.merge_vertices(digits_vertex=6)
    cut.update_faces(cut.nondegenerate_faces())
    above = cut.triangles_center[:, 2] > height
    beside = cut.face_adjacency[~above[cut.face_adjacency].any(1)]
    outer, inner = sorted(
        trimesh.graph.connected_components(beside, nodes=np.flatnonzero(~above)),
        key=lambda group: cut.triangles[group][..., 2].min(),
    )
    vertices, normals = cut.vertices.astype(np.float32), cut.vertex_normals.astype(np.float32)
    return [SurfaceMesh(vertices, cut.faces[group].astype(np.int32), normals) for group in (above, outer, inner)]


def turn_inside_out(surface: SurfaceMesh) -> SurfaceMesh:
    return replace(surface, faces=surface.faces[:, ::-1].copy(), normals=-surface.normals)


def lid(surface: SurfaceMesh) -> SurfaceMesh:
    """Return the flat upper side of a surface that faces outwards and ends in one horizontal edge."""
    edges = np.concatenate([surface.faces[:, [k, (k + 1) % 3]] for k in range(3)])
    edge = edges[trimesh.grouping.group_rows(np.sort(edges, axis=1), require_count=1)]
    ring = surface.vertices[edge[:, ::-1]]
    centre = np.broadcast_to(ring.mean((0, 1)), (len(ring), 1, 3))
    vertices = np.concatenate([ring, centre], axis=1, dtype=np.float32).reshape(-1, 3)
    upwards = np.tile(np.array([0.0, 0.0, 1.0], np.float32), (len(vertices), 1))
    return SurfaceMesh(vertices, np.arange(len(vertices), dtype=np.int32).reshape(-1, 3), upwards)


def floor() -> Panel:
    """Return gravel, and a mat of photographs under the glass."""
    gravel = transform.resize(data.gravel(), (round(TILE * TEXELS),) * 2)
    image = np.tile(gravel, (FLOOR_TILES, FLOOR_TILES))[..., None] * np.array([0.85, 0.7, 0.5])
    photographs = data.coffee()[:, 100:500], data.rocket()[:, 110:537]
    pair = [transform.resize(photograph, (PICTURE, PICTURE)) for photograph in photographs]
    mat = np.block([[[pair[(row + column) % 2]] for column in range(4)] for row in range(4)])
    start = (len(image) - len(mat)) // 2
    image[start : start + len(mat), start : start + len(mat)] = mat
    side = FLOOR_TILES * TILE
    corner = np.array([-0.5 * side, 0.5 * side, GROUND - GAP])
    return Panel(corner, np.array([side, 0.0, 0.0]), np.array([0.0, -side, 0.0]), image.astype(np.float32))


def scaled_sky(panorama: Path) -> Sky:
    """Return the radiance of a panorama, scaled to a common median and clipped."""
    sky = load_sky(panorama)
    gain = MEDIAN / np.median(sky(trimesh.creation.icosphere(subdivisions=4).vertices))
    return lambda directions: np.minimum(gain * sky(directions), BRIGHTEST)


def poses(count: int, seed: int, low: float, high: float) -> list[np.ndarray]:
    """Return well-spread poses [4, 4] of cameras that look at the origin, with sines of elevation in a range."""
    random = np.random.default_rng(seed)
    height = low + (high - low) * (np.arange(count) + random.random(count)) / count
    azimuth = 2 * np.pi * (random.random() + 0.618034 * np.arange(count))
    across = np.sqrt(1 - height**2)
    directions = np.stack([across * np.cos(azimuth), across * np.sin(azimuth), height], -1)
    return [look_at_origin(DISTANCE * direction) for direction in directions]


def coverage(tracer: PathTracer, pose: np.ndarray) -> np.ndarray:
    """Return the fraction [H, W] of each pixel that shows a refractive surface; opaque objects hide it."""
    mi, camera = tracer.mitsuba, tracer.camera
    total, (rows, columns) = np.zeros((camera.height, camera.width)), np.mgrid[: camera.height, : camera.width]
    for x, y in COVERAGE:
        local = np.stack([columns + x - camera.cx, camera.cy - rows - y, np.full(rows.shape, -camera.focal)], -1)
        directions = local.reshape(-1, 3) @ pose[:3, :3].T
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        origin = mi.Point3f(*(mi.Float(np.full(len(directions), value)) for value in pose[:3, 3]))
        ray = mi.Ray3f(origin, mi.Vector3f(*(mi.Float(values) for values in directions.T)))
        glass, nearest = (np.asarray(scene.ray_intersect_preliminary(ray).t) for scene in (tracer.glass, tracer.scene))
        total += (np.isfinite(glass) & (glass < nearest + 1e-4)).reshape(total.shape)
    return total / len(COVERAGE)


def render(options: argparse.Namespace) -> None:
    """Render a data set."""
    folder, camera, noise = options.folder, Pinhole.square(ANGLE, options.width), []
    scene, nothing = SCENES[options.scene]({part.name: part for part in GltfScene(options.assets).parts}), join([])
    rendered = SyntheticScene(GLASS, nothing, nothing, scaled_sky(options.panorama), scene.panels, parts=scene.parts)
    tracer = PathTracer(rendered, True, camera)
    for number, (split, count, spp) in enumerate(zip(SPLITS, options.views, options.spp, strict=True)):
        frames = []
        for view, pose in enumerate(track(split, poses(count, number, *scene.heights))):
            halves = [tracer.render(pose, spp // 2, 1000 * number + 2 * view + half) for half in (0, 1)]
            first, second, mean = (np.clip(to_srgb(image), 0, 1) for image in (*halves, np.mean(halves, axis=0)))
            noise += [np.square(first - second).mean() / 4] if split == "test" else []
            image, mask = f"{split}/r_{view:03d}", f"{split}_mask/r_{view:03d}.png"
            write_image(folder / f"{image}.png", mean)
            write_image(folder / mask, coverage(tracer, pose))
            frames.append({"file_path": f"./{image}", "mask_path": f"./{mask}", "transform_matrix": pose.tolist()})
        lens = {"camera_angle_x": camera.angle_x, "w": camera.width, "h": camera.height}
        write_json(folder / f"transforms_{split}.json", {**lens, "frames": frames})
    for body in scene.bodies:
        body.surface.save(folder / f"{body.name}.ply")
    meta = {
        "scene": options.scene,
        "bodies": {body.name: {"ior": body.ior, "absorption": body.absorption} for body in scene.bodies},
        "panorama": f"{options.panorama.name}, median radiance {MEDIAN}, clipped at {BRIGHTEST}",
        "views": {
            split: {"number": n, "spp": spp} for split, n, spp in zip(SPLITS, options.views, options.spp, strict=True)
        },
        "noise_floor_test_psnr": round(float(-10 * np.log10(np.mean(noise))), 2),
    }
    write_json(folder / "meta.json", meta)


def main() -> None:
    """Render the data set that the command line names."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", choices=list(SCENES))
    parser.add_argument("assets", type=Path, help="glass_with_straw.glb")
    parser.add_argument("panorama", type=Path, help="lat-long image (.hdr, .exr)")
    parser.add_argument("folder", type=Path, help="folder of the data set")
    parser.add_argument("--width", type=int, default=160, help="pixels")
    parser.add_argument("--views", type=int, nargs=3, default=[60, 3, 12], help="for training, validation and test")
    parser.add_argument("--spp", type=int, nargs=3, default=[64, 64, 256], help="samples per pixel of these")
    render(parser.parse_args())


if __name__ == "__main__":
    main()

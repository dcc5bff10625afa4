"""Simulated captures of glassware in a cluttered room, held by hand, as photographs and as a video of a telephone.

    python benchmarks/glassware.py wine CAPTURE
    python -m nerfro.reconstruct video=CAPTURE/film.mp4 outlines=CAPTURE/outlines.json out=DIR
    python benchmarks/glassware.py wine CAPTURE --reconstruction DIR

The first command renders the capture. Each photograph is in the video once, and two frames with motion blur follow or
precede it. `outlines.json` has polygons in three frames, simplified from the true masks. The last command prints a row
with the scores of the reconstruction.
"""

from __future__ import annotations

import argparse
import itertools
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from capture import measure
from omegaconf import OmegaConf
from PIL import Image
from scipy.interpolate import PchipInterpolator
from skimage.measure import approximate_polygon, find_contours

from nerfro.core.light import to_srgb
from nerfro.core.progress import track
from nerfro.evaluation.results import FULL, read_metrics_json
from nerfro.poses.opencv import opencv
from nerfro.synthetic.dataset import PlannedImage, write_image
from nerfro.synthetic.path_tracer import PathTracer, Pinhole, panel_shape, triangle_shape
from nerfro.synthetic.scene import Panel, join
from nerfro.synthetic.scene import SurfaceMesh as Surface
from nerfro.synthetic.scene import SyntheticScene as Scene
from nerfro.synthetic.scenes import distance, patterns, photographs
from nerfro.synthetic.scenes import dolphin_capture as dolphin
from nerfro.viewing.film import write_film

GLASS, WATER = 1.5, 1.333
WALL = 0.018
STANDING = 0.005  # height of the lowest point above the table
DISTANCE, ELEVATIONS, LAPS = 3.4, (12.0, 52.0), 2
# Radial distortion k1 and k2, and the additional field of view that it needs (fraction of the width).
LENS, MARGIN = (-0.06, 0.02), 0.04
EXPOSURE, NOISE, QUALITY = 0.12, 0.008, 92  # standard deviations of log exposure and of sRGB noise; quality of JPEG
BLURRED, LARGEST_BLUR = 2, 7.0  # frames with motion blur beside each sharp frame; length of the blur, pixels
FRAMES_PER_SECOND = 30
OUTLINED = (0.05, 0.3, 0.7)  # places of the outlined photographs in the sequence
LAMP = {"type": "area", "radiance": {"type": "rgb", "value": 8.0}}

Outline = np.ndarray
Colour = Callable[[np.ndarray], np.ndarray]


@dataclass(frozen=True)
class Part:
    """A surface of revolution: the interface of two media, or an opaque surface.

    Attributes:
        outline: points (radius, height), with the outside to the right of the direction of travel.
        inside, outside: refractive indices.
        colour: sRGB of points [..., 3] of an opaque surface, or None.
    """

    outline: Outline
    inside: float = GLASS
    outside: float = 1.0
    colour: Colour | None = None

    def surface(self, sections: int = 256) -> Surface:
        """Mesh the surface, standing on the table."""
        (radius, height), angle = self.outline.T, 2 * np.pi * np.arange(sections) / sections
        along = np.gradient(self.outline, axis=0)
        along /= np.linalg.norm(along, axis=1, keepdims=True)
        around = np.stack([np.cos(angle), np.sin(angle)], -1)[:, None]
        vertices = np.concatenate(
            [around * radius[:, None], np.broadcast_to(height[:, None], (sections, *height.shape, 1))], -1
        )
        normals = np.concatenate(
            [around * along[:, 1:], np.broadcast_to(-along[:, :1], (sections, *height.shape, 1))], -1
        )
        index = np.arange(vertices.shape[0] * vertices.shape[1]).reshape(vertices.shape[:2])
        here, later = index, np.roll(index, -1, 0)
        quads = np.stack([here[:, :-1], later[:, :-1], later[:, 1:], here[:, 1:]], -1).reshape(-1, 4)
        faces = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
        points = vertices.reshape(-1, 3) + np.array([0.0, 0.0, STANDING])
        colours = None if self.colour is None else np.clip(self.colour(points), 0.0, 1.0).astype(np.float32)
        return Surface(
            points.astype(np.float32), faces.astype(np.int32), normals.reshape(-1, 3).astype(np.float32), colours
        )

    def material(self) -> dict[str, Any]:
        """Return the material of Mitsuba."""
        if self.colour is None:
            return {"type": "dielectric", "int_ior": self.inside, "ext_ior": self.outside}
        paint = {"type": "mesh_attribute", "name": "vertex_color"}
        return {"type": "principled", "base_color": paint, "roughness": 0.2}


def smooth(points: Sequence[tuple[float, float]], num: int = 300) -> Outline:
    """Interpolate an outline monotonically."""
    corners = np.asarray(points, float)
    length = np.r_[0, np.cumsum(np.linalg.norm(np.diff(corners, axis=0), axis=1))]
    return PchipInterpolator(length, corners)(np.linspace(0, length[-1], num))


def vessel(outer: Sequence[tuple[float, float]], inner: Sequence[tuple[float, float]]) -> tuple[Outline, Outline]:
    """Return the outline of the dry outer surface with the rim, and of the inner surface from the rim to the axis."""
    (edge, top), start = outer[-1], inner[0]
    rim = smooth([(edge, top), (0.5 * (edge + start[0]), top + 0.5 * (edge - start[0])), start], 12)
    return np.r_[smooth(outer), rim[1:]], smooth(inner)


def divide(inner: Outline, level: float) -> tuple[Outline, Outline]:
    """Divide the outline of an inner surface at a height: the part above and the part below."""
    below = int(np.argmax(inner[:, 1] < level))
    crossing = [[np.interp(level, inner[below - 1 : below + 1, 1][::-1], inner[below - 1 : below + 1, 0][::-1]), level]]
    return np.r_[inner[:below], crossing], np.r_[crossing, inner[below:]]


def wine() -> list[Part]:
    """Return an empty wine glass without a stem."""
    outer = [(0.0, 0.0), (0.26, 0.0), (0.34, 0.03), (0.45, 0.2), (0.5, 0.42), (0.49, 0.65), (0.43, 0.9), (0.38, 1.1)]
    upper = [(radius - WALL, height) for radius, height in outer[:3:-1]]
    above, inside = vessel(outer, [*upper, (0.44 - WALL, 0.22), (0.28, 0.11), (0.15, 0.08), (0.0, 0.08)])
    return [Part(np.r_[above, inside[1:]])]


def goblet() -> list[Part]:
    """Return an empty wine glass with a bowl, a thin stem and a flat foot."""
    wall = 0.014
    outer = [
        (0.0, 0.0),
        (0.335, 0.0),
        (0.35, 0.012),
        (0.335, 0.03),
        (0.2, 0.045),
        (0.09, 0.08),
        (0.05, 0.15),
        (0.045, 0.25),
        (0.045, 0.43),
        (0.055, 0.5),
        (0.13, 0.56),
        (0.28, 0.65),
        (0.37, 0.76),
        (0.4, 0.9),
        (0.385, 1.08),
        (0.33, 1.3),
    ]
    upper = [(radius - wall, height) for radius, height in outer[:11:-1]]
    above, inside = vessel(outer, [*upper, (0.27, 0.665), (0.13, 0.59), (0.06, 0.57), (0.0, 0.565)])
    return [Part(np.r_[above, inside[1:]])]


def tumbler() -> list[Part]:
    """Return a tumbler that is half full of water."""
    outer = [(0.0, 0.0), (0.34, 0.0), (0.36, 0.02), (0.38, 0.3), (0.41, 0.7), (0.43, 1.0)]
    upper = [(radius - WALL, height) for radius, height in outer[:2:-1]]
    above, inside = vessel(outer, [*upper, (0.36 - WALL, 0.13), (0.2, 0.1), (0.0, 0.1)])
    dry, wet = divide(inside, 0.55)
    surface = np.linspace(wet[0], [0.0, 0.55], 20)
    return [Part(np.r_[above, dry[1:]]), Part(wet, GLASS, WATER), Part(surface, WATER, 1.0)]


def jar() -> list[Part]:
    """Return a jar, half full of jam, with a lid."""
    outer = [(0.0, 0.0), (0.33, 0.0), (0.38, 0.04), (0.4, 0.2), (0.4, 0.6), (0.33, 0.76), (0.33, 0.88)]
    upper = [(radius - 1.5 * WALL, height) for radius, height in outer[:2:-1]]
    above, inside = vessel(outer, [*upper, (0.34, 0.08), (0.2, 0.05), (0.0, 0.05)])
    dry, wet = divide(inside, 0.5)
    jam = np.r_[wet[::-1], np.linspace(wet[0], [0.0, 0.5], 40)[1:]]
    corners = np.array([[0.0, 0.905], [0.345, 0.905], [0.345, 0.79], [0.375, 0.79], [0.375, 0.95], [0.0, 0.95]])
    sides = [np.linspace(*pair, 24, endpoint=False) for pair in itertools.pairwise(corners)]
    lid = np.concatenate([*sides, corners[-1:]])

    def check(points: np.ndarray) -> np.ndarray:
        squares = np.floor(points[:, :2] / 0.08).sum(-1) % 2
        return np.where(squares[:, None] > 0, [0.8, 0.1, 0.12], [0.92, 0.9, 0.85])

    def fruit(points: np.ndarray) -> np.ndarray:
        return patterns.mix([0.35, 0.02, 0.05], [0.6, 0.12, 0.1], patterns.fractal_noise(12 * points, 3, seed=5))

    return [Part(np.r_[above, dry[1:]]), Part(jam, colour=fruit), Part(lid, colour=check)]


def bottle() -> list[Part]:
    """Return an opaque bottle with a label and a cap."""
    body = [(0.0, 0.0), (0.28, 0.0), (0.3, 0.03), (0.3, 0.7), (0.24, 0.88), (0.11, 1.0), (0.1, 1.1)]
    cap = [(0.12, 1.105), (0.125, 1.12), (0.125, 1.25), (0.11, 1.27), (0.0, 1.27)]

    def colour(points: np.ndarray) -> np.ndarray:
        green = patterns.mix([0.05, 0.2, 0.1], [0.1, 0.32, 0.16], patterns.fractal_noise(20 * points, 2, seed=6))
        turn = np.arctan2(points[:, 1], points[:, 0]) * 0.3
        print_ = mosaic(np.stack([turn, points[:, 2], 0 * turn], -1), 0.09, seed=7)
        label = (points[:, 2] > 0.18) & (points[:, 2] < 0.6)
        painted = np.where(label[:, None], print_, green)
        return np.where((points[:, 2] > 1.1)[:, None], [0.75, 0.6, 0.2], painted)

    return [Part(np.r_[smooth(body), smooth(cap, 120)], colour=colour)]


def outer_surface(parts: Sequence[Part], num: int = 600) -> Surface:
    """Return the closed surface of the largest radii of all parts."""
    height = np.linspace(0.0, max(part.outline[:, 1].max() for part in parts), num)
    radius = np.zeros(num)
    for (start, low), (end, high) in (pair for part in parts for pair in itertools.pairwise(part.outline)):
        place = (height - low) / (high - low) if high != low else np.full(num, np.nan)
        radius = np.fmax(radius, np.where((place >= 0) & (place <= 1), start + place * (end - start), 0.0))
    outline = np.column_stack([np.pad(radius, 1), np.pad(height + STANDING, 1, "edge")])
    mesh = trimesh.creation.revolve(outline, sections=256)
    return Surface(
        mesh.vertices.astype(np.float32), mesh.faces.astype(np.int32), mesh.vertex_normals.astype(np.float32)
    )


KINDS = {function.__name__: function for function in (wine, goblet, tumbler, jar, bottle)}


def mosaic(points: np.ndarray, size: float, seed: int) -> np.ndarray:
    """Return sRGB [..., 3] of patches in two sizes whose colours never repeat."""
    coarse, fine = (np.floor(points / cell).astype(int) for cell in (size, size / 3))
    shade = 0.7 + 0.3 * patterns.hashed(fine, seed)[..., None]
    colours = 0.2 + 0.7 * np.stack([patterns.hashed(coarse, seed + channel) for channel in (1, 2, 3)], -1)
    spots = np.broadcast_to(patterns.hashed(fine, seed + 4)[..., None], colours.shape)
    return np.where(patterns.hashed(fine, seed + 5)[..., None] < 0.75, shade * colours, spots)


def furniture(spacing: float) -> tuple[list[Panel], Surface]:
    """Return the room, a table with magazines, posters on the walls, and balls and boxes on the table.

    Args:
        spacing: distance between pixels of the walls, world units.
    """
    random = np.random.default_rng(11)
    panels = [*dolphin.room_panels(spacing), dolphin.wooden(2.7, 0.0, (0.62, 0.42, 0.28), 41)]

    def sheet(centre: np.ndarray, right: np.ndarray, down: np.ndarray, size: float, glows: bool) -> Panel:
        seed = int(random.integers(1 << 20))
        return dolphin.painted_panel(
            centre - 0.5 * (right + down), right, down, lambda points: mosaic(points, size, seed), size / 6, glows
        )

    for number in range(14):  # magazines, one above the other where they overlap
        turn, reach, direction = random.uniform([0, 0.7, 0], [6.28, 2.2, 6.28])
        right = 0.8 * np.array([np.cos(turn), np.sin(turn), 0.0])
        centre = np.array([reach * np.cos(direction), reach * np.sin(direction), 0.003 + 0.002 * number])
        panels.append(sheet(centre, right, 0.7 * np.array([right[1], -right[0], 0.0]), 0.12, glows=False))
    low, high = (
        dolphin.ROOM_CENTRE + dolphin.ROOM_SCALE * corner
        for corner in (dolphin.starlamp.ROOM_LOW, dolphin.starlamp.ROOM_HIGH)
    )
    for number in range(24):  # posters
        axis, side = number % 2, number // 2 % 2
        centre = random.uniform(low + 1.2, high - 1.2)
        centre[axis] = (low if side == 0 else high)[axis] + (0.05 if side == 0 else -0.05)
        right = np.zeros(3)
        right[1 - axis] = 1.7 * (1 if (axis == 0) == (side == 0) else -1)
        panels.append(sheet(centre, right, np.array([0.0, 0.0, -1.3]), 0.3, glows=True))

    def painted_solid(solid: Callable[[np.ndarray], np.ndarray], centre: np.ndarray, size: float, seed: int) -> Surface:
        return distance.painted(solid, lambda p: mosaic(p, 0.12, seed), centre - size, centre + size, 0.02)

    solids = []
    for number, (x, y, size) in enumerate([(1.2, 0.7, 0.28), (-0.9, 1.2, 0.2), (-1.2, -0.9, 0.3), (0.7, -1.4, 0.2)]):
        centre, half = np.array([x, y, size + 0.04]), np.array([size, 0.6 * size, size])
        solid = (
            (lambda p, c=centre, h=half: distance.block(p, c, h, 0.02))
            if number % 2
            else (lambda p, c=centre, s=size: distance.ball(p, c, s))
        )
        solids.append(painted_solid(solid, centre, size + 0.03, 100 * number))
    return panels, join(solids)


def render(kind: str, folder: Path, count: int, width: int, spp: int) -> None:
    """Render the capture; existing photographs are kept."""
    parts = KINDS[kind]()
    surfaces = [part.surface() for part in parts]
    whole = outer_surface(parts)
    panels, clutter = furniture(10 / width)
    aim = np.array([0.0, 0.0, 0.45 * whole.vertices[:, 2].max()])
    scene = Scene(GLASS, whole, clutter, None, tuple(panels), aim=aim)
    data = photographs.Photographs(OmegaConf.create({"resolution": width}), scene, folder)
    camera, margin = data.camera, round(MARGIN * width)
    wide = Pinhole(
        camera.width + 2 * margin, camera.height + 2 * margin, camera.focal, camera.cx + margin, camera.cy + margin
    )
    tracer = PathTracer(scene, True, wide)
    mi = tracer.mitsuba
    paint = {"type": "diffuse", "reflectance": {"type": "mesh_attribute", "name": "vertex_color"}}
    tracer.scene = mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "path", "max_depth": 64, "rr_depth": 16},
            "lamp": {"type": "sphere", "center": [2.0, -1.5, 4.2], "radius": 0.6, "emitter": LAMP},
            **{f"panel_{number}": panel_shape(mi, panel) for number, panel in enumerate(panels)},
            **{
                f"part_{number}": triangle_shape(mi, f"part_{number}", surface, part.material())
                for number, (part, surface) in enumerate(zip(parts, surfaces, strict=True))
            },
            "clutter": triangle_shape(mi, "clutter", clutter, paint),
        }
    )
    poses = photographs.hand_held(count, 3, aim, DISTANCE, ELEVATIONS, LAPS)
    lens, planned, film = Lens(camera, margin), [], []
    for number, pose in enumerate(track("render", poses)):
        random = np.random.default_rng([3, number])
        sharp = number * (BLURRED + 1) + int(random.integers(BLURRED + 1))
        image, mask = f"images/frame_{sharp:05d}.jpg", f"masks/frame_{sharp:05d}.png"
        gain = np.exp(EXPOSURE * random.normal())
        if not (folder / image).is_file():
            write_image(folder / mask, lens.distort(tracer.silhouette(pose)) >= 0.5)
            radiance = lens.distort(np.clip(tracer.render(pose, spp, number), 0.0, 4.0))
            grain = NOISE * random.normal(size=radiance.shape)
            seen = to_srgb(np.clip(gain * radiance, 0.0, 1.0)) + grain
            (folder / "images").mkdir(parents=True, exist_ok=True)
            levels = np.rint(np.clip(seen, 0.0, 1.0) * 255).astype(np.uint8)
            Image.fromarray(levels).save(folder / image, quality=QUALITY)
        planned.append(PlannedImage(image, mask, pose, spp, number))
        film += _frames(folder, image, sharp % (BLURRED + 1), number * (BLURRED + 1), random)
    (folder / "truth").mkdir(exist_ok=True)
    data.finish(planned)
    write_film(folder / "film.mp4", film, len(film) / FRAMES_PER_SECOND)
    outlined = [planned[int(place * count)] for place in OUTLINED]
    polygons = {Path(one.image_path).stem: _polygon(folder / one.mask_path) for one in outlined}
    (folder / "outlines.json").write_text(json.dumps(polygons))


class Lens:
    """Radial distortion of a rendered image that is larger by a margin."""

    def __init__(self, camera: Pinhole, margin: int) -> None:
        matrix = np.array([[camera.focal, 0, camera.cx - 0.5], [0, camera.focal, camera.cy - 0.5], [0, 0, 1]])
        pixels = np.stack(np.meshgrid(np.arange(camera.width), np.arange(camera.height)), -1).astype(np.float64)
        straight = opencv().undistortPoints(pixels.reshape(-1, 1, 2), matrix, np.array([*LENS, 0.0, 0.0]), P=matrix)
        self._map = (straight.reshape(camera.height, camera.width, 2) + margin).astype(np.float32)

    def distort(self, image: np.ndarray) -> np.ndarray:
        """Return the image as the lens shows it."""
        return opencv().remap(image.astype(np.float32), self._map, None, opencv().INTER_CUBIC)


def _frames(folder: Path, image: str, sharp: int, first: int, random: np.random.Generator) -> list[Path]:
    """Write a sharp frame and its neighbours with motion blur as PNG files."""
    photograph, files = np.asarray(Image.open(folder / image)), []
    (folder / "film").mkdir(exist_ok=True)
    for place in range(BLURRED + 1):
        seen = photograph
        if place != sharp:
            turn, length = random.uniform(0, np.pi), random.uniform(0.4, 1.0) * LARGEST_BLUR
            kernel = np.zeros((9, 9))
            for step in np.linspace(-0.5, 0.5, 64) * length:
                kernel[round(4 + step * np.sin(turn)), round(4 + step * np.cos(turn))] += 1 / 64
            seen = opencv().filter2D(photograph, -1, kernel)
        files.append(folder / "film" / f"frame_{first + place:05d}.png")
        Image.fromarray(seen).save(files[-1])
    return files


def _polygon(mask: Path) -> list[list[float]]:
    """Return the outline of a mask as a polygon of (column, row) with errors below one pixel."""
    inside = np.pad(np.asarray(Image.open(mask), float), 1)
    outline = max(find_contours(inside, 0.5), key=len) - 0.5  # minus the padding, plus half a pixel
    return [[float(column), float(row)] for row, column in approximate_polygon(outline, 0.8)[:-1].round(1)]


def row_of(capture: Path, reconstruction: Path) -> str:
    """Return poses, masks and test scores of a reconstruction as a row of a table."""
    poses = measure(capture, reconstruction)
    overlaps = []
    for file in sorted(reconstruction.glob("images/mask_*.png")):
        found, true = (np.asarray(Image.open(path)) > 0 for path in (file, capture / "masks" / file.name[5:]))
        overlaps.append((found & true).sum() / (found | true).sum())
    result = read_metrics_json(reconstruction / "run" / "metrics.json").result
    values = [
        capture.name,
        f"{poses['photographs with a pose']}",
        f"{poses['rotation, median error in degrees']:.2f}°",
        f"{np.mean(overlaps):.3f}, {np.min(overlaps):.3f}",
        *("n/a" if (mean := result.mean("psnr", region)) is None else f"{mean:.2f}" for region in (FULL, "mask")),
    ]
    return f"| {' | '.join(values)} |"


def main() -> None:
    """Render a capture, or print the scores of a reconstruction."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("kind", choices=list(KINDS))
    parser.add_argument("capture", type=Path, help="folder of the capture")
    parser.add_argument("--photographs", type=int, default=60)
    parser.add_argument("--width", type=int, default=320, help="pixels")
    parser.add_argument("--spp", type=int, default=48, help="samples per pixel")
    parser.add_argument("--reconstruction", type=Path, help="output folder of nerfro.reconstruct")
    given = parser.parse_args()
    if given.reconstruction is not None:
        for file in (given.capture / "outlines.json", given.reconstruction / "run" / "metrics.json"):
            if not file.is_file():
                parser.error(f"{file} is missing; give a capture of this program and a finished reconstruction of it")
        print(
            "| capture | poses | rotation, median error | overlap of masks, mean and least | image, dB | object, dB |"
        )
        print(f"|---|---|---|---|---|---|\n{row_of(given.capture, given.reconstruction)}")
        return
    render(given.kind, given.capture, given.photographs, given.width, given.spp)


if __name__ == "__main__":
    main()

"""`dolphin_capture`: a dolphin in a globe of water on the paper's AprilTag board, on a table in a room.

The board lies on the table around the origin; the globe stands on the block in its middle.
"""

from __future__ import annotations

import functools
import itertools

import numpy as np

from nerfro.poses.boards import TagBoard, twelve_faces
from nerfro.synthetic.scene import Panel, SyntheticScene, Vector, join
from nerfro.synthetic.scenes import distance, starlamp
from nerfro.synthetic.scenes.distance import (
    Colour,
    ball,
    capsule,
    ellipsoid,
    mirrored,
    moved,
    painted,
    smooth_union,
)
from nerfro.synthetic.scenes.patterns import chosen, fractal_noise, hashed, mix, smoothstep
from nerfro.synthetic.scenes.photographs import Photographs

DATA_SET = Photographs

WATER = 1.33
GLOBE_RADIUS, GLOBE_FOOT, GLOBE_ROUNDING, GLOBE_SPACING = 0.62, 0.48, 0.06, 0.012  # foot: depth of the flat below
BOARD_SCALE = 4.0  # world units per board unit: the block is 1.08 high, the square 3.24 wide
BOARD_HEIGHT = 0.02  # of the printed sheets above the table
BLOCK_TOP = BOARD_SCALE * 0.27 + BOARD_HEIGHT
CENTRE = np.array([0.0, 0.0, BLOCK_TOP + GLOBE_FOOT + 0.01])  # of the globe; air below it, for it must not touch
ROOM_SCALE, ROOM_CENTRE = 4.4, np.array([0.0, 0.0, 1.7])
AIM = np.array([0.0, 0.0, 1.15])  # of the photographer

ARC_RADIUS, ARC_CENTRE = 0.40, np.array([0.02, 0.0, -0.24])  # the back's curve, in the plane y = 0
ARC_TAIL, ARC_NOSE = np.radians(152.0), np.radians(22.0)
# place along the arc (0 at the tail, 1 at the nose), radius
PROFILE = ((0, 0.022), (0.15, 0.042), (0.4, 0.092), (0.6, 0.105), (0.78, 0.09), (0.88, 0.066), (0.93, 0.03), (1, 0.018))
SEA_LEVEL, SEA_RADIUS = -0.25, 0.555


def along_arc(place: float) -> np.ndarray:
    """The point [3] of the dolphin's curve, from the globe's centre; 0 at the tail, 1 at the nose."""
    angle = ARC_TAIL + place * (ARC_NOSE - ARC_TAIL)
    return ARC_CENTRE + ARC_RADIUS * np.array([np.cos(angle), 0.0, np.sin(angle)])


def fin(points: np.ndarray, root: Vector, tip: Vector, widths: tuple[float, float], across: Vector) -> np.ndarray:
    """Bound on the distance to a capsule from `root` to `tip`, a quarter as thick along the unit vector `across`."""
    offset = points - np.asarray(root)
    stretched = offset + 3 * (offset @ np.asarray(across))[..., None] * np.asarray(across)
    return capsule(stretched, (0, 0, 0), np.asarray(tip) - np.asarray(root), *widths) / 4


def dolphin(points: np.ndarray) -> np.ndarray:
    """Bound on the distance to the leaping dolphin: a body along an arc, fins and flukes."""
    folded = mirrored(points)
    body = [
        capsule(points, along_arc(start), along_arc(end), first, second)
        for (start, first), (end, second) in itertools.pairwise(PROFILE)
    ]
    back, tail = along_arc(0.5), along_arc(0.0)
    outward = (back - ARC_CENTRE) / ARC_RADIUS
    behind = (tail - along_arc(0.08)) / np.linalg.norm(tail - along_arc(0.08))
    upright = np.cross([0.0, 1.0, 0.0], behind)
    flipper = along_arc(0.74) + np.array([0.0, 0.06, -0.04])
    sideways = np.array([-0.6, 0.6, -0.53]) / np.linalg.norm([-0.6, 0.6, -0.53])
    level = np.cross(sideways, [0.0, 0.75, 0.66])
    parts = [
        fin(points, back + 0.07 * outward, back + 0.18 * outward + [-0.07, 0, 0], (0.055, 0.012), (0.0, 1.0, 0.0)),
        fin(folded, tail, tail + 0.08 * behind + [0.0, 0.12, 0.0], (0.045, 0.015), upright),
        fin(folded, flipper, flipper + 0.17 * sideways, (0.045, 0.014), level / np.linalg.norm(level)),
        ellipsoid(folded, along_arc(0.86) + np.array([0.012, 0.048, 0.01]), (0.014, 0.014, 0.014)),
    ]
    return smooth_union(body + parts, 0.03)


def dolphin_colours(points: np.ndarray) -> np.ndarray:
    """Return sRGB [V, 3]: slate back with pale streaks, light belly, dark eyes."""
    offset = points - ARC_CENTRE
    outward = np.hypot(offset[:, 0], offset[:, 2]) - ARC_RADIUS
    angle = np.arctan2(offset[:, 2], offset[:, 0])
    wave = 0.02 * np.sin(14 * angle) + 0.04 * (fractal_noise(points * 16.0, 3, seed=21) - 0.5)
    grain = fractal_noise(points * np.array([30.0, 90.0, 30.0]), 3, seed=22)
    slate = mix(np.array([0.16, 0.24, 0.36]), np.array([0.36, 0.50, 0.66]), smoothstep(0.3, 0.7, grain))
    flank = mix(np.array([0.55, 0.66, 0.76]), np.array([0.75, 0.82, 0.88]), grain)
    colours = mix(flank, slate, smoothstep(0.0, 0.02, outward + wave))
    colours = mix(np.array([0.97, 0.93, 0.88]), colours, smoothstep(-0.055, -0.035, outward + wave))
    spots = hashed(np.floor(points / 0.028).astype(int), 23) > 0.93
    colours = np.where((spots & (outward > 0.02))[:, None], np.array([0.90, 0.92, 0.86]), colours)
    eye = np.linalg.norm(mirrored(points) - along_arc(0.86) - [0.012, 0.06, 0.01], axis=1)
    return np.where((eye < 0.017)[:, None], np.array([0.04, 0.04, 0.06]), colours)


def sea(points: np.ndarray) -> np.ndarray:
    """Bound on the distance to a cap of a ball with waves on it, flat below."""
    x, y, z = np.moveaxis(points, -1, 0)
    waves = SEA_LEVEL + 0.022 * np.sin(17 * x + 3 * y) * np.cos(9 * y - 2 * x)
    return 0.85 * np.maximum(np.maximum(ball(points, (0, 0, 0), SEA_RADIUS), z - waves), 0.03 - GLOBE_FOOT - z)


def sea_colours(points: np.ndarray) -> np.ndarray:
    """Return sRGB [V, 3]: green and blue water with foam on the crests, coloured stones below."""
    depth = SEA_LEVEL - points[:, 2]
    swirl = fractal_noise(points * 14.0, 4, seed=31)
    water = mix(np.array([0.03, 0.24, 0.42]), np.array([0.16, 0.62, 0.66]), smoothstep(0.3, 0.7, swirl))
    foam = smoothstep(0.54, 0.60, swirl) * smoothstep(0.015, -0.01, depth)
    water = mix(water, np.array([0.95, 0.98, 0.98]), foam)
    stone = np.floor(points / 0.05 + fractal_noise(points * 20.0, 2, seed=32)[:, None]).astype(int)
    stones = chosen(starlamp.BOOKS, hashed(stone, 33))
    return mix(water, stones, smoothstep(0.09, 0.10, depth))


def globe(points: np.ndarray) -> np.ndarray:
    """Distance to a ball with a flat foot and a rounded edge around it."""
    parts = np.stack([ball(points, (0, 0, 0), GLOBE_RADIUS), -GLOBE_FOOT - points[..., 2]], -1) + GLOBE_ROUNDING
    return distance.rounded(parts, GLOBE_ROUNDING)


def board_panels(board: TagBoard) -> list[Panel]:
    """The board's printed sheets."""
    panels = []
    for face in board.faces:
        corners = BOARD_SCALE * (board.face_corners(face) - [0.405, 0.405, 0.0]) + [0.0, 0.0, BOARD_HEIGHT]
        corner, upper_right, _, lower_left = corners
        # Paper is not quite white, and ink not quite black.
        print_ = 0.08 + 0.84 * board.draw(face, 12).astype(np.float32)[..., None].repeat(3, -1) / 255
        panels.append(Panel(corner, upper_right - corner, lower_left - corner, print_, smooth=False))
    return panels


def painted_panel(
    corner: Vector, right: Vector, down: Vector, colour: Colour, spacing: float, glows: bool = False
) -> Panel:
    """Paint a rectangle with `colour`(points [..., 3]) -> sRGB [..., 3], one pixel every `spacing` world units."""
    corner, right, down = (np.asarray(vector, np.float64) for vector in (corner, right, down))
    width, height = (max(2, int(np.ceil(np.linalg.norm(edge) / spacing))) for edge in (right, down))
    across, along = (np.arange(width) + 0.5) / width, (np.arange(height) + 0.5) / height
    points = corner + across[None, :, None] * right + along[:, None, None] * down
    return Panel(corner, right, down, np.clip(colour(points), 0.0, 1.0).astype(np.float32), glows)


def wooden(half_side: float, height: float, tone: Vector, seed: int) -> Panel:
    """A level square of planks along x, its middle at `height` above the origin."""
    colour = functools.partial(wood, tone=tone, seed=seed)
    edges = (2 * half_side, 0, 0), (0, -2 * half_side, 0)
    return painted_panel((-half_side, half_side, height), *edges, colour, 0.01)


def wood(points: np.ndarray, tone: Vector, seed: int) -> np.ndarray:
    """Return sRGB [..., 3] of planks along x."""
    plank = np.floor(points[..., 1:2] / 0.45).astype(int)
    shift = 9 * hashed(plank, seed)[..., None]
    position = np.concatenate([points[..., :1] * 1.5 + shift, points[..., 1:2] * 22, 0 * shift], -1)
    grain = fractal_noise(position, 4, seed)
    seam = np.abs(points[..., 1] / 0.45 % 1 - 0.5) > 0.485
    colour = np.asarray(tone) * (0.55 + 0.6 * grain + 0.25 * (hashed(plank, seed + 1) - 0.5))[..., None]
    return np.where(seam[..., None], 0.4 * colour, colour)


def room_panels(spacing: float) -> list[Panel]:
    """The six sides of the room, which light it, with a pixel every `spacing` world units."""
    low, high = (ROOM_CENTRE + ROOM_SCALE * corner for corner in (starlamp.ROOM_LOW, starlamp.ROOM_HIGH))
    extent = high - low
    x, y, z = np.diag(extent)

    def side(axis: int, corner: np.ndarray, right: np.ndarray, down: np.ndarray) -> Panel:
        def colour(points: np.ndarray) -> np.ndarray:
            return starlamp.room((points - ROOM_CENTRE) / ROOM_SCALE, np.full(points.shape[:-1], axis))

        return painted_panel(corner, right, down, colour, spacing, glows=True)

    return [
        side(0, low + z, y, -z),
        side(0, high, -y, -z),
        side(1, low + x + z, -x, -z),
        side(1, low + y + z, x, -z),
        side(2, low + y, x, -y),
        side(2, low + z, x, y),
    ]


def build(spacing: float) -> SyntheticScene:
    """Return the scene; `spacing` is the distance between neighbouring coloured vertices, world units."""
    fine, coarse = min(max(spacing, 0.004), 0.012), max(3 * spacing, 0.015)
    parts = [
        painted(dolphin, dolphin_colours, (-0.55, -0.3, -0.4), (0.55, 0.3, 0.45), fine),
        painted(sea, sea_colours, (-0.56, -0.56, -0.56), (0.56, 0.56, -0.2), fine),
    ]
    glass = distance.triangulate(globe, (-GLOBE_RADIUS,) * 3, (GLOBE_RADIUS,) * 3, GLOBE_SPACING)
    table = wooden(2.7, 0.0, (0.62, 0.42, 0.28), 41)
    top = wooden(0.5 * BOARD_SCALE * 0.27, BLOCK_TOP, (0.80, 0.72, 0.60), 43)
    return SyntheticScene(
        ior=WATER,
        glass=moved(glass, CENTRE),
        interior=moved(join(parts), CENTRE),
        sky=None,
        aim=AIM,
        panels=(*room_panels(coarse), table, top, *board_panels(twelve_faces())),
    )

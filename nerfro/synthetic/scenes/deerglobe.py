"""`deerglobe`: a deer under a pine on a snowy mound inside a ball of glass, in a winter valley."""

from __future__ import annotations

import numpy as np

from nerfro.core.light import to_linear
from nerfro.synthetic.scene import SyntheticScene, join, sphere
from nerfro.synthetic.scenes.distance import ball, capsule, ellipsoid, mirrored, painted, smooth_union
from nerfro.synthetic.scenes.patterns import azimuth, chosen, elevation, fractal_noise, hashed, mix, skyline, smoothstep

GLASS_RADIUS, GLASS_SUBDIVISIONS = 0.80, 6
MOUND_CENTRE, MOUND_RADIUS, MOUND_TOP = np.array([0.0, 0.0, 0.0]), 0.56, -0.24
PINE = (-0.10, 0.27)  # x, y of the trunk
CABINS = np.array([[0.62, 0.36, 0.24], [0.48, 0.28, 0.22], [0.76, 0.50, 0.30], [0.40, 0.34, 0.36]])
BAUBLES = np.array([[0.90, 0.20, 0.20], [0.98, 0.80, 0.25], [0.30, 0.55, 0.90], [0.95, 0.95, 0.98]])

# start, end, radius at start, radius at end
LEGS = (
    ((0.17, 0.055, -0.03), (0.18, 0.06, -0.25), 0.045, 0.018),
    ((0.17, -0.055, -0.03), (0.21, -0.06, -0.25), 0.045, 0.018),
    ((-0.15, 0.060, -0.03), (-0.19, 0.065, -0.25), 0.058, 0.018),
    ((-0.15, -0.060, -0.03), (-0.15, -0.065, -0.25), 0.058, 0.018),
)
ANTLER = (  # one side; the other is its mirror image
    ((0.27, 0.025, 0.30), (0.20, 0.11, 0.42), 0.015, 0.013),
    ((0.20, 0.11, 0.42), (0.24, 0.17, 0.52), 0.013, 0.007),
    ((0.23, 0.075, 0.37), (0.31, 0.10, 0.42), 0.012, 0.006),
    ((0.20, 0.11, 0.42), (0.12, 0.13, 0.49), 0.012, 0.006),
    ((0.22, 0.14, 0.47), (0.30, 0.15, 0.52), 0.010, 0.006),
)


def deer(points: np.ndarray) -> np.ndarray:
    """Bound on the distance to body, neck, head, ears, tail and legs, melted together."""
    parts = [
        ellipsoid(points, (0.0, 0.0, 0.0), (0.23, 0.105, 0.115)),
        capsule(points, (0.16, 0.0, 0.05), (0.26, 0.0, 0.25), 0.075, 0.045),
        capsule(points, (0.26, 0.0, 0.26), (0.38, 0.0, 0.20), 0.055, 0.026),
        capsule(points, (0.24, 0.045, 0.29), (0.20, 0.115, 0.33), 0.020, 0.010),
        capsule(points, (0.24, -0.045, 0.29), (0.20, -0.115, 0.33), 0.020, 0.010),
        capsule(points, (-0.21, 0.0, 0.05), (-0.27, 0.0, 0.0), 0.030, 0.018),
    ]
    parts += [capsule(points, *leg) for leg in LEGS]
    return smooth_union(parts, 0.05)


def antlers(points: np.ndarray) -> np.ndarray:
    """Bound on the distance to both antlers."""
    return smooth_union([capsule(mirrored(points), *branch) for branch in ANTLER], 0.015)


def deer_colours(points: np.ndarray) -> np.ndarray:
    """Return sRGB [V, 3]: chestnut fur with white spots, pale belly and tail, dark hooves, nose and eyes."""
    x, y, z = points.T
    strands = fractal_noise(points * np.array([18.0, 60.0, 60.0]), 3, seed=1)
    fur = mix(np.array([0.56, 0.30, 0.14]), np.array([0.86, 0.55, 0.28]), strands)
    cell = np.floor(points / 0.042).astype(int)
    jitter = np.stack([hashed(cell, 10 + axis) for axis in range(3)], -1) - 0.5
    spot = np.linalg.norm(points / 0.042 - cell - 0.5 - 0.3 * jitter, axis=1)
    spotted = (spot < 0.36) & (z > -0.02) & (x < 0.20) & (np.abs(y) > 0.02)
    fur = np.where(spotted[:, None], np.array([0.98, 0.94, 0.84]), fur)
    pale = smoothstep(-0.05, -0.08, z) * (x > -0.2) * (x < 0.2) * (z > -0.13)
    fur = mix(fur, np.array([0.96, 0.90, 0.78]), np.maximum(pale, smoothstep(-0.235, -0.25, x)))
    eye = np.linalg.norm(np.abs(points) - np.array([0.29, 0.045, 0.265]), axis=1)
    return np.where(((z < -0.215) | (x > 0.385) | (eye < 0.018))[:, None], np.array([0.08, 0.06, 0.06]), fur)


def antler_colours(points: np.ndarray) -> np.ndarray:
    """Return sRGB [V, 3]: bone with fine rings."""
    ring = fractal_noise(points * np.array([40.0, 40.0, 120.0]), 2, seed=5)
    return mix(np.array([0.62, 0.50, 0.36]), np.array([0.95, 0.90, 0.78]), smoothstep(0.3, 0.7, ring))


def mound(points: np.ndarray) -> np.ndarray:
    """Bound on the distance to a cap of a ball, its upper side gently hilly."""
    x, y, z = np.moveaxis(points, -1, 0)
    hills = MOUND_TOP + 0.018 * np.sin(9 * x + 2) * np.cos(8 * y)
    return 0.9 * np.maximum(ball(points, MOUND_CENTRE, MOUND_RADIUS), z - hills)


def mound_colours(points: np.ndarray) -> np.ndarray:
    """Return sRGB [V, 3]: snow with stones and tufts of grass above, layers of earth below."""
    tufts = fractal_noise(points * 9.0, 4, seed=7)
    snow = mix(np.array([0.97, 0.98, 1.0]), np.array([0.34, 0.52, 0.26]), smoothstep(0.50, 0.56, tufts))
    pebbles = hashed(np.floor(points[:, :2] / 0.022).astype(int), 8) > 0.93
    snow = np.where(pebbles[:, None], np.array([0.42, 0.40, 0.44]), snow)
    layer = np.floor((points[:, 2] + 0.03 * fractal_noise(points * 7.0, 3, seed=9)) / 0.03).astype(int)
    tones = np.array([[0.48, 0.30, 0.18], [0.72, 0.52, 0.32], [0.36, 0.24, 0.18], [0.84, 0.66, 0.42]])
    earth = chosen(tones, hashed(layer[:, None], 11)) * (0.8 + 0.4 * fractal_noise(points * 50.0, 2, seed=12))[:, None]
    return np.where((points[:, 2] > MOUND_TOP - 0.03)[:, None], snow, earth)


def pine(points: np.ndarray) -> np.ndarray:
    """Bound on the distance to a pine: a trunk and four scalloped cones."""
    offset = points - np.array([*PINE, 0.0])
    radius, angle = np.hypot(offset[..., 0], offset[..., 1]), np.arctan2(offset[..., 1], offset[..., 0])
    parts = [capsule(offset, (0, 0, -0.27), (0, 0, 0.0), 0.026, 0.022)]
    for bottom, top, width in ((-0.19, 0.03, 0.17), (-0.07, 0.13, 0.145), (0.05, 0.22, 0.115), (0.15, 0.31, 0.080)):
        rim = width * (1 + 0.10 * np.cos(9 * angle))
        cone = radius - rim * (top - offset[..., 2]) / (top - bottom)
        parts.append(0.6 * np.maximum(cone, bottom - offset[..., 2]))
    return np.minimum.reduce(parts)


def pine_colours(points: np.ndarray) -> np.ndarray:
    """Return sRGB [V, 3]: needles under patches of snow, baubles, a brown trunk."""
    needles = fractal_noise(points * np.array([60.0, 60.0, 25.0]), 3, seed=14)
    green = mix(np.array([0.07, 0.28, 0.16]), np.array([0.26, 0.60, 0.30]), needles)
    snow = smoothstep(0.54, 0.60, fractal_noise(points * 16.0, 3, seed=15))
    green = mix(green, np.array([0.96, 0.98, 1.0]), snow)
    cell = np.floor(points / 0.065).astype(int)
    bauble = (np.linalg.norm(points / 0.065 - cell - 0.5, axis=1) < 0.38) & (hashed(cell, 16) < 0.5)
    green = np.where(bauble[:, None], chosen(BAUBLES, hashed(cell, 17)), green)
    trunk = np.hypot(points[:, 0] - PINE[0], points[:, 1] - PINE[1]) < 0.032
    return np.where((trunk & (points[:, 2] < -0.17))[:, None], np.array([0.40, 0.25, 0.15]), green)


def sky(directions: np.ndarray) -> np.ndarray:
    """Return linear radiance [..., 3] of a winter valley: northern lights, two ranges, huts, firs, trodden snow."""
    height, turn = elevation(directions), azimuth(directions)
    up = np.clip(directions[..., 2], 0.0, 1.0)
    colour = mix(np.array([0.99, 0.86, 0.78]), np.array([0.42, 0.48, 0.80]), up**0.55)
    fold = np.concatenate([3 * directions[..., :2], 0.4 * directions[..., 2:]], -1)
    curtain = np.abs(fractal_noise(fold, 4, seed=51) - 0.5)
    colour = mix(colour, np.array([0.62, 0.98, 0.78]), smoothstep(0.05, 0.01, curtain) * smoothstep(0.15, 0.5, up))
    hem = smoothstep(0.03, 0.0, np.abs(curtain - 0.09)) * smoothstep(0.2, 0.6, up)
    colour = mix(colour, np.array([0.96, 0.72, 0.90]), hem)
    circle = np.stack([np.cos(2 * np.pi * turn), np.sin(2 * np.pi * turn)], -1)
    ranges = (3.0, 8.0, 26.0, (0.60, 0.66, 0.82), 52), (5.0, 1.0, 18.0, (0.36, 0.42, 0.58), 53)
    for scale, base, size, rock, seed in ranges:
        crest = base + size * fractal_noise(np.concatenate([scale * circle, 0 * circle[..., :1]], -1), 5, seed)
        strata = fractal_noise(np.concatenate([9 * circle, height[..., None] / 4], -1), 4, seed + 10)
        side = np.asarray(rock) * (0.75 + 0.5 * strata)[..., None]
        side = mix(side, np.array([0.97, 0.98, 1.0]), smoothstep(-6.0, -4.0, height - crest - 6 * (strata - 0.5)))
        colour = mix(colour, side, height < crest)
    huts, covered = skyline(directions, CABINS, count=30, heights=(2.5, 5.0), seed=55)
    colour = mix(colour, huts, covered * (hashed(np.floor(turn * 30).astype(int)[..., None], 56) < 0.4))
    tree = turn * 96
    number = np.floor(tree).astype(int)[..., None]
    tall = 5 + 9 * hashed(number, 57)
    saw = 0.42 * (1 - height / tall) * (0.75 + 0.5 * ((height / 2.0) % 1 < 0.5))
    fir = (np.abs(tree % 1 - 0.5) < saw) & (height < tall) & (hashed(number, 58) < 0.55)
    colour = mix(colour, np.array([0.10, 0.24, 0.22]), fir)
    colour = mix(colour, _snow(directions), height < 0)
    return to_linear(np.clip(colour, 0.0, 0.98))


def _snow(directions: np.ndarray) -> np.ndarray:
    depth = np.maximum(-directions[..., 2], 0.03)
    ground = directions[..., :2] / depth[..., None]
    drift = fractal_noise(np.concatenate([1.5 * ground, 0 * ground[..., :1]], -1), 5, seed=61)
    colour = mix(np.array([0.66, 0.74, 0.90]), np.array([0.97, 0.97, 0.98]), smoothstep(0.3, 0.65, drift))
    path = np.abs(ground[..., 1] - 0.5 * np.sin(1.3 * ground[..., 0]))
    slab = np.floor(ground / 0.13).astype(int)
    stone = chosen(CABINS * 0.7 + 0.25, hashed(slab, 62))
    inside = np.abs(ground / 0.13 - slab - 0.5).max(-1) < 0.42
    colour = np.where(((path < 0.35) & inside)[..., None], stone, colour)
    cell = np.floor(ground / 0.45).astype(int)
    shrub = np.linalg.norm(ground / 0.45 - cell - 0.5, axis=-1) + 0.3 * (drift - 0.5)
    bush = mix(np.array([0.70, 0.18, 0.16]), np.array([0.16, 0.36, 0.24]), smoothstep(0.10, 0.14, shrub))
    grows = (shrub < 0.28) & (hashed(cell, 63) < 0.4) & (path > 0.5)
    colour = np.where(grows[..., None], bush, colour)
    return mix(np.array([0.80, 0.84, 0.92]), colour, smoothstep(0.02, 0.16, -directions[..., 2]))


def build(spacing: float) -> SyntheticScene:
    """Return the scene; `spacing` is the distance between neighbouring coloured vertices, world units."""
    fine = min(max(spacing, 0.0035), 0.006)  # thin parts need a fine mesh whatever the resolution of the images
    x, y = PINE
    parts = [
        painted(deer, deer_colours, (-0.31, -0.15, -0.28), (0.42, 0.15, 0.36), fine),
        painted(antlers, antler_colours, (0.08, -0.20, 0.27), (0.34, 0.20, 0.55), min(fine, 0.005)),
        painted(mound, mound_colours, (-0.57, -0.57, -0.57), (0.57, 0.57, -0.2), fine),
        painted(pine, pine_colours, (x - 0.2, y - 0.2, -0.31), (x + 0.2, y + 0.2, 0.33), fine),
    ]
    glass = sphere(GLASS_RADIUS, GLASS_SUBDIVISIONS)
    return SyntheticScene(ior=1.5, glass=glass, interior=join(parts), sky=sky)

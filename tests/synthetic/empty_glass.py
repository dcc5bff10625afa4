"""Glass without content, for comparisons of its light with formulas."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from nerfro.synthetic.scene import SurfaceMesh, SyntheticScene, torus_angles
from nerfro.synthetic.synthesis import find_scene


def empty_glass(glass: SurfaceMesh, sky: Callable[[np.ndarray], np.ndarray], **options: Any) -> SyntheticScene:
    """Make a scene whose interior lies far outside the pictures, because every scene has one."""
    ring, _ = torus_angles(0.02, 0.005, spacing=0.005)
    interior = replace(ring, vertices=ring.vertices + np.float32(50), colours=np.ones_like(ring.vertices))
    return replace(find_scene("torus").build(0.1), glass=glass, interior=interior, tint=(1.0,) * 3, sky=sky, **options)

"""Light on flat things, computed once for all pictures of a scene."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from skimage.transform import resize

from nerfro.light import to_linear, to_srgb
from nerfro.scenes.path_tracer import PathTracer, Pinhole
from nerfro.scenes.scene import Panel, Scene

TEXELS = 16  # of the light on a panel, each way
_ABOVE = 2e-3  # world units; more than the renderer's own offsets, less than the gap under the globe


def bake(scene: Scene, spp: int, variant: str = "auto") -> Scene:
    """Replace the light that falls on panels by light that they send out: shading and shadows without noise.

    Panels are diffuse, so that they look the same from all sides. While the light is computed, each has its mean
    colour; light that is thrown back and forth between them has no finer pattern than that.

    Args:
        scene: with panels.
        spp: samples for each of `TEXELS` x `TEXELS` places on a panel.
        variant: Mitsuba variant, see `load_mitsuba`.
    """
    plain = [panel if panel.glows else replace(panel, picture=_mean(panel)) for panel in scene.panels]
    tracer = PathTracer(replace(scene, panels=tuple(plain)), False, Pinhole.square(1.0, TEXELS), variant)
    baked = []
    for number, (panel, even) in enumerate(zip(scene.panels, plain, strict=True)):
        if not panel.glows:
            light = tracer.render_flat(panel.to_world, _ABOVE, spp, number) / to_linear(even.picture[:1, :1])
            fine = resize(light, panel.picture.shape, order=1, mode="edge", anti_aliasing=False)
            lit = np.clip(fine * to_linear(panel.picture), 0.0, 1.0)
            panel = replace(panel, picture=to_srgb(lit).astype(np.float32), glows=True)
        baked.append(panel)
    return replace(scene, panels=tuple(baked))


def _mean(panel: Panel) -> np.ndarray:
    """A picture [2, 2, 3] of the mean of the panel's linear colours."""
    return np.tile(to_srgb(to_linear(panel.picture).mean((0, 1))).astype(np.float32), (2, 2, 1))

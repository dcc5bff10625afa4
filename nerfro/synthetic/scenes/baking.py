"""Precomputed light on flat surfaces, shared by all images of a scene."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from skimage.transform import resize

from nerfro.core.light import to_linear, to_srgb
from nerfro.synthetic.path_tracer import PathTracer, Pinhole
from nerfro.synthetic.scene import Panel, SyntheticScene

TEXELS = 16  # resolution of the light on a panel
_ABOVE = 2e-3  # world units; more than the offsets of the renderer, less than the gap under the globe


def bake(scene: SyntheticScene, spp: int, variant: str = "auto") -> SyntheticScene:
    """Replace the reflected light of panels by emitted light, so that shading and shadows have no noise.

    The radiance of a panel is independent of the direction, because panels are diffuse. During the computation, each
    panel has its mean colour; light that panels reflect onto each other has no finer pattern.

    Args:
        scene: scene with panels.
        spp: samples for each of `TEXELS` x `TEXELS` positions on a panel.
        variant: Mitsuba variant, see `load_mitsuba`.
    """
    plain = [panel if panel.glows else replace(panel, image=_mean(panel)) for panel in scene.panels]
    tracer = PathTracer(replace(scene, panels=tuple(plain)), False, Pinhole.square(1.0, TEXELS), variant)
    baked = []
    for number, (panel, mean) in enumerate(zip(scene.panels, plain, strict=True)):
        if not panel.glows:
            light = _light(tracer, panel, spp, number) / to_linear(mean.image[:1, :1])
            fine = resize(light, panel.image.shape, order=1, mode="edge", anti_aliasing=False)
            lit = np.clip(fine * to_linear(panel.image), 0.0, 1.0)
            panel = replace(panel, image=to_srgb(lit).astype(np.float32), glows=True)
        baked.append(panel)
    return replace(scene, panels=tuple(baked))


def _light(tracer: PathTracer, panel: Panel, spp: int, seed: int) -> np.ndarray:
    """Return the linear radiance [TEXELS, TEXELS, 3] of a panel along its normal."""
    pose = panel.to_world
    pose[:3, 3] += _ABOVE * pose[:3, 2]
    sensor = {"type": "orthographic", "near_clip": 0.1 * _ABOVE, "far_clip": 10.0 * _ABOVE}
    return tracer.render_sensor(sensor, pose, spp, seed)


def _mean(panel: Panel) -> np.ndarray:
    """Return an image [2, 2, 3] of the mean linear colour of a panel."""
    return np.tile(to_srgb(to_linear(panel.image).mean((0, 1))).astype(np.float32), (2, 2, 1))

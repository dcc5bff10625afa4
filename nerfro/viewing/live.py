"""Interactive page of a model during training, updated within a fixed fraction of the training time."""

from __future__ import annotations

import time

from nerfro.data.base import Views
from nerfro.viewing.baking import Baked
from nerfro.viewing.page import assemble_page, bake_parts, static_parts
from nerfro.viewing.server import PageServer
from nerfro.viewing.trained_scene import TrainedScene

_TIME_FRACTION = 0.02  # maximum share of the training time that updates take
_UPDATE_SECONDS = 5.0  # target interval between updates; the resolution of the volume is adapted
_RESOLUTIONS = 24, 128  # bounds of the adapted resolution
_COMPRESSION = 1  # fastest level of zlib, because local connections are fast


class LivePage:
    """Keeps the page of a server up to date with a scene. Updates run in the thread of the caller.

    The interval between updates is proportional to the duration of an update, so that updates take a fixed share of the
    time. If the interval exceeds a few seconds, the resolution of the volume decreases.

    Args:
        server: server of the page.
        scene: scene whose model changes during training.
        views: cameras and photographs on the page.
        split: name of the split of these views.
        resolution: initial number of vertices along the longest side of the volume.
    """

    def __init__(self, server: PageServer, scene: TrainedScene, views: Views, split: str, resolution: int = 48) -> None:
        self._server, self._scene, self._cameras = server, scene, views.cameras
        self._resolution = resolution
        static = {**static_parts(scene, views, split), "version": 0}
        server.open(assemble_page(scene.name, static, self._bake(surface=True), live=True))
        self._next = time.monotonic()

    def update(self) -> None:
        """Call `show` if an update is due and a browser shows the page."""
        start = time.monotonic()
        if start < self._next or not self._server.watched:
            return
        self.show()
        duration = time.monotonic() - start
        self._next = start + max(duration / _TIME_FRACTION, _UPDATE_SECONDS)
        scale = (_TIME_FRACTION * _UPDATE_SECONDS / duration) ** (1 / 3)
        low, high = _RESOLUTIONS
        self._resolution = round(min(max(self._resolution * min(max(scale, 0.7), 1.3), low), high))

    def show(self) -> None:
        """Publish the current model."""
        medium = self._scene.renderer.scene.medium
        surface_changes = any(parameter.requires_grad for parameter in medium.parameters())
        parts = self._bake(surface=surface_changes)
        arrays = {name: uri for part in parts.values() for name, uri in part.packed(_COMPRESSION).items()}
        self._server.publish({name: part.metadata for name, part in parts.items()}, arrays)

    def _bake(self, surface: bool) -> dict[str, Baked]:
        renderer = self._scene.renderer
        was_training = renderer.training
        renderer.eval()
        parts = bake_parts(self._scene, self._cameras, self._resolution, surface)
        renderer.train(was_training)
        return parts

"""A model that still learns, on a page: baked again and again within a share of the time."""

# ruff: noqa: UP045 - OmegaConf on Python 3.10 wants Optional

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Annotated, Optional

from omegaconf import MISSING

from nerfro.allowed import Range
from nerfro.data.base import Views
from nerfro.viewing.baking import Baked
from nerfro.viewing.page import document, frame_of, parts_of
from nerfro.viewing.server import PageServer
from nerfro.viewing.trained_scene import TrainedScene
from nerfro.viewing.volume import RESOLUTION

LOOK_AGAIN = 3.0  # seconds between two looks at a checkpoint that may be replaced

_SHARE = 0.02  # of the time that goes into baking
_SECONDS = 5.0  # between two bakes; the inside's resolution follows
_RESOLUTIONS = 24, 128  # vertices of the inside's grid along its longest side
_FASTEST = 1  # zlib's level: what crosses the loopback need not be small


@dataclass
class ViewConfig:
    """What `python -m nerfro.view` is asked."""

    checkpoint: str = MISSING  # run folder, or a checkpoint in it
    host: str = "localhost"  # address to listen at; 0.0.0.0 lets other machines see the page
    port: Annotated[int, Range(at_least=0, at_most=65535)] = 8008  # 0 for any that is free
    open: bool = True  # whether to open a browser
    resolution: Annotated[int, Range(at_least=2)] = RESOLUTION  # grid vertices of the inside along its longest side
    root: Optional[str] = None  # folder of the data, if it has moved since training
    device: str = "auto"  # `cpu`, `cuda`, or `auto` for a GPU if there is one


class LivePage:
    """Keeps a server's page up to date with a scene, in the thread that asks for it.

    A bake takes as long as it takes: the next comes so much later that the share of time stays, and its grid is
    coarser if that is later than every few seconds.

    Args:
        server: shows the page.
        scene: what is shown, as its model is at each time.
        views: cameras and photographs of the page.
        split: which views these are.
        resolution: vertices of the inside's grid along its longest side, at first.
    """

    def __init__(self, server: PageServer, scene: TrainedScene, views: Views, split: str, resolution: int = 48) -> None:
        self._server, self._scene, self._cameras = server, scene, views.cameras
        self._resolution = resolution
        frame = {**frame_of(scene, views, split), "version": 0}
        server.open(document(scene.name, frame, self._parts(surface=True), live=True))
        self._next = time.monotonic()

    def update(self) -> None:
        """Show the model as it is now, if it is time and somebody looks."""
        begun = time.monotonic()
        if begun < self._next or not self._server.watched:
            return
        self.show(self._scene)
        took = time.monotonic() - begun
        self._next = begun + max(took / _SHARE, _SECONDS)
        finer = (_SHARE * _SECONDS / took) ** (1 / 3)
        low, high = _RESOLUTIONS
        self._resolution = round(min(max(self._resolution * min(max(finer, 0.7), 1.3), low), high))

    def show(self, scene: TrainedScene) -> None:
        """Show another state of the scene."""
        moves = any(parameter.requires_grad for parameter in scene.renderer.scene.medium.parameters())
        self._scene = scene
        parts = self._parts(surface=moves)
        arrays = {name: uri for part in parts.values() for name, uri in part.packed(_FASTEST).items()}
        self._server.publish({name: part.facts for name, part in parts.items()}, arrays)

    def _parts(self, surface: bool) -> dict[str, Baked]:
        renderer = self._scene.renderer
        was_training = renderer.training
        renderer.eval()
        parts = parts_of(self._scene, self._cameras, self._resolution, surface)
        renderer.train(was_training)
        return parts

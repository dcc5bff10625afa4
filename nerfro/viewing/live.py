"""Interactive page of a model during training, updated within a fixed fraction of the training time."""

from __future__ import annotations

import math
import re
import time
from collections.abc import Mapping

from jaxtyping import Float
from torch import Tensor

from nerfro.data.base import Views
from nerfro.evaluation.image_metrics import triptych
from nerfro.files.images import data_uri, to_8bit
from nerfro.viewing.baking import Baked
from nerfro.viewing.page import assemble_page, bake_parts, static_parts
from nerfro.viewing.server import PageServer
from nerfro.viewing.trained_scene import TrainedScene

_SHARE = 0.0075  # largest share of updates in the time; their share of the processor time may be larger
_INTERVAL = 5.0  # shortest time between updates, seconds


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
        static = {**static_parts(scene, views.cameras, views.images, split), "version": 0}
        start = time.monotonic()
        parts = self._bake(surface=True)
        self._adapt_resolution(time.monotonic() - start, least=0.0)
        server.open(assemble_page(scene, static, parts, live=True))
        self._next, self._next_point = time.monotonic() + _INTERVAL, -math.inf

    def record(self, step: int, loss: Tensor, logged: Mapping[str, Tensor]) -> None:
        """Add a point to the training curves once a second, because on a GPU each point waits for the step.

        Args:
            step: number of the step.
            loss: training loss of the step.
            logged: latest values of the log, of which the page shows losses and PSNR.
        """
        if time.monotonic() < self._next_point:
            return
        self._next_point = time.monotonic() + 1.0
        shown = {name: value for name, value in logged.items() if re.fullmatch("loss/(?!total).*|.*/psnr", name)}
        losses = {"training loss": loss, **shown}
        self._server.add_losses(step, {name: float(value) for name, value in losses.items()})

    def show_validation(self, step: int, rendering: Float[Tensor, "H W 3"], photograph: Float[Tensor, "H W 3"]) -> None:
        """Show the rendering of a validation view, its photograph, and the error."""
        picture = to_8bit(triptych(rendering, photograph)).cpu().numpy()
        self._server.show_validation(step, data_uri(picture, "JPEG", quality=85))

    def update(self) -> None:
        """Call `show` if an update is due and a browser shows the page."""
        start = time.monotonic()
        if start < self._next or not self._server.watched:
            return
        self.show()
        duration = time.monotonic() - start
        self._next = start + max(duration / _SHARE, _INTERVAL)
        self._adapt_resolution(duration, least=0.7)

    def _adapt_resolution(self, duration: float, least: float) -> None:
        """Change the resolution by a factor of at least `least`, so that an update in each interval takes its share."""
        scale = (_SHARE * _INTERVAL / max(duration, 1e-3)) ** (1 / 3)
        self._resolution = round(min(max(self._resolution * min(max(scale, least), 1.3), 24), 128))

    def finish(self) -> None:
        """Publish the final model, if a browser shows the page."""
        if self._server.watched:
            self.show()

    def show(self) -> None:
        """Publish the current model."""
        medium = self._scene.renderer.scene.medium
        surface_changes = any(parameter.requires_grad for parameter in medium.parameters())
        parts = self._bake(surface=surface_changes)
        # The fastest level of zlib suffices, because local connections are fast.
        arrays = {name: uri for part in parts.values() for name, uri in part.packed(1).items()}
        self._server.publish({name: part.metadata for name, part in parts.items()}, arrays)

    def _bake(self, surface: bool) -> dict[str, Baked]:
        renderer = self._scene.renderer
        was_training = renderer.training
        renderer.eval()
        parts = bake_parts(self._scene, self._cameras, self._resolution, surface)
        renderer.train(was_training)
        return parts

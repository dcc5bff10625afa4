"""Interactive page of a model during training: `viewer=true`."""

from __future__ import annotations

from typing import Any

from lightning.pytorch import Callback, LightningModule, Trainer
from omegaconf import DictConfig

from nerfro.data.base import DataSource, Views
from nerfro.training.module import TrainingModule
from nerfro.viewing.baking import bake_surface
from nerfro.viewing.live import LivePage
from nerfro.viewing.server import PageServer
from nerfro.viewing.trained_scene import TrainedScene


class Viewer(Callback):
    """Serve the page to this machine, with current weights and losses.

    With several processes, the first one serves the page.

    Args:
        config: configuration of the run, see `TrainConfig`.
        source: data set.
        views: views of the evaluated split, whose cameras and photographs the page shows.
    """

    def __init__(self, config: DictConfig, source: DataSource, views: Views) -> None:
        self._config, self._source, self._views = config, source, views
        self._server: PageServer | None = None
        self._live: LivePage | None = None

    def setup(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        # Errors of the page and of its port are raised before the first step.
        if trainer.is_global_zero:
            assert isinstance(pl_module, TrainingModule)
            bake_surface(pl_module.renderer)
            self._server = PageServer("localhost", self._config.viewer_port)

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        if self._server is None:
            return
        assert isinstance(pl_module, TrainingModule)
        scene = TrainedScene(pl_module.renderer, self._source, name=self._config.name)
        self._live = LivePage(self._server, scene, self._views, self._config.evaluation.split or "train")
        print(f"nerfro: the model as it learns: {self._server.url}", flush=True)

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, *_: Any, **__: Any
    ) -> None:
        if self._live is None:
            return
        self._live.record(trainer.global_step, outputs["loss"], trainer.callback_metrics)
        self._live.update()

    def on_validation_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, *_: Any, **__: Any
    ) -> None:
        if self._live is not None and outputs:
            self._live.show_validation(trainer.global_step, outputs["prediction"], outputs["target"])

    def on_train_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        if self._live is not None:
            self._live.finish()

    def on_exception(self, trainer: Trainer, pl_module: LightningModule, exception: BaseException) -> None:
        self.close(f"The training has stopped: {type(exception).__name__}.")

    def close(self, outcome: str) -> None:
        """Tell the browsers how the training has ended, and stop the server."""
        if self._server is not None:
            self._server.complete(outcome)
            self._server.close()
            self._server = self._live = None

"""`python -m nerfro.view checkpoint=RUN`: serve a run's interactive page, and follow the run's checkpoints."""

from __future__ import annotations

import time
import webbrowser
from pathlib import Path

from omegaconf import DictConfig

from nerfro.cli import entry_point
from nerfro.report.curves import CURVES_FILE, read_curves
from nerfro.training.load import checkpoint_of, load
from nerfro.viewing.live import LOOK_AGAIN, LivePage, ViewConfig
from nerfro.viewing.page import page_split
from nerfro.viewing.server import PageServer


@entry_point("view", ViewConfig)
def main(config: DictConfig) -> None:
    """Serve until Ctrl-C; whenever the checkpoint or the curve of the loss is another, show that."""
    checkpoint = checkpoint_of(config.checkpoint)
    run = checkpoint.parent.parent
    scene = load(checkpoint, config.device, config.root)
    shown, told = _written(checkpoint), _written(run / CURVES_FILE)
    server = PageServer(config.host, config.port)
    split = page_split(scene.source)
    page = LivePage(server, scene, scene.views(split), split, config.resolution)
    show_losses(server, run)
    print(f"nerfro: {scene.name} on {server.url}; Ctrl-C ends it", flush=True)
    if config.open:
        webbrowser.open(server.url)
    while True:
        time.sleep(LOOK_AGAIN)
        if _written(checkpoint) != shown:
            shown = _written(checkpoint)
            page.show(load(checkpoint, config.device, config.root))
        if _written(run / CURVES_FILE) != told:
            told = _written(run / CURVES_FILE)
            show_losses(server, run)


def show_losses(server: PageServer, run: Path) -> None:
    """Show the losses that a run has logged; a run without a CSV log has none to show."""
    steps, losses = read_curves(run).get("loss/total", ((), ()))
    server.show_losses([(int(step), float(loss)) for step, loss in zip(steps, losses, strict=True)])


def _written(file: Path) -> float:
    return file.stat().st_mtime if file.exists() else 0.0


if __name__ == "__main__":
    main()

"""`python -m nerfro.view checkpoint=RUN`: serve a run's interactive page, and follow the run's checkpoints.

Examples:
    nerfro view checkpoint=outputs/first
    nerfro view checkpoint=outputs/first port=0 open=false
"""

from __future__ import annotations

import time
from pathlib import Path

from omegaconf import DictConfig

import nerfro.startup  # noqa: F401 - before the other imports, which take seconds
from nerfro.cli import entry_point
from nerfro.report.curves import CURVES_FILE, read_curves
from nerfro.training.load import checkpoint_of, load
from nerfro.viewing.live import POLL_SECONDS, LivePage, ViewConfig
from nerfro.viewing.page import page_split
from nerfro.viewing.server import PageServer, open_page


@entry_point("view", ViewConfig)
def main(config: DictConfig) -> None:
    """Serve the page until Ctrl-C, and update the page when the checkpoint or the training curve changes."""
    checkpoint = checkpoint_of(config.checkpoint)
    run = checkpoint.parent.parent
    scene = load(checkpoint, config.device, config.root)
    scene_time, curve_time = _modified(checkpoint), _modified(run / CURVES_FILE)
    server = PageServer(config.host, config.port)
    split = page_split(scene.source)
    page = LivePage(server, scene, scene.views(split), split, config.resolution)
    show_losses(server, run)
    print(f"nerfro: {scene.name} on {server.url}; Ctrl-C ends it", flush=True)
    if config.open:
        open_page(server.url)
    while True:
        time.sleep(POLL_SECONDS)
        if _modified(checkpoint) != scene_time:
            scene_time = _modified(checkpoint)
            page.show(load(checkpoint, config.device, config.root))
        if _modified(run / CURVES_FILE) != curve_time:
            curve_time = _modified(run / CURVES_FILE)
            show_losses(server, run)


def show_losses(server: PageServer, run: Path) -> None:
    """Show the training curve of a run; the curve is empty without a CSV log."""
    steps, losses = read_curves(run).get("loss/total", ((), ()))
    server.set_losses([(int(step), float(loss)) for step, loss in zip(steps, losses, strict=True)])


def _modified(file: Path) -> float:
    """Return the modification time of a file, or 0 if the file does not exist."""
    return file.stat().st_mtime if file.exists() else 0.0


if __name__ == "__main__":
    main()

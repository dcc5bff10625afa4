"""`python -m nerfro.view checkpoint=RUN`: serve a run's interactive page, and follow the run's checkpoints."""

from __future__ import annotations

import time
import webbrowser
from pathlib import Path

from omegaconf import DictConfig

from nerfro.cli import entry_point
from nerfro.training.load import checkpoint_of, load
from nerfro.viewing.live import LOOK_AGAIN, LivePage, ViewConfig
from nerfro.viewing.page import page_split
from nerfro.viewing.server import PageServer


@entry_point("view", ViewConfig)
def main(config: DictConfig) -> None:
    """Serve until Ctrl-C; whenever the checkpoint is another, show that."""
    checkpoint = checkpoint_of(config.checkpoint)
    scene = load(checkpoint, config.device, config.root)
    shown = _written(checkpoint)
    server = PageServer(config.host, config.port)
    split = page_split(scene.source)
    page = LivePage(server, scene, scene.views(split), split, config.resolution)
    print(f"nerfro: {scene.name} on {server.url}; Ctrl-C ends it", flush=True)
    if config.open:
        webbrowser.open(server.url)
    while True:
        time.sleep(LOOK_AGAIN)
        if _written(checkpoint) != shown:
            shown = _written(checkpoint)
            page.show(load(checkpoint, config.device, config.root))


def _written(checkpoint: Path) -> float:
    return checkpoint.stat().st_mtime


if __name__ == "__main__":
    main()

"""`python -m nerfro.view checkpoint=RUN`: serve a run's interactive page, and follow the run's checkpoints.

Examples:
    nerfro view checkpoint=outputs/first
    nerfro view checkpoint=outputs/first port=0 open=false
"""

from __future__ import annotations

import contextlib
import csv
import math
import time
from pathlib import Path

from omegaconf import DictConfig

import nerfro.startup  # noqa: F401 - before the other imports, which take seconds
from nerfro.cli import entry_point
from nerfro.files.reading import reading
from nerfro.training.load import checkpoint_of, load
from nerfro.viewing.live import POLL_SECONDS, LivePage, ViewConfig
from nerfro.viewing.page import page_split
from nerfro.viewing.server import PageServer, open_page

_LOSSES = Path("csv", "metrics.csv")  # of the CSV logger of Lightning, see conf/logger/


@entry_point("view", ViewConfig)
def main(config: DictConfig) -> None:
    """Serve the page until Ctrl-C, and update the page when the checkpoint or the training curve changes."""
    checkpoint = checkpoint_of(config.checkpoint)
    run = checkpoint.parent.parent
    scene = load(checkpoint, config.device, config.root)
    scene_time, curve_time = _modified(checkpoint), _modified(run / _LOSSES)
    server = PageServer(config.host, config.port)
    split = page_split(scene.source)
    page = LivePage(server, scene, scene.views(split), split, config.resolution)
    server.set_losses(read_losses(run))
    print(f"nerfro: {scene.name} on {server.url}; Ctrl-C ends it", flush=True)
    if config.open:
        open_page(server.url)
    while True:
        time.sleep(POLL_SECONDS)
        if _modified(checkpoint) != scene_time:
            scene_time = _modified(checkpoint)
            page.show(load(checkpoint, config.device, config.root))
        if _modified(run / _LOSSES) != curve_time:
            curve_time = _modified(run / _LOSSES)
            server.set_losses(read_losses(run))


def read_losses(run: Path) -> list[tuple[int, float]]:
    """Read pairs of step and total loss of a run; empty without a CSV log.

    Unreadable rows are skipped, such as the last row of an interrupted run.
    """
    losses: dict[int, float] = {}
    file = run / _LOSSES
    if file.is_file():
        with reading(file, advice="remove it"), file.open(newline="", encoding="utf-8", errors="replace") as stream:
            for row in csv.DictReader(stream):
                with contextlib.suppress(KeyError, TypeError, ValueError, OverflowError):
                    losses[int(float(row["step"]))] = float(row["loss/total"])
    return sorted((step, loss) for step, loss in losses.items() if math.isfinite(loss))


def _modified(file: Path) -> float:
    """Return the modification time of a file, or 0 if the file does not exist."""
    return file.stat().st_mtime if file.exists() else 0.0


if __name__ == "__main__":
    main()

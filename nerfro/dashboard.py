"""`python -m nerfro.dashboard`: show all runs below a folder in TensorBoard, named by experiment and scene.

Examples:
    nerfro dashboard
    nerfro dashboard outputs=outputs/refractive port=0 open=false
"""

from __future__ import annotations

import tempfile
import time
from pathlib import Path

from omegaconf import DictConfig

import nerfro.startup  # noqa: F401 - before the other imports, which take seconds
from nerfro.cli import entry_point
from nerfro.errors import NerfroError
from nerfro.paths import refuse_root, user_path
from nerfro.report.dashboard import SEARCH_INTERVAL, DashboardConfig, link_runs, serve
from nerfro.viewing.server import open_page


@entry_point("dashboard", DashboardConfig)
def main(config: DictConfig) -> None:
    """Serve TensorBoard until Ctrl-C."""
    outputs = user_path(config.outputs)
    refuse_root(outputs, "outputs")
    if not outputs.is_dir():
        raise NerfroError(f"outputs={outputs} is not a folder; give the folder that contains the run folders")
    with tempfile.TemporaryDirectory(prefix="nerfro_dashboard_") as names:
        num_runs = link_runs(outputs, Path(names))
        url = serve(Path(names), config.host, config.port)
        print(
            f"nerfro: {num_runs} runs below {outputs} on {url}; new runs appear automatically; press Ctrl-C to stop",
            flush=True,
        )
        if config.open:
            open_page(url)
        while True:
            time.sleep(SEARCH_INTERVAL)
            link_runs(outputs, Path(names))


if __name__ == "__main__":
    main()

"""axe-core finds no problems on the pages that nerfro writes, and no serious ones on its site."""

import functools
import os
import threading
import time
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest

from nerfro.evaluation.results import EvaluationResult, RunMetrics, ViewScores
from nerfro.evaluation.run_page import write_run_page
from nerfro.viewing.live import LivePage
from nerfro.viewing.page import make_page
from nerfro.viewing.server import PageServer
from nerfro.viewing.trained_scene import TrainedScene
from tests.test_report import page as report
from tests.test_report import runs  # noqa: F401
from tests.viewing.browser import Browser, needs_chromium
from tests.viewing.conftest import scene, server  # noqa: F401

pytestmark = needs_chromium


@pytest.mark.parametrize("size", [(1000, 700), (500, 800)])
def test_page_of_a_scene(scene: TrainedScene, size: tuple[int, int], tmp_path: Path) -> None:  # noqa: F811
    with Browser(make_page(scene, 8), tmp_path, size=size) as browser:
        assert browser.findings() == []
        browser.evaluate("$('controls').open = $('more').open = true, $('add-key').click(), page.show(1)")
        assert browser.findings() == []


def test_live_page(scene: TrainedScene, server: PageServer, tmp_path: Path) -> None:  # noqa: F811
    LivePage(server, scene, scene.views(), "test", resolution=8)
    server.add_losses(3, {"loss": 0.5})
    server.complete("Training is complete: PSNR 31.3 dB.")
    with Browser(server.url, tmp_path) as browser:
        browser.wait_for("$('outcome').textContent.includes('PSNR')")
        assert browser.findings() == []


def test_report(runs: Path, tmp_path: Path) -> None:  # noqa: F811
    with Browser(report(runs), tmp_path) as browser:
        assert browser.findings() == []


def test_page_of_a_run(tmp_path: Path) -> None:
    scores = RunMetrics(EvaluationResult(tuple(ViewScores(f"r_{i}", {"psnr": 30.0 + i}) for i in range(2))))
    write_run_page(tmp_path, "refractive", (9, 95.0), [(1, 0.1, 1.0), (60, 50.0, 0.1)], scores, "test")
    with Browser((tmp_path / "index.html").as_uri(), tmp_path) as browser:
        assert browser.findings() == []


@pytest.fixture(scope="module")
def site() -> Path:
    """The site of the documentation, which `.ci/run` builds while the tests run."""
    if "NERFRO_SITE" not in os.environ:
        pytest.skip("the site is not built: mkdocs build, and set NERFRO_SITE to its folder")
    folder = Path(os.environ["NERFRO_SITE"])
    deadline = time.monotonic() + 600
    while not folder.is_dir():
        if Path(f"{folder}.failed").exists():
            pytest.skip("the site could not be built")
        assert time.monotonic() < deadline, f"{folder} does not exist"
        time.sleep(0.1)
    return folder


@pytest.mark.parametrize("page", ["index.html", "guides/export_and_share.html"])
def test_site(page: str, site: Path, tmp_path: Path) -> None:
    # The search of the site needs a server.
    files = functools.partial(SimpleHTTPRequestHandler, directory=str(site))
    with ThreadingHTTPServer(("localhost", 0), files) as host:
        threading.Thread(target=host.serve_forever, daemon=True).start()
        with Browser(f"http://localhost:{host.server_port}/{page}", tmp_path, size=(1300, 900)) as browser:
            assert [line for line in browser.findings() if line.startswith(("serious", "critical"))] == []
        host.shutdown()

"""The live page of a training: baking on demand, its share of the time, and the display in a browser."""

import json
import re
import time
from pathlib import Path

import pytest
import torch

from nerfro.viewing import live
from nerfro.viewing.live import LivePage
from nerfro.viewing.server import PageServer
from nerfro.viewing.trained_scene import TrainedScene
from tests.conftest import Runner
from tests.viewing.browser import Browser, needs_chromium


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """A clock that the test sets; a bake takes three of its seconds."""
    now = [100.0]
    monkeypatch.setattr("time.monotonic", lambda: now[0])
    bake = live.bake_parts

    def slow(*arguments: object) -> dict:
        now[0] += 3
        return bake(*arguments)  # type: ignore[arg-type]

    monkeypatch.setattr(live, "bake_parts", slow)
    return now


def test_bakes_take_a_bounded_share_of_the_time(scene: TrainedScene, server: PageServer, clock: list[float]) -> None:
    page = LivePage(server, scene, scene.views(), "test", resolution=24)

    def version() -> int:
        return json.loads(server.state(0))["version"]

    clock[0] += 5
    page.update()
    assert version() == 0, "nobody looks"
    page.update()
    assert version() == 1, "now somebody does: asking for the version was looking"
    begun = clock[0] - 3
    while version() == 1:
        clock[0] += 1
        page.update()
    assert clock[0] - 3 - begun >= 3 / 0.0075
    clock[0] += 1000
    page.update()
    assert version() == 2, "nobody has looked for a long time"


def test_bakes_keep_training_mode_and_weights(scene: TrainedScene, server: PageServer) -> None:
    scene.renderer.train()
    page = LivePage(server, scene, scene.views(), "test", resolution=8)
    page.show()
    assert scene.renderer.training
    assert set(json.loads(server.state(0))["update"]["scene"]) == {"volume", "sky"}, "the surface stays"


@pytest.mark.slow
@needs_chromium
def test_browser_shows_updates_and_losses(scene: TrainedScene, server: PageServer, tmp_path: Path) -> None:
    page = LivePage(server, scene, scene.views(), "test", resolution=8)
    server.add_losses(3, {"training loss": 0.5})
    server.add_losses(7, {"training loss": 0.25, "val/psnr": 21.5})
    page.show()
    page.show_validation(7, torch.zeros(8, 8, 3), torch.ones(8, 8, 3))
    with Browser(server.url, tmp_path) as browser:
        browser.wait_for("document.body.textContent.includes('step 7, training loss 0.250')")
        browser.wait_for("document.querySelector('polyline[points^=\"428\"]') !== null")
        assert browser.evaluate("[$('high'), $('low'), $('end')].map((label) => label.textContent)") == [
            "0.500",
            "0.250",
            "step 7",
        ]
        # Rendering, photograph and error, beside each other.
        browser.wait_for("$('validation').naturalWidth === 24")
        browser.evaluate("$('curve').value = 'val/psnr', $('curve').dispatchEvent(new Event('change'))")
        browser.wait_for("$('losses').textContent === 'step 7, val/psnr 21.5'")
    assert server.watched


@needs_chromium
def test_slow_machine_draws_little_until_the_training_ends(
    scene: TrainedScene, server: PageServer, tmp_path: Path
) -> None:
    page = LivePage(server, scene, scene.views(), "test", resolution=8)
    with Browser(server.url, tmp_path) as browser:
        page.show()
        browser.wait_for("page.scene.version === 1 && page.drafted && page.frame === null")
        assert browser.evaluate("page.budget") <= 0
        browser.evaluate("page.maxRays = 1")
        page.finish()
        server.complete("Training is complete.")
        browser.wait_for("page.pass > 0 || page.rays > 0", 200)


@needs_chromium
def test_browser_tells_the_outcome_and_opens_the_final_page(
    scene: TrainedScene, server: PageServer, tmp_path: Path
) -> None:
    page = LivePage(server, scene, scene.views(), "test", resolution=8)
    server.add_losses(3, {"training loss": 0.5})
    with Browser(server.url, tmp_path) as browser:
        browser.wait_for("document.body.textContent.includes('step 3')")
        page.finish()
        server.complete("Training is complete: PSNR 31.3 dB.")
        assert server.outcome_sent.is_set()
        server.close()
        browser.wait_for("$('outcome').textContent.includes('PSNR 31.3 dB')")
        time.sleep(3)  # the browser asks again, and its page is no error
        assert browser.evaluate("$('message').textContent + page.scene.version") == "1"
        again = PageServer("localhost", int(server.url.rpartition(":")[2]))
        again.open("<!DOCTYPE html><title>final</title>", is_final=True)
        again.complete("The final page is ready.")
        browser.wait_for("$('outcome').querySelector('a') !== null")
        browser.evaluate("$('outcome').querySelector('a').click()")
        browser.wait_for("document.title === 'final'")
        again.close()


@pytest.mark.slow
def test_training_serves_its_model(train_here: Runner, tiny_run: list[str], server: PageServer, tmp_path: Path) -> None:
    options = [option for option in tiny_run if "smoothing" not in option] + ["medium=sdf_grid"]
    options += ["trainer.max_steps=2", "viewer=true", f"hydra.run.dir={tmp_path / 'run'}"]
    done = train_here(*options, "viewer_port=0")
    assert re.search(r"^nerfro: the model as it learns: http://localhost:\d+$", done.out, re.MULTILINE)
    taken = [f"hydra.run.dir={tmp_path / 'taken'}", f"viewer_port={server.url.rpartition(':')[2]}"]
    assert "is not available" in train_here(*options, *taken, code=1).error
    voxels = [*options[-3:-1], f"hydra.run.dir={tmp_path / 'voxels'}", "viewer_port=0"]
    assert "an interactive page shows bodies with a surface" in train_here(*tiny_run, *voxels, code=1).error

"""Input on a page: pointers, fingers, keys and dropped files."""

import json
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch

from nerfro.evaluation.image_metrics import psnr
from nerfro.files import lat_long
from nerfro.viewing.page import make_page
from nerfro.viewing.trained_scene import TrainedScene
from tests.viewing.browser import Browser, needs_chromium
from tests.viewing.conftest import make_scene
from tests.viewing.test_page import SHOT, one_ray, picture

pytestmark = needs_chromium
VIEW = "({ azimuth: page.orbit.azimuth, elevation: page.orbit.elevation, radius: page.orbit.radius, " \
       "target: page.orbit.target, camera: page.camera, rays: page.rays })"  # fmt: skip


@pytest.fixture(scope="module")
def page() -> str:
    return make_page(make_scene(), 24)


@pytest.fixture
def browser(page: str, tmp_path: Path) -> Iterator[Browser]:
    with Browser(page, tmp_path, size=(800, 400)) as browser:
        yield browser


PLACE = "(({ x, y, width, height }) => ({ x, y, width, height }))($('canvas').getBoundingClientRect())"


def middle(browser: Browser) -> tuple[float, float]:
    place = browser.evaluate(PLACE)
    return place["x"] + place["width"] / 2, place["y"] + place["height"] / 2


def test_pointer_turns_moves_and_zooms(browser: Browser) -> None:
    x, y = middle(browser)
    side = browser.evaluate("Math.min($('canvas').clientWidth, $('canvas').clientHeight)")
    start = browser.evaluate(VIEW)
    browser.drag((x, y), (x + 0.1 * side, y + 0.05 * side))
    turned = browser.evaluate(VIEW)
    assert turned["azimuth"] == pytest.approx(start["azimuth"] - 0.4, abs=0.03)
    assert turned["elevation"] == pytest.approx(start["elevation"] + 0.2, abs=0.03)
    assert turned["radius"] == start["radius"]
    # Something new is drawn.
    browser.wait_for("page.rays > 0")
    browser.drag((x, y), (x + 0.1 * side, y), button="right")
    moved = browser.evaluate(VIEW)
    assert moved["azimuth"] == turned["azimuth"]
    assert torch.dist(torch.tensor(moved["target"]), torch.tensor(turned["target"])) == pytest.approx(
        0.1 * moved["radius"], rel=0.05
    )
    browser.wheel((x, y), -100)
    browser.wait_for(f"page.orbit.radius < 0.9 * {moved['radius']}")
    browser.wheel((x, y), 100)
    browser.wait_for(f"Math.abs(page.orbit.radius / {moved['radius']} - 1) < 1e-6")


def test_fingers_turn_and_pinch(browser: Browser) -> None:
    x, y = middle(browser)
    side = browser.evaluate("Math.min($('canvas').clientWidth, $('canvas').clientHeight)")
    start = browser.evaluate(VIEW)
    browser.touch([(x, y)], [(x - 0.05 * side, y)], [(x - 0.1 * side, y)])
    turned = browser.evaluate(VIEW)
    assert turned["azimuth"] == pytest.approx(start["azimuth"] + 0.4, abs=0.03)
    near, far = [(x - 20, y), (x + 20, y)], [(x - 40, y), (x + 40, y)]
    browser.touch(near, far)
    pinched = browser.evaluate(VIEW)
    assert pinched["radius"] == pytest.approx(start["radius"] / 2, rel=0.05)
    assert pinched["azimuth"] == turned["azimuth"]


def test_keys_turn_zoom_and_go_back(browser: Browser) -> None:
    browser.evaluate("$('canvas').focus()")
    start = browser.evaluate(VIEW)
    for key in ("ArrowLeft", "ArrowUp", "+"):
        browser.press(key)
    changed = browser.evaluate(VIEW)
    assert changed["azimuth"] == pytest.approx(start["azimuth"] - 0.1)
    assert changed["elevation"] == pytest.approx(start["elevation"] + 0.1)
    assert changed["radius"] == pytest.approx(0.9 * start["radius"])
    for key in ("ArrowRight", "ArrowDown", "-"):
        browser.press(key)
    back = browser.evaluate(VIEW)
    assert back["azimuth"] == pytest.approx(start["azimuth"])
    assert back["radius"] == pytest.approx(start["radius"])
    browser.press("0")
    assert browser.evaluate("page.orbit.azimuth") == 0.6


def test_test_camera_is_selected_with_the_keyboard_and_left_by_dragging(browser: Browser) -> None:
    browser.evaluate("document.querySelector('#cameras button[value=\"1\"]').focus()")
    browser.press(" ")
    chosen = browser.evaluate(VIEW)
    assert chosen["camera"] == 1
    assert not browser.evaluate("$('photograph').hidden")
    x, y = middle(browser)
    browser.drag((x, y), (x + 20, y))
    assert browser.evaluate("page.camera") is None
    assert browser.evaluate("$('photograph').hidden")


def test_selected_camera_is_applied_before_the_next_frame(browser: Browser) -> None:
    browser.wait_for("page.rays > 0")
    at_once = browser.evaluate(f"(page.show(1), {PLACE})")
    browser.wait_for("page.rays > 0")
    assert browser.evaluate(PLACE) == at_once
    back_at_once = browser.evaluate(f"(page.show(null), {PLACE})")
    browser.wait_for("page.rays > 0")
    assert browser.evaluate(PLACE) == back_at_once
    assert back_at_once["width"] > at_once["width"]


@pytest.mark.parametrize("suffix", [".png", ".hdr"])
def test_dropped_image_replaces_the_sky(browser: Browser, scene: TrainedScene, suffix: str, tmp_path: Path) -> None:
    directions = lat_long.directions(64)
    lat_long.save_lat_long(tmp_path / f"sky{suffix}", 0.5 + 0.3 * directions.roll(1, -1))
    before = picture(browser.evaluate(f"(() => {{ {SHOT} return shot(0, 32); }})()"))
    browser.drop(tmp_path / f"sky{suffix}", middle(browser))
    browser.wait_for("page.tracer.skyIsPicture")
    assert browser.evaluate("$('message').textContent") == ""
    after = picture(browser.evaluate(f"(() => {{ {SHOT} return shot(0, 32); }})()"))
    expected = one_ray(scene.with_(sky=tmp_path / f"sky{suffix}"))[0]
    assert float(psnr(after, expected)) > 30
    assert float(psnr(before, expected)) < 25
    browser.evaluate("$('own-sky').click()")
    assert not browser.evaluate("page.tracer.skyIsPicture")


def test_dropped_file_without_an_image_is_reported(browser: Browser, tmp_path: Path) -> None:
    (tmp_path / "notes.hdr").write_text(json.dumps("no picture"))
    browser.drop(tmp_path / "notes.hdr", middle(browser))
    browser.wait_for("$('message').textContent.startsWith('notes.hdr cannot be shown as a sky')")
    assert not browser.evaluate("page.tracer.skyIsPicture")

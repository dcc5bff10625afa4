"""Input on a page: pointers, fingers, keys and dropped files."""

import html
import json
import math
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch
from PIL import Image

from nerfro.evaluation.image_metrics import psnr
from nerfro.files import lat_long
from nerfro.viewing.camera_paths import CaptureGeometry, read_cameras
from nerfro.viewing.page import make_page
from nerfro.viewing.trained_scene import TrainedScene
from tests.conftest import Runner
from tests.viewing.browser import SHOT, Browser, needs_chromium
from tests.viewing.conftest import make_scene
from tests.viewing.test_page import one_ray, picture

pytestmark = needs_chromium
VIEW = "({ azimuth: page.orbit.azimuth, elevation: page.orbit.elevation, radius: page.orbit.radius, " \
       "target: page.orbit.target, camera: page.camera })"  # fmt: skip


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
    browser.wait_for("page.drafted")
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
    browser.evaluate(
        """$('canvas').dispatchEvent(new KeyboardEvent("keydown", { key: "ArrowRight", shiftKey: true }))"""
    )
    moved = browser.evaluate(VIEW)
    assert moved["azimuth"] == pytest.approx(start["azimuth"])
    shift = torch.dist(torch.tensor(moved["target"]), torch.tensor(start["target"]))
    assert shift == pytest.approx(0.05 * start["radius"], rel=1e-4)
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


def test_view_is_compared_with_its_photograph(browser: Browser) -> None:
    grey = """((level) => { const canvas = new OffscreenCanvas(8, 8), context = canvas.getContext("2d");
      context.fillStyle = `rgb(${level},${level},${level})`; context.fillRect(0, 0, 8, 8);
      return Object.assign(canvas, { naturalWidth: 8, naturalHeight: 8 }); })"""
    assert browser.evaluate(f"psnr({grey}(100), {grey}(110))") == pytest.approx(20 * math.log10(25.5), abs=1e-4)
    assert browser.evaluate("$('difference').disabled")
    browser.evaluate("page.show(1)")
    browser.wait_for("/PSNR [1-9][0-9]?\\.[0-9] dB/.test($('rendering').textContent)")
    browser.evaluate("$('difference').click()")
    corners = "(({ left, top, width, height }) => [left, top, width, height])"
    rendering, photograph = (
        browser.evaluate(f"{corners}($('{name}').getBoundingClientRect())") for name in ("canvas", "photograph")
    )
    assert rendering == pytest.approx(photograph, abs=1)
    blend = "getComputedStyle($('photograph').parentElement).mixBlendMode"
    assert browser.evaluate(blend) == "difference"
    browser.evaluate("page.show(null)")
    assert browser.evaluate(f"[{blend}, $('difference').getAttribute('aria-pressed')]") == ["normal", "false"]


def test_overview_shows_the_whole_object_from_any_view(browser: Browser) -> None:
    browser.evaluate("page.show(1)")
    browser.evaluate("$('reset').click()")
    view = browser.evaluate(VIEW)
    assert (view["camera"], view["azimuth"], view["elevation"]) == (None, 0.6, 0.35)
    # The sphere around the object is inside of the field of view, 0.7 radians.
    radius = browser.evaluate("page.scene.orbit.radius")
    assert math.asin(radius / view["radius"]) < 0.35
    assert browser.evaluate("page.orbit.target") == browser.evaluate("page.scene.orbit.target")


def test_address_restores_view_and_settings(page: str, tmp_path: Path) -> None:
    (tmp_path / "scene.html").write_text(page, encoding="utf-8")
    address = (tmp_path / "scene.html").as_uri()
    with Browser(address, tmp_path, size=(400, 300)) as browser:
        browser.evaluate("""(() => {
          page.orbit.turn(0.3, 0.1);
          page.show(2);
          page.setDifference(true);
          page.film.setKeys([page.orbit.numbers(), [1, 0.5, 4, 0, 0, 0, 0.7]]);
          $("straight").value = 0.25;
          $("ior0").value = 1.75;
          $("ior0").dispatchEvent(new Event("input", { bubbles: true }));
        })()""")
        browser.wait_for("location.hash.includes('ior0')")
        before, text = browser.evaluate(VIEW), browser.evaluate("location.hash")
    with Browser(address + text, tmp_path, size=(400, 300)) as browser:
        after = browser.evaluate(VIEW)
        assert after.pop("target") == pytest.approx(before.pop("target"), abs=1e-5)
        assert after == pytest.approx(before, rel=1e-5)
        assert after["camera"] == 2
        assert browser.evaluate("page.isDifference && $('keys').children.length") == 2
        assert browser.evaluate("page.film.keys[1]") == [1, 0.5, 4, 0, 0, 0, 0.7]
        assert browser.evaluate("[$('straight').value, $('ior0').value, $('ior0-value').value]") == [
            "0.25",
            "1.75",
            "1.75",
        ]


def test_saved_view_is_rendered_by_nerfro(browser: Browser, scene: TrainedScene, tmp_path: Path) -> None:
    script = f"""(() => {{ {SHOT}
      page.orbit.turn(0.5, 0.2);
      const saved = shot(null, 40);
      return [saved, cameraFile([page.view], page.scene.origin)];
    }})()"""
    shot, document = browser.evaluate(script)
    (tmp_path / "view.json").write_text(json.dumps(document))
    cameras = read_cameras(tmp_path / "view.json", CaptureGeometry.of(scene.cameras("train"), scene.bounds))
    assert (cameras.width, cameras.height) == (40, 40)
    assert float(psnr(picture(shot), one_ray(scene, cameras)[0])) > 30
    assert (
        browser.evaluate("""new Promise((done) => {
      HTMLAnchorElement.prototype.click = function () { done(this.download); };
      $("save-picture").click();
    })""")
        == "picture.png"
    )


def save(browser: Browser, button: str, file: Path) -> None:
    """Press a button that downloads a file."""
    browser.call("Page.setDownloadBehavior", behavior="allow", downloadPath=str(file.parent))
    browser.evaluate(f"$('{button}').click()")
    deadline = time.monotonic() + 20
    while not file.is_file():
        assert time.monotonic() < deadline, file
        time.sleep(0.05)


@pytest.mark.slow
def test_film_of_key_views_is_played_saved_and_rendered(
    page: str, scene: TrainedScene, run_here: Runner, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("nerfro.pipeline.render.load", lambda run, device, root: scene)
    (tmp_path / "a.ckpt").write_bytes(b"scene")
    monkeypatch.chdir(tmp_path)
    with Browser(page, tmp_path, size=(400, 300)) as browser:
        assert browser.evaluate("[$('play').disabled, $('save-film').disabled, $('time').disabled]") == [True] * 3
        # A view of the data set, then a turn of more than a full circle, whose shorter way is taken.
        browser.evaluate("page.show(1), $('add-key').click()")
        first = browser.evaluate("page.orbit.numbers()")
        browser.evaluate("page.orbit.turn(-2 * Math.PI - 0.5, 0.2), page.orbit.zoom(0.8), $('add-key').click()")
        keys = browser.evaluate("page.film.keys")
        assert keys[1][0] - keys[0][0] == pytest.approx(0.5)
        browser.evaluate("$('keys').children[0].click()")
        assert browser.evaluate("page.orbit.numbers()") == pytest.approx(first)
        # The film goes on from the selected time, and stops at the last key view.
        browser.evaluate("page.film.seek(1.5), $('play').click()")
        browser.wait_for("$('time').value > 1.5 && $('play').ariaPressed === 'true'")
        browser.wait_for("$('time').value === '2' && $('play').ariaPressed === 'false' && page.motion === null")
        assert browser.evaluate("page.orbit.numbers()") == pytest.approx(keys[1])
        save(browser, "save-film", tmp_path / "film.json")
        shown = browser.evaluate("page.view")
    options = [
        "checkpoint=a.ckpt",
        f"path={tmp_path / 'film.json'}",
        "resolution=8",
        "film=[gif]",
        "subdivision.side=1",
    ]
    run_here("render", *options, f"out={tmp_path / 'O'}")
    with Image.open(tmp_path / "O" / "film.gif") as gif:
        assert gif.n_frames == len(list((tmp_path / "O").glob("frame_*.png"))) == 49
        assert gif.info["duration"] == 40, "two seconds, as the file states"
    cameras = read_cameras(tmp_path / "film.json", CaptureGeometry.of(scene.cameras("train"), scene.bounds))
    assert cameras.camera_to_world[-1, :, 3].tolist() == pytest.approx(shown["eye"], abs=1e-5)
    assert float(cameras.fy[-1]) == pytest.approx(shown["focal"][1], rel=1e-5)
    step = torch.linalg.vector_norm(cameras.camera_to_world[..., 3].diff(dim=0), dim=-1)
    assert step.max() < 2 * step.mean(), "the camera moves evenly"


def test_splines_pass_through_the_key_views_and_stay_possible(browser: Browser) -> None:
    views = [
        [0, 1.5, 10, 0, 0, 0, 0.9],
        [1, 1.55, 0.5, 1, 0, 0, 0.1],
        [2, 1.55, 0.5, 1, 0, 0, 0.1],
        [3, 0, 9, 0, 0, 0, 1],
    ]
    browser.evaluate(f"page.film.setKeys({json.dumps(views)})")
    for number, view in enumerate(views):
        assert browser.evaluate(f"page.film.at({2 * number})") == pytest.approx(view)
    between = browser.evaluate("Array.from({ length: 60 }, (_, i) => page.film.at(i / 10))")
    assert all(abs(view[1]) <= 1.55 and view[2] > 0.2 and view[6] > 0.05 for view in between)


def test_turntable_turns_until_the_view_is_dragged(browser: Browser) -> None:
    start = browser.evaluate(VIEW)
    browser.evaluate("$('turn').focus()")
    browser.press(" ")
    browser.wait_for(f"page.orbit.azimuth > {start['azimuth']} + 0.05")
    assert browser.evaluate("$('turn').ariaPressed") == "true"
    browser.evaluate("page.writeAddress()")
    assert "turn=1" in browser.evaluate("location.hash")
    x, y = middle(browser)
    browser.drag((x, y), (x + 20, y))
    turned = browser.evaluate(VIEW)
    assert turned["elevation"] == start["elevation"]
    assert browser.evaluate("page.motion === null && $('turn').ariaPressed === 'false'")
    browser.wait_for("page.rays > 0")
    assert browser.evaluate(VIEW) == turned


def test_embed_code_shows_the_page_in_its_state(browser: Browser) -> None:
    script = """(async () => {
      page.orbit.turn(0.25, 0);
      const copied = new Promise((done) => { navigator.clipboard.writeText = async (code) => done(code); });
      $("copy-code").click();
      return await copied;
    })()"""
    code = browser.evaluate(script)
    azimuth = browser.evaluate("page.orbit.azimuth.toPrecision(6)")
    assert code.startswith('<iframe src="page.html#view=')
    assert f"#view={float(azimuth):g}," in code
    assert 'title="Scene | nerfro"' in code
    browser.wait_for("$('notice').textContent.includes('clipboard')")


def test_page_in_a_frame_waits_for_a_click_and_leaves_the_wheel(page: str, tmp_path: Path) -> None:
    frame = f'<!DOCTYPE html><title>t</title><iframe width=380 height=280 srcdoc="{html.escape(page)}"></iframe>'
    inside = "document.querySelector('iframe').contentWindow"
    with Browser(frame, tmp_path, size=(420, 320)) as browser:
        browser.wait_for(f"{inside}.document.getElementById('begin')?.hidden === false")
        assert browser.evaluate(f"{inside}.eval('page === null && $(`poster`).naturalWidth > 0')")
        assert not browser.evaluate(f"{inside}.document.getElementById('controls').open")
        browser.evaluate(f"{inside}.document.getElementById('begin').click()")
        browser.wait_for(f"{inside}.eval('page !== null && page.drafted')")
        radius = browser.evaluate(f"{inside}.eval('page.orbit.radius')")
        browser.wheel((200, 150), -100)
        assert browser.evaluate(f"{inside}.eval('$(`canvas`).style.touchAction')") == "pan-y"
        assert browser.evaluate(f"{inside}.eval('page.orbit.radius')") == radius
        browser.evaluate(f"{inside}.eval('$(`canvas`).focus()')")
        browser.wheel((200, 150), -100)
        browser.wait_for(f"{inside}.eval('page.orbit.radius') < {radius}")


def test_narrow_window_begins_with_a_closed_panel_and_large_targets(page: str, tmp_path: Path) -> None:
    with Browser(page, tmp_path, size=(500, 600)) as browser:
        assert not browser.evaluate("$('controls').open")
        browser.evaluate("$('controls').open = $('more').open = true, $('add-key').click()")
        small = """[...document.querySelectorAll("button, input:not([type=file]), summary")].filter((e) => {
          const { width, height } = e.getBoundingClientRect();
          return width && (width < 24 || height < 24);
        }).map((e) => e.id)"""
        assert browser.evaluate(small) == []
        assert browser.evaluate("document.querySelectorAll('h1').length") == 1
        assert browser.evaluate("$('canvas').getAttribute('role')") == "application"
        # Nothing that changes with every frame is read aloud.
        assert not browser.evaluate("$('frame').matches('output, [role=status], [aria-live]')")


def test_selected_camera_is_applied_before_the_next_frame(browser: Browser) -> None:
    browser.wait_for("page.drafted")
    at_once = browser.evaluate(f"(page.show(1), {PLACE})")
    browser.wait_for("page.drafted")
    assert browser.evaluate(PLACE) == at_once
    back_at_once = browser.evaluate(f"(page.show(null), {PLACE})")
    browser.wait_for("page.drafted")
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

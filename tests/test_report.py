import base64
import io
import json
import re
import shutil
import xml.etree.ElementTree as ElementTree
from pathlib import Path
from urllib.parse import unquote

import numpy as np
import pytest
import torch
from PIL import Image

from nerfro.evaluation.image_metrics import image_metrics
from nerfro.evaluation.results import RunMetrics, write_metrics_json
from nerfro.evaluation.scoring import ImageMetrics
from nerfro.files.images import load_png, save_png
from nerfro.registry.registration import discover
from nerfro.report.comparison import compare, to_table
from nerfro.report.page import Selection, embed_image, report_page, scene_images
from nerfro.report.runs import find_runs
from tests.conftest import refused
from tests.test_summary import write_run
from tests.viewing.browser import Browser, needs_chromium

PSNR = image_metrics(["psnr"])


def write_scored_run(folder: Path, name: str, scene: Path, noise: float, num_views: int = 2) -> None:
    """A run folder whose pictures are the references of a scene with noise, scored."""
    write_run(folder, name, psnr=20.0, root=str(scene), max_time="00:00:00:20")
    metrics, scores = ImageMetrics(), []
    for view in range(num_views):
        reference = load_png(scene / "test" / f"r_{view}.png")
        prediction = (reference + noise * (1 + view) * torch.randn_like(reference)).clamp(0, 1)
        save_png(folder / "images" / f"test_{view:03d}.png", prediction)
        scores.append(metrics.score(f"test_{view:03d}", prediction, reference))
    write_metrics_json(folder / "metrics.json", RunMetrics(metrics.result(scores), 30, 20.0, 1000.0))


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory, tiny_scene: Path) -> Path:
    discover()
    root = tmp_path_factory.mktemp("runs")
    write_scored_run(root / "good", "good <b>", tiny_scene, 0.01)
    write_scored_run(root / "bad", "bad", tiny_scene, 0.2)
    return root


def page(runs: Path, unfinished: tuple[str, ...] = ()) -> str:
    comparisons = compare(find_runs([str(runs)])[0], {}, {})
    compared = [(comparison, to_table(comparison, PSNR, "full")) for comparison in comparisons]
    return report_page(compared, unfinished, Selection())


def test_figure_shows_the_view_of_the_median_score(runs: Path) -> None:
    (comparison,) = compare(find_runs([str(runs)])[0], {}, {})
    (scored,) = comparison.scenes
    pictures = scene_images(comparison, scored, Selection(1))
    # View 1 has twice the noise; of two views the lower score is the lower median.
    assert pictures.figure.index == 1
    assert [view.index for view in pictures.views] == [0, 1]
    assert list(pictures.methods.values()) == ["good <b>", "bad"], "the best first"
    assert all(comparison.methods[number] == title for number, title in pictures.methods.items())


def test_small_images_are_embedded_bit_for_bit_and_large_ones_as_jpeg(runs: Path) -> None:
    file = runs / "bad" / "images" / "test_000.png"
    kind, encoded = embed_image(load_png(file)).split(",")
    assert kind == "data:image/png;base64"
    assert np.array_equal(np.array(Image.open(io.BytesIO(base64.b64decode(encoded)))), np.array(Image.open(file)))
    assert embed_image(torch.zeros(8, 300, 3)).startswith("data:image/jpeg;base64,")


def test_page_is_self_contained_with_valid_internal_links(runs: Path) -> None:
    html = page(runs, unfinished=("x has not been evaluated",))
    loaded = re.findall(r"\b(?:src|href|data)=\"([^\"]*)\"", html)
    assert loaded
    assert all(link.startswith(("data:image/", "#")) for link in loaded)
    assert "@import" not in html
    assert "url(" not in html
    ids = re.findall(r"\bid=\"([^\"]*)\"", html)
    assert len(ids) == len(set(ids))
    assert {link[1:] for link in loaded if link.startswith("#")} <= set(ids)
    assert "good &lt;b&gt;" in html
    assert "≥ 0.05" in html
    assert "good <b>" not in html
    assert "x has not been evaluated" in html
    assert "<dt>command</dt>" in html
    assert "max_time: 00:00:00:20" in html


def test_page_links_to_the_page_of_each_run(runs: Path, tmp_path: Path) -> None:
    shutil.copytree(runs, tmp_path / "my runs")
    (tmp_path / "my runs" / "good" / "index.html").write_text("a run")
    comparisons = compare(find_runs([str(tmp_path / "my runs")])[0], {}, {})
    compared = [(comparison, to_table(comparison, PSNR, "full")) for comparison in comparisons]
    html = report_page(compared, (), Selection(), folder=tmp_path / "report")
    links = [unquote(link) for link in re.findall(r'href="([^"#:]+)"', html)]
    assert [(tmp_path / "report" / link).resolve() for link in links] == [tmp_path / "my runs" / "good" / "index.html"]


def test_page_shows_further_pictures(runs: Path, tmp_path: Path) -> None:
    save_png(tmp_path / "crops <1>.png", torch.rand(8, 9, 3))
    comparisons = compare(find_runs([str(runs)])[0], {}, {})
    compared = [(comparison, to_table(comparison, PSNR, "full")) for comparison in comparisons]
    html = report_page(compared, (), Selection(), [tmp_path / "crops <1>.png"])
    assert embed_image(load_png(tmp_path / "crops <1>.png")) in html
    assert "crops &lt;1&gt;.png</figcaption>" in html
    assert 'href="#pictures"' in html
    assert 'id="pictures"' not in page(runs)


def test_page_without_the_data_set_shows_the_other_parts(runs: Path, tmp_path: Path) -> None:
    moved = tmp_path / "runs"
    shutil.copytree(runs, moved)
    for config in moved.glob("*/config.yaml"):
        config.write_text(re.sub(r"root: .*", "root: /nowhere/scene", config.read_text()))
    html = page(moved)
    assert "The images cannot be shown" in html
    assert "/nowhere/scene" in html
    assert "<image" not in html
    assert "max_time" in html


def test_images_of_another_data_set_are_refused(runs: Path, tmp_path: Path, tiny_scene: Path) -> None:
    (comparison,) = compare(find_runs([str(runs)])[0], {}, {})
    (scored,) = comparison.scenes
    changed = tmp_path / "scene"
    shutil.copytree(tiny_scene, changed)
    manifest = json.loads((changed / "transforms_test.json").read_text())
    manifest["frames"].pop()
    (changed / "transforms_test.json").write_text(json.dumps(manifest))
    for run in comparison.runs:
        run.config["data"]["root"] = str(changed)  # type: ignore[index]
    refused("has changed since these views", scene_images, comparison, scored, Selection())


def test_runs_that_score_only_the_first_views_show_them(runs: Path, tmp_path: Path) -> None:
    scene = Path(find_runs([str(runs)])[0][0].config["data"]["root"])
    write_scored_run(tmp_path / "few", "few", scene, 0.1, num_views=1)
    (comparison,) = compare(find_runs([str(tmp_path)])[0], {}, {})
    comparison.runs[0].config["trainer"]["limit_test_batches"] = 1  # type: ignore[index]
    (scored,) = comparison.scenes
    assert len(scene_images(comparison, scored, Selection()).views) == 1


def test_each_budget_has_a_table_with_medals_in_text(tmp_path: Path) -> None:
    for time in ("00:00:00:20", "00:00:01:00"):
        for name, psnr in (("a <b>", 20.0), ("b", 25.0)):
            write_run(tmp_path / f"{name[0]}{time[6:8]}", name, psnr, max_time=time)
    html = page(tmp_path)
    tables = [ElementTree.fromstring(text) for text in re.findall(r"<table>.*?</table>", html, re.DOTALL)]
    budgets = [text.split(" on ")[0] for text in re.findall(r"<h2[^>]*>(.*)</h2>", html)]
    assert budgets == ["Budget: at most 20 s", "Budget: at most 1 min"]
    assert all("Budget" not in table.findtext("caption", "Budget") for table in tables)
    for table in tables:
        assert [(th.text, th.get("colspan")) for th in table.findall(".//th[@scope='colgroup']")] == [("torus", "1")]
        assert [th.text for th in table.findall(".//th[@scope='row']")] == ["a <b>", "b"]
        cells = table.findall(".//tbody//td")
        assert ["".join(td.itertext()) for td in cells] == ["20.00 silver", "25.00 gold"]
        assert [td.get("class") for td in cells] == ["silver", "gold"]


# What a reader sees at first, after moving the border, and with another view and other sides.
PROBE = """(() => {
const stage = document.querySelector(".slider"), form = stage.querySelector("form").elements, seen = [];
const box = element => element.getBoundingClientRect();
const look = () => seen.push({
  left: stage.querySelector("svg.left use").getAttribute("href"),
  right: stage.querySelector("svg.right use").getAttribute("href"),
  clip: getComputedStyle(stage.querySelector("svg.left")).clipPath,
  border: (box(stage.querySelector(".border")).x - box(stage.querySelector(".stage")).x)
    / box(stage.querySelector(".stage")).width,
});
const set = (control, value) => { control.value = value; control.dispatchEvent(new Event("input", {bubbles: true})); };
look();
set(form.border, 80); look();
set(form.view, 0); set(form.left, "p0"); set(form.right, "e1"); look();
return seen;
})()"""


@needs_chromium
def test_slider_in_a_browser(runs: Path, tmp_path: Path) -> None:
    with Browser(page(runs), tmp_path, size=(500, 900)) as browser:
        start, moved, other = browser.evaluate(PROBE)
    assert (start["left"], start["right"]) == ("#b0s0v1r", "#b0s0v1p1")
    assert (start["border"], moved["border"]) == pytest.approx((0.5, 0.8), abs=0.01)
    assert start["clip"] != moved["clip"]
    assert (other["left"], other["right"]) == ("#b0s0v0p0", "#b0s0v0e1")

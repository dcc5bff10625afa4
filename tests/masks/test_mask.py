"""`python -m nerfro.mask` on a coloured ball before a textured floor."""

import functools
import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image
from PIL.PngImagePlugin import PngInfo
from scipy.ndimage import gaussian_filter

pytest.importorskip("cv2")

from nerfro.core.cameras import Cameras
from nerfro.data.formats.transforms import OpenCVData
from nerfro.data.masks import method_of
from nerfro.masks import mask_files
from nerfro.masks.masking import polygon_mask, propagate
from tests.forked import Command
from tests.sheet_photographs import look_at
from tests.viewing.browser import Browser, needs_chromium

WIDTH, HEIGHT, FOCAL, NUM_VIEWS = 96, 72, 115.0, 14
CENTRE, RADIUS = np.array([0.05, -0.03, 0.3]), 0.28


@pytest.fixture(scope="module")
def photographs() -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Picture, silhouette and pose of each view."""
    generator = np.random.default_rng(0)
    noise = np.stack([gaussian_filter(generator.normal(size=(64, 64)), 1.2) for _ in range(3)], -1)
    texture = np.clip(110 + 160 * noise, 0, 255)
    column, row = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    local = np.stack([(column - WIDTH / 2) / FOCAL, (row - HEIGHT / 2) / FOCAL, np.ones_like(row)], -1)
    local /= np.linalg.norm(local, axis=-1, keepdims=True)
    views = []
    for view in range(NUM_VIEWS):
        azimuth, up = 2 * np.pi * view / NUM_VIEWS, generator.uniform(0.35, 1.0)
        towards = np.array([np.cos(azimuth) * np.cos(up), np.sin(azimuth) * np.cos(up), np.sin(up)])
        pose = look_at(CENTRE + 2.2 * towards, CENTRE + generator.normal(0, 0.06, 3))
        directions, offset = local @ pose[:, :3].T, pose[:, 3] - CENTRE
        along = directions @ offset
        inside = along**2 - offset @ offset + RADIUS**2
        mask = inside > 0
        floor = pose[:2, 3] - directions[..., :2] * (pose[2, 3] / np.minimum(directions[..., 2:], -1e-3))
        place = np.clip((floor + 4) * 63 / 8, 0, 63).astype(int)
        picture = texture[place[..., 0], place[..., 1]].copy()
        normal = (offset + directions * (-along - np.sqrt(np.maximum(inside, 0)))[..., None]) / RADIUS
        shade = 0.45 + 0.55 * np.clip(normal @ np.array([0.4, 0.3, 0.85]), 0, 1)
        picture[mask] = (np.array([200, 60, 40]) * shade[..., None])[mask]
        picture += generator.normal(0, 3, picture.shape)
        views.append((np.uint8(np.clip(picture, 0, 255)), mask, pose))
    return views


def write_capture(root: Path, photographs: list[tuple[np.ndarray, np.ndarray | None, np.ndarray]]) -> Path:
    """The photographs as a data set in OpenCV's format, without masks, in three splits."""
    splits: dict[str, list[dict]] = {"train": [], "val": [], "test": []}
    (root / "photos").mkdir(parents=True)
    for view, (picture, _, pose) in enumerate(photographs):
        Image.fromarray(picture).save(root / "photos" / f"p_{view}.png")
        frame = {"file_path": f"photos/p_{view}.png", "transform_matrix": [*pose.tolist(), [0, 0, 0, 1]]}
        splits["test" if view % 7 == 0 else "val" if view % 7 == 3 else "train"].append(frame)
    matrix = [[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]]
    for split, frames in splits.items():
        (root / f"transforms_{split}.json").write_text(json.dumps({"cam_mat": matrix, "frames": frames}))
    return root


@pytest.fixture
def capture(tmp_path: Path, photographs: list[tuple[np.ndarray, np.ndarray, np.ndarray]]) -> Path:
    return write_capture(tmp_path / "capture", photographs)


@pytest.fixture
def mask(capture: Path, command: Callable[..., str]) -> Callable[..., str]:
    """`nerfro.mask` on the capture."""
    return functools.partial(command, "mask", f"data.root={capture}")


def box_around(mask: np.ndarray, margin: int) -> list[int]:
    rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
    numbers = columns[0] - margin, rows[0] - margin, columns[-1] + 1 + margin, rows[-1] + 1 + margin
    return [int(number) for number in numbers]


def overlap(one: np.ndarray, other: np.ndarray) -> float:
    return float((one & other).sum() / (one | other).sum())


def read(root: Path, view: int) -> np.ndarray:
    with Image.open(root / "photos" / f"mask_p_{view}.png") as image:
        levels = np.asarray(image)
    assert set(np.unique(levels)) == {0, 255}
    return levels > 127


@pytest.mark.slow
def test_one_box_produces_all_masks(tmp_path: Path, photographs: list, command: Callable[..., str]) -> None:
    picture, _, pose = photographs[0]
    away = picture, None, pose * [-1, 1, -1, 1]
    capture = write_capture(tmp_path / "capture", [*photographs, away])
    box = str(box_around(photographs[1][1], 3)).replace(" ", "")
    printed = command("mask", f"data.root={capture}", f"outlines={{p_1:{box}}}")
    overlaps = [overlap(read(capture, view), mask) for view, (_, mask, _) in enumerate(photographs)]
    assert min(overlaps) > 0.9, overlaps
    assert np.mean(overlaps) > 0.95
    assert f"views that do not show the object: photos/p_{NUM_VIEWS}.png" in printed
    assert method_of(capture / "photos" / f"mask_p_{NUM_VIEWS}.png") == "visual hull"
    assert "next: python -m nerfro.preprocess data=opencv" in printed
    # The loader finds them, for all splits.
    for split in ("train", "val", "test"):
        assert OpenCVData(str(capture)).load(split).masks is not None
    with Image.open(capture / "masks.png") as sheet:
        assert sheet.size[0] > 6 * 220


def test_existing_masks_are_kept_and_guide_the_others(
    capture: Path, photographs: list, mask: Callable[..., str]
) -> None:
    drawn = {view: photographs[view][1].copy() for view in (0, 3, 5, 8, 11)}
    drawn[3][:2, :2] = True  # known again
    for view, silhouette in drawn.items():
        Image.fromarray(np.uint8(200 * silhouette)).save(capture / "photos" / f"mask_p_{view}.png")
    before = {view: (capture / "photos" / f"mask_p_{view}.png").read_bytes() for view in drawn}
    assert "delete the mask, or set overwrite=true" in mask("outlines={p_0:[1,1,9,9]}")
    assert "5 existing masks" in mask()
    for view, (_, silhouette, _) in enumerate(photographs):
        if view in drawn:
            assert (capture / "photos" / f"mask_p_{view}.png").read_bytes() == before[view]
        else:
            assert overlap(read(capture, view), silhouette) > 0.9
    assert "5 existing masks" in mask()  # projections are made again


def test_two_outlines_of_a_body_of_revolution_give_all_masks_for_any_colours() -> None:
    width, height, num_views, focal = 288, 216, 8, 345.0
    azimuth = torch.arange(num_views) * 2 * torch.pi / num_views
    towards = [np.array([np.cos(turn) * 0.8, np.sin(turn) * 0.8, 0.6]) for turn in azimuth.tolist()]
    poses = np.stack([look_at(CENTRE + 2.2 * direction, CENTRE) @ np.diag([1, -1, -1, 1]) for direction in towards])
    ones = torch.ones(num_views)
    cameras = Cameras(torch.from_numpy(poses).float(), focal * ones, focal * ones, width / 2 * ones, height / 2 * ones,
                      width=width, height=height, near=0.1, far=9.0)  # fmt: skip
    pixel = torch.cartesian_prod(torch.arange(num_views), torch.arange(height), torch.arange(width))
    rays = cameras.rays(*pixel.T)
    offset = rays.origins - torch.from_numpy(CENTRE).float()
    along = (rays.directions * offset).sum(-1)
    inside = along.square() - offset.square().sum(-1) + RADIUS**2 > 0
    masks = inside.view(num_views, height, width).numpy()
    noise = np.random.default_rng(0).integers(0, 256, (num_views, height, width, 3), np.uint8)
    found = propagate(list(noise), cameras, {view: masks[view] for view in (0, 3)})
    assert found.shape == "body of revolution"
    assert len(found.by_hull) == num_views - 2
    assert min(overlap(found.masks[view], masks[view]) for view in found.by_hull) > 0.95


def polygon_around(mask: np.ndarray, count: int = 24, scale: float = 1.0) -> list[list[float]]:
    """A regular polygon around the centre of a mask, for a scale of one of about its area."""
    angles, (rows, columns) = np.linspace(0, 2 * np.pi, count + 1)[:-1], np.nonzero(mask)
    radius, middle = scale * np.sqrt(len(rows) / np.pi), np.array([columns.mean() + 0.5, rows.mean() + 0.5])
    return (middle + radius * np.stack([np.cos(angles), np.sin(angles)], 1)).tolist()


def test_masks_of_a_network_are_marked_and_compared_with_their_hull(
    capture: Path, photographs: list, mask: Callable[..., str], monkeypatch: pytest.MonkeyPatch
) -> None:
    polygon, box, lost = polygon_around(photographs[1][1]), [10, 8, 80, 64], 3

    def track(model: Any, images: list, masks: dict, boxes: dict, progress: Callable[[], None]) -> dict:
        assert all(np.array_equal(image, photograph[0]) for image, photograph in zip(images, photographs, strict=True))
        assert (model, list(masks), boxes) == ("network", [1], {5: box})
        found = {view: silhouette for view, (_, silhouette, _) in enumerate(photographs) if view not in masks}
        return found | {lost: np.zeros_like(found[lost])}

    monkeypatch.setattr(mask_files, "load_tracker", lambda folder: "network")
    monkeypatch.setattr(mask_files, "track_object", track)
    printed = mask(f"outlines={{p_1:{polygon},p_5:{box}}}", "sam2=folder")
    assert "1 masks are projections of the visual hull" in printed
    assert np.array_equal(read(capture, 1), polygon_mask(polygon, (WIDTH, HEIGHT)))
    methods = [method_of(capture / "photos" / f"mask_p_{view}.png") for view in (1, 2, lost, 5)]
    assert methods == ["polygon", "sam2", "visual hull", "sam2"]
    assert np.array_equal(read(capture, 2), photographs[2][1])
    assert overlap(read(capture, lost), photographs[lost][1]) > 0.8
    assert "wrote 1 masks" in mask("hull_only=true"), "the others are kept"
    assert "sam2= segments all photographs" in mask("sam2=folder", "view=true")


def test_polygons_are_the_masks_of_their_views(capture: Path, photographs: list, mask: Callable[..., str]) -> None:
    polygons = {f"p_{view}": polygon_around(photographs[view][1]) for view in (1, 5, 9)}
    converted = {f"{name}.HEIC": polygon for name, polygon in polygons.items()}  # reconstruct converts photographs
    (capture / "outlines.json").write_text(json.dumps(converted))
    mask(f"outlines={capture / 'outlines.json'}", "hull_only=true")
    for name, polygon in polygons.items():
        assert np.array_equal(read(capture, int(name[2:])), polygon_mask(polygon, (WIDTH, HEIGHT)))
    assert min(overlap(read(capture, view), photographs[view][1]) for view in range(NUM_VIEWS)) > 0.7


def test_masks_are_kept_if_the_sides_of_downscaled_images_are_rounded(
    capture: Path, photographs: list, mask: Callable[..., str]
) -> None:
    for view in (1, 5, 9):
        Image.fromarray(np.uint8(255 * photographs[view][1])).save(capture / "photos" / f"mask_p_{view}.png")
    assert "3 existing masks" in mask("hull_only=true", "data.downscale=1.9")  # images of 51 x 38 pixels


def test_projections_are_recomputed_and_edited_masks_are_kept(
    capture: Path, photographs: list, mask: Callable[..., str]
) -> None:
    for view in (1, 5, 9):
        Image.fromarray(np.uint8(255 * photographs[view][1])).save(capture / "photos" / f"mask_p_{view}.png")
    assert "wrote 11 masks" in mask("hull_only=true")
    file = capture / "photos" / "mask_p_3.png"
    assert method_of(file) == "body of revolution"
    assert method_of(capture / "photos" / "mask_p_1.png") is None
    with Image.open(file) as image:
        edited, text = image.copy(), PngInfo()
    for key, value in edited.info.items():  # some programs keep the text
        text.add_text(key, value)
    edited.paste(255, (40, 30, 42, 32))
    edited.paste(0, (46, 34, 48, 36))
    edited.save(file, pnginfo=text)
    content = file.read_bytes()
    assert "wrote 10 masks" in mask("hull_only=true")
    assert file.read_bytes() == content


def test_polygon_covers_the_pixels_whose_centres_it_contains() -> None:
    square = [[2, 1], [7, 1], [7, 4], [2, 4]]
    expected = np.zeros((6, 9), bool)
    expected[1:4, 2:7] = True
    assert np.array_equal(polygon_mask(square, (9, 6)), expected)


def test_mistakes_are_reported_in_one_line(capture: Path, mask: Callable[..., str]) -> None:
    two_boxes = "outlines={p_0:[1,1,9,9],p_5:[1,1,9,9]}"
    assert "hull_only=true needs masks or outlines of at least 3" in mask(two_boxes, "hull_only=true")
    assert "no mask to start from" in mask()
    assert torch.is_grad_enabled()
    assert "q_1 is not an image of the data set; names" in mask("outlines={q_1:[1,1,9,9]}")
    assert "give a box [left,top,right,bottom]" in mask("outlines={p_1:[9,9,1,1]}")
    assert "p_1 crosses itself" in mask("outlines={p_1:[[1,1],[9,9],[9,1],[1,9]]}")
    assert "nothing.json does not exist" in mask("outlines=nothing.json")
    assert "is part of nerfro" in mask("data=blender", "data.root=embedded:torus")
    assert not list((capture / "photos").glob("mask_*"))


@pytest.mark.slow
def test_neighbour_at_the_same_position_does_not_guide_a_mask(
    photographs: list, tmp_path: Path, command: Callable[..., str]
) -> None:
    """Lines through the centres of two such masks meet anywhere, behind the cameras too."""
    picture, mask, pose = photographs[1]
    beside = np.roll(picture, -2, 1), np.roll(mask, -2, 1), pose.copy()
    beside[2][:, 3] += 0.004 * pose[:, 0]  # as if the ball were behind the cameras
    root = write_capture(tmp_path, [*photographs, beside])
    box = str(box_around(mask, 3)).replace(" ", "")
    printed = command("mask", f"data.root={root}", f"outlines={{p_1:{box}}}")
    assert "wrote 15 masks" in printed
    overlaps = [overlap(read(root, view), mask) for view, (_, mask, _) in enumerate([*photographs, beside])]
    assert np.mean(overlaps) > 0.9, overlaps


@pytest.mark.parametrize("hull_only", [False, True])
def test_hull_overrides_contradicting_colours(
    hull_only: bool, photographs: list, tmp_path: Path, command: Callable[..., str]
) -> None:
    noise = np.random.default_rng(0).integers(0, 256, (NUM_VIEWS, HEIGHT, WIDTH, 3), np.uint8)
    root = write_capture(tmp_path, [(noise[view], None, pose) for view, (_, _, pose) in enumerate(photographs)])
    for view in range(0, NUM_VIEWS, 2):
        Image.fromarray(np.uint8(255 * photographs[view][1])).save(root / "photos" / f"mask_p_{view}.png")
    printed = command("mask", f"data.root={root}", f"hull_only={str(hull_only).lower()}")
    overlaps = [overlap(read(root, view), photographs[view][1]) for view in range(1, NUM_VIEWS, 2)]
    assert min(overlaps) > 0.85, overlaps
    assert "7 masks are projections of the body of revolution" in printed


def on_screen(browser: Browser, x: float, y: float) -> tuple[float, float]:
    matrix = "editor.svg.getScreenCTM()"
    place = browser.evaluate(f"(({{ x, y }}) => [x, y])(new DOMPoint({x}, {y}).matrixTransform({matrix}))")
    return place[0], place[1]


def click(browser: Browser, x: float, y: float) -> None:
    place = on_screen(browser, x, y)
    browser.drag(place, place)


def choose(browser: Browser, view: int) -> str:
    """Show a view and return its name."""
    name = f"photos/p_{view}.png"
    browser.evaluate(f"tiles[views.findIndex(({{ name }}) => name === '{name}')].button.click()")
    return f"state.outlines['{name}']"


@pytest.mark.slow
@needs_chromium
def test_drawn_outlines_give_the_masks_of_the_command(
    capture: Path, photographs: list, tmp_path: Path, command: Callable[..., str]
) -> None:
    options = [f"data.root={capture}", "view=true", "open=false", "port=0"]
    served = Command("mask", options, tmp_path / "log")
    address = served.until(r"outlines on (http://localhost:\d+);")[1]
    with Browser(address, tmp_path, "--force-prefers-reduced-motion", size=(1000, 700)) as browser:
        browser.wait_for("$('message').textContent.startsWith('0 masks or outlines do not determine the shape')")
        for view in (1, 5, 9):
            outline = choose(browser, view)
            for x, y in polygon_around(photographs[view][1], 10, 1.05):
                click(browser, x, y)
            assert len(browser.evaluate(outline)) == 10
        browser.wait_for("!$('message').classList.contains('busy') && Object.keys(state.notes).length === 3")
        # Mouse: drag a vertex, insert one into an edge, and take both back.
        drawn = browser.evaluate(outline)
        browser.drag(on_screen(browser, *drawn[2]), on_screen(browser, drawn[2][0] - 9, drawn[2][1] + 5))
        assert browser.evaluate(f"{outline}[2]") == pytest.approx([drawn[2][0] - 9, drawn[2][1] + 5], abs=0.3)
        middle = browser.evaluate(f"[0, 1].map((axis) => ({outline}[6][axis] + {outline}[7][axis]) / 2)")
        click(browser, *middle)
        assert browser.evaluate(f"{outline}[7]") == pytest.approx(middle, abs=0.3)
        for _ in range(2):
            browser.evaluate("$('undo').click()")
        assert browser.evaluate(outline) == drawn
        # Keys: add a vertex, move it, remove it.
        browser.evaluate("$('editor').focus()")
        for key in ("Enter", "ArrowDown", "ArrowLeft"):
            browser.press(key)
        added = browser.evaluate(f"{outline}[10]")
        assert added == pytest.approx([drawn[9][0] + 9, drawn[9][1] + 1])
        browser.press("Delete")
        assert browser.evaluate(outline) == drawn
        # Fingers: a tap adds a vertex to another view.
        outline = choose(browser, 12)
        browser.touch([on_screen(browser, 30, 20)])
        browser.wait_for(f"{outline} !== undefined")
        browser.evaluate("$('clear').click()")
        browser.evaluate("$('save').click()")
        browser.wait_for("state.saved")
        shown = browser.evaluate("state.masks")
    assert served.wait() == 0, served.errors
    assert len(shown) == NUM_VIEWS
    other = shutil.copytree(capture, tmp_path / "other", ignore=shutil.ignore_patterns("mask*"))
    printed = command(
        "mask", f"data.root={other}", f"outlines={capture / 'outlines.json'}", "hull_only=true", "overwrite=true"
    )
    assert "wrote 14 masks" in printed
    assert json.loads((capture / "outlines.json").read_text()).keys() == {f"photos/p_{view}.png" for view in (1, 5, 9)}
    for view in range(NUM_VIEWS):
        assert np.array_equal(read(capture, view), read(other, view))

"""`nerfro.synthesize`: what it writes, what it keeps and what it refuses; and the scene that ships with the package."""

from __future__ import annotations

import json

import numpy as np
import pytest
import trimesh
from omegaconf import OmegaConf
from PIL import Image
from scipy.spatial import ConvexHull

from nerfro.allowed import check_settings
from nerfro.errors import NerfroError
from nerfro.light import to_linear, to_srgb
from nerfro.paths import ASSETS_DIR, CONF_DIR
from nerfro.scenes.synthesis import SynthesizeConfig, synthesize

EMBEDDED = ASSETS_DIR / "torus"
SPLITS = {"train": 100, "val": 10, "test": 20}


def configured(**options):
    """The configuration of the command line, with other values."""
    file = OmegaConf.load(CONF_DIR / "synthesize" / "synthesize.yaml")
    plain = {key: file[key] for key in file if key not in ("defaults", "hydra")}
    return OmegaConf.merge(OmegaConf.structured(SynthesizeConfig), plain, options)


def small(folder, **options):
    views = {"train": 2, "val": 1, "test": 1}
    return configured(
        **{"out": str(folder), "resolution": 12, "spp": 2, "test_spp": 3, "views": views, "sky_height": 16, **options}
    )


def frames(folder, split):
    transforms = json.loads((folder / f"transforms_{split}.json").read_text())
    return transforms["camera_angle_x"], transforms["frames"]


def read(path):
    return np.asarray(Image.open(path).convert("RGB"), np.float64) / 255


def rays(angle_x, pose, size):
    """Unit directions [size, size, 3] through the centres of pixels."""
    focal = 0.5 * size / np.tan(0.5 * angle_x)
    place = np.arange(size) + 0.5 - size / 2
    x, y = np.meshgrid(place / focal, -place / focal)
    directions = np.stack([x, y, -np.ones_like(x)], -1) @ np.asarray(pose)[:3, :3].T
    return directions / np.linalg.norm(directions, axis=-1, keepdims=True)


def hull_silhouette(vertices, angle_x, pose, size):
    """Pixels whose centre lies in the convex hull of the projected vertices: the silhouette of a convex body."""
    camera = (vertices - np.asarray(pose)[:3, 3]) @ np.asarray(pose)[:3, :3]
    focal = 0.5 * size / np.tan(0.5 * angle_x)
    projected = np.stack(
        [size / 2 - focal * camera[:, 0] / camera[:, 2], size / 2 + focal * camera[:, 1] / camera[:, 2]], -1
    )
    sides = ConvexHull(projected).equations
    centre = np.stack(np.meshgrid(np.arange(size) + 0.5, np.arange(size) + 0.5), -1)
    return (centre @ sides[:, :2].T + sides[:, 2] <= 0).all(-1)


def test_embedded_scene_is_complete_and_small():
    total = sum(path.stat().st_size for path in EMBEDDED.rglob("*") if path.is_file())
    assert total < 4e6
    for split, count in SPLITS.items():
        _, views = frames(EMBEDDED, split)
        assert len(views) == count
        for frame in views:
            assert Image.open(EMBEDDED / f"{frame['file_path']}.png").size == (128, 128)
            assert Image.open(EMBEDDED / frame["mask_path"]).mode == "L"


def test_masks_are_the_projected_mesh():
    vertices = trimesh.load(EMBEDDED / "mesh.ply", process=False).vertices
    overlap = []
    for split in SPLITS:
        angle_x, views = frames(EMBEDDED, split)
        for frame in views:
            mask = np.asarray(Image.open(EMBEDDED / frame["mask_path"])) > 127
            expected = hull_silhouette(vertices, angle_x, frame["transform_matrix"], 128)
            overlap.append((mask & expected).sum() / (mask | expected).sum())
    assert min(overlap) > 0.995


def test_sky_picture_is_the_sky_of_the_pictures():
    sky = to_linear(read(EMBEDDED / "sky.png"))
    angle_x, views = frames(EMBEDDED, "test")
    for frame in views[:3]:
        mask = np.asarray(Image.open(EMBEDDED / frame["mask_path"]))
        near = np.lib.stride_tricks.sliding_window_view(np.pad(mask, 1), (3, 3)).any((-2, -1))
        x, y, z = np.moveaxis(rays(angle_x, frame["transform_matrix"], 128), -1, 0)
        column = ((0.5 - np.arctan2(y, x) / (2 * np.pi)) * sky.shape[1]).astype(int) % sky.shape[1]
        row = (np.arccos(z) / np.pi * sky.shape[0]).astype(int)
        error = np.abs(read(EMBEDDED / f"{frame['file_path']}.png") - to_srgb(sky[row, column]))[~near]
        assert np.median(error) < 0.01  # nearest texel against an averaged pixel: edges differ, areas do not


@pytest.mark.usefixtures("mitsuba")
def test_interrupted_rendering_goes_on_where_it_stopped(tmp_path):
    folder = synthesize(small(tmp_path / "scene")).folder
    pictures = sorted(folder.rglob("r_*.png"))
    assert len(pictures) == 2 * 4
    before = {path: (path.read_bytes(), path.stat().st_mtime_ns) for path in pictures}
    lost = folder / "train" / "r_001.png"
    lost.unlink()
    (folder / "transforms_test.json").unlink()
    synthesize(small(folder))
    assert lost.read_bytes() == before[lost][0]
    again = {path for path in pictures if path.stat().st_mtime_ns != before[path][1]}
    assert again <= {lost, folder / "masks" / "train" / "r_001.png"}
    assert (folder / "transforms_test.json").is_file()
    assert not list(folder.rglob("*.partial"))


@pytest.mark.usefixtures("mitsuba")
def test_another_data_set_is_replaced_only_on_request_and_strangers_survive(tmp_path):
    folder = synthesize(small(tmp_path / "scene")).folder
    (folder / "notes.txt").write_text("mine")
    assert (folder / "interior.ply").is_file()
    before = (folder / "train" / "r_000.png").read_bytes()
    with pytest.raises(NerfroError, match="overwrite=true"):
        synthesize(small(folder, seed=1))
    assert (folder / "train" / "r_000.png").read_bytes() == before
    synthesize(small(folder, seed=1, views={"train": 1, "val": 1, "test": 1}, extras=False, overwrite=True))
    assert not (folder / "interior.ply").exists()
    assert (folder / "train" / "r_000.png").read_bytes() != before
    assert not (folder / "train" / "r_001.png").exists()
    assert (folder / "notes.txt").read_text() == "mine"


@pytest.mark.parametrize(("name", "content"), [("thesis.tex", "chapter 1"), ("meta.json", "{}"), ("meta.json", "[")])
@pytest.mark.usefixtures("mitsuba")
def test_a_folder_of_something_else_is_left_alone(tmp_path, name, content):
    (tmp_path / name).write_text(content)
    with pytest.raises(NerfroError, match="is not a data set of nerfro"):
        synthesize(small(tmp_path, overwrite=True))
    assert [(path.name, path.read_text()) for path in tmp_path.iterdir()] == [(name, content)]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"scene": "tours"}, "choose one of torus, ship, deerglobe, starlamp"),
        ({"resolution": 0}, "resolution=0 is not allowed; take at least 8"),
        ({"ior": 0.0}, "ior=0.0 is not allowed"),
        ({"spp": 0}, "spp=0"),
        ({"views": {"test": 0}}, "views.test=0"),
        ({"seed": -1}, "seed=-1"),
    ],
)
def test_options_out_of_range_are_refused_before_anything_is_written(tmp_path, options, message):
    config = small(tmp_path / "scene", **options)
    with pytest.raises(NerfroError, match=message):  # noqa: PT012 (options are looked at first, then the rest)
        check_settings(config, SynthesizeConfig)
        synthesize(config)
    assert not (tmp_path / "scene").exists()

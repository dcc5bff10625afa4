"""COLMAP's text and binary models, against COLMAP's documentation and pycolmap."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import trimesh

from nerfro.core.errors import NerfroError
from nerfro.data.base import Views
from nerfro.data.formats import colmap_model
from nerfro.data.formats.colmap_model import CAMERA_MODELS
from nerfro.training.run_folder import load as load_run
from tests.conftest import SMALL, refused

from .formats import BROWN, FORMATS, OPENCV, TRAIN, write_colmap
from .photographs import CX, CY, FX, FY, HEIGHT, POINTS, WIDTH, camera_to_world, check_views, project, save_picture

TORCH_POINTS = torch.from_numpy(POINTS).float()
TINY = [*SMALL, "evaluation.subdivision.side=1", "trainer.max_steps=2"]


def load(root: Path, split: str = "train", **options: Any) -> Views:
    return FORMATS["colmap"].load(root, split, **options)


@pytest.fixture
def write(tmp_path: Path) -> Callable[..., Path]:
    return lambda form="binary", **changes: write_colmap(tmp_path, form=form, **changes)


def test_text_models_are_read_and_views_are_sorted_by_name(write):
    root = write("text", masks=True)
    check_views(load(root), list(TRAIN), **BROWN)
    assert load(root, "test").names == ["top/v0.png", "top/v3.png"]


def test_distorted_reconstruction_of_a_room_trains(write, train_here, tmp_path):
    root, run = write(), tmp_path / "run"
    trimesh.creation.icosphere(2, 0.3).export(root / "mesh.ply")
    train_here(
        "+experiment=refractive_room", "data=colmap", f"data.root={root}", "data.test_every=3", *TINY,
        f"hydra.run.dir={run}",
    )  # fmt: skip
    rows = json.loads((run / "metrics.json").read_text())["views"]
    assert len(rows) == 2
    space = load_run(run).renderer.scene.space
    assert space.centre.tolist() == pytest.approx([0, 0, 0], abs=1e-4)  # of the mesh
    assert space.radius > 0.5


@pytest.mark.parametrize(
    ("model", "params", "lens"),
    [
        ("SIMPLE_PINHOLE", (FX, CX, CY), {"lens": (FX, FX, CX, CY)}),
        ("PINHOLE", (FX, FY, CX, CY), {}),
        ("SIMPLE_RADIAL", (FX, CX, CY, -0.1), {"lens": (FX, FX, CX, CY), "k": (-0.1,)}),
        ("RADIAL", (FX, CX, CY, -0.1, 0.02), {"lens": (FX, FX, CX, CY), "k": (-0.1, 0.02)}),
        (
            "FULL_OPENCV",
            (FX, FY, CX, CY, -0.1, 0.02, 0.003, 0.001, 0.004, 0, 0, 0),
            {"k": (-0.1, 0.02, 0.004), "p": (0.003, 0.001)},
        ),
    ],
)
def test_every_perspective_model_is_read(write, model, params, lens):
    check_views(load(write(cameras={7: (model, params)}, camera=lambda i: 7)), list(TRAIN), **lens)


def test_models_are_exchanged_with_pycolmap_in_both_directions(write, tmp_path):
    pycolmap = pytest.importorskip("pycolmap")
    rational = ("FULL_OPENCV", (FX, FY, CX, CY, 0.3, 0.05, 0.001, -0.002, 0.004, 0.4, 0.1, 0.01))
    root = write(cameras={1: OPENCV, 2: rational}, camera=lambda i: 1 + i % 2)
    theirs = pycolmap.Reconstruction(str(root / "sparse/0"))
    views = load(root)
    by_name = {image.name: image for image in theirs.images.values()}
    pixels = views.cameras.project(TORCH_POINTS)[0].numpy()
    for name, found in zip(views.names, pixels, strict=True):
        expected = np.array([by_name[name].project_point(point) for point in POINTS])
        np.testing.assert_allclose(found, expected, atol=1e-4)
    for folder, export in (("text", theirs.write_text), ("binary", theirs.write_binary)):
        (tmp_path / folder).mkdir()
        export(str(tmp_path / folder))
        again = load(root, model=folder)
        np.testing.assert_allclose(again.cameras.project(TORCH_POINTS)[0].numpy(), pixels, atol=1e-4)


@pytest.mark.parametrize("lens", [(FX, 3 * FX, WIDTH / 2, HEIGHT / 2), (FX, FX, 0.1 * WIDTH, 0.8 * HEIGHT)])
def test_bounds_are_those_of_the_points_within_the_images(write, lens):
    points = np.random.default_rng(0).uniform(-1, 1, (400, 3))
    cameras = load(write(cameras={1: ("PINHOLE", lens)}, points=points), near=None, far=None).cameras
    in_view = []
    for seed in range(6):
        pixels = project(seed, points, lens)
        inside = ((pixels > 0) & (pixels < [WIDTH, HEIGHT])).all(1)
        distances = np.linalg.norm(points[inside] - camera_to_world(seed, "opencv")[:3, 3], axis=1)
        in_view.append(np.quantile(distances, [0.001, 0.999]))
    assert cameras.near == pytest.approx(0.9 * min(low for low, _ in in_view))
    assert cameras.far == pytest.approx(1.1 * max(high for _, high in in_view))


def test_distant_and_infinite_points_and_poses_do_not_change_bounds(write):
    expected = load(write(), near=None, far=None).cameras
    for far_away in (1e30, 1e7):
        cameras = load(write(points=np.vstack([POINTS, [[far_away] * 3]])), near=None, far=None).cameras
        assert (cameras.near, cameras.far) == (expected.near, expected.far)
    for value in (np.nan, np.inf):
        root = write(points=np.vstack([POINTS, [[value, 0, 0]]]))
        with pytest.raises(NerfroError, match="holds points that are NaN or infinite; export the reconstruction again"):
            load(root, near=None, far=None)
    root = write("text")
    (root / "sparse/0/cameras.bin").unlink()
    path = root / "sparse/0/images.txt"
    rows = [line.split() for line in path.read_text().splitlines()]
    rows[1][5] = "1e30"
    path.write_text("\n".join(" ".join(row) for row in rows) + "\n")
    refused(r"position in the pose=.* is not allowed; take at least -1000000", load, root)


def test_without_points_bounds_come_from_the_cameras(write):
    root = write(points=np.zeros((0, 3)))
    cameras = load(root, near=None, far=None).cameras
    assert 0 < cameras.near < 1  # the cameras look at about the origin from a distance of 3
    assert 5 < cameras.far < 7
    (root / "sparse/0/points3D.bin").unlink()
    assert len(load(root)) == 4


def test_images_may_be_smaller_than_the_calibrated_images(write):
    root = write()
    for i in range(6):
        save_picture(root / f"images_2/top/v{i}.png", i, WIDTH // 2, HEIGHT // 2)
    cameras = load(root, images="images_2").cameras
    assert cameras.fx[0] == FX / 2
    np.testing.assert_allclose(
        cameras.project(TORCH_POINTS)[0].numpy(), load(root).cameras.project(TORCH_POINTS)[0].numpy() / 2, atol=1e-4
    )


@pytest.mark.parametrize("model", ["OPENCV_FISHEYE", "FOV", "SIMPLE_RADIAL_FISHEYE", "THIN_PRISM_FISHEYE"])
def test_lenses_that_are_not_perspective_are_refused(write, model):
    params = (FX, FY, CX, CY, *[0.01] * 12)[: dict(CAMERA_MODELS)[model]]
    with pytest.raises(NerfroError, match=f"camera 1 has the model {model}, which is not supported; undistort"):
        load(write(cameras={1: (model, params)}))


@pytest.mark.parametrize("file", ["cameras", "images", "points3D"])
def test_truncated_and_overlong_binary_files_are_refused(write, file):
    root = write()
    path = root / f"sparse/0/{file}.bin"
    whole = path.read_bytes()
    for cut in (3, 20, len(whole) - 1):
        path.write_bytes(whole[:cut])
        refused(rf"{file}\.bin is truncated; copy or export it again", load, root)
    path.write_bytes(whole + b"\0")
    refused(rf"{file}\.bin continues after its last item", load, root)


@pytest.mark.parametrize(
    ("file", "old", "new", "message"),
    [
        ("cameras", f"OPENCV {WIDTH}", f"OPENCV {WIDTH}.5", r"cameras\.txt, line 2 is not CAMERA_ID MODEL"),
        ("cameras", " -0.003", "", "line 2: OPENCV has 8 parameters, not 7"),
        ("cameras", "OPENCV", "STRANGE", "camera 1 has the model STRANGE, which is not supported"),
        ("cameras", "1 OPENCV", "2 OPENCV", "has camera 1, which the model does not hold"),
        ("images", "top/v5.png", "top/v4.png", "two images have the name top/v4.png"),
        ("images", "top/v5.png", "top/v6.png", "image .*v6.png of the model .* does not exist; set data.images"),
        ("images", "\n\n", "\n", r"images\.txt: after line \d+ there is no line of features"),
        ("images", " top/v5.png", "", r"images\.txt, line 6 is not IMAGE_ID"),
        ("points3D", "1 ", "1 x", r"points3D\.txt, line 1 is not POINT3D_ID"),
    ],
)
def test_wrong_text_files_are_refused(write, file, old, new, message):
    root = write("text")
    path = root / f"sparse/0/{file}.txt"
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))
    refused(message, load, root)


@pytest.mark.parametrize("spaces", range(3))
def test_text_files_without_lines_of_features_are_refused_whatever_the_names_are(write, spaces):
    root = write("text", points=np.zeros((0, 3)))
    path = root / "sparse/0/images.txt"
    rows = [line.replace("/v", "/" + " ".join("v" * (spaces + 1))) for line in path.read_text().splitlines() if line]
    path.write_text("\n".join(rows) + "\n")
    refused("there is no line of features, which may be empty; add the line", load, root)


def test_missing_files_are_named(write, tmp_path):
    refused("there is no COLMAP model", load, tmp_path)
    refused(r"sparse/7; set data\.model to its folder", load, tmp_path, model="sparse/7")
    root = write()
    (root / "sparse/0/images.bin").unlink()
    refused("holds no cameras and images", load, root)


def test_model_without_its_images_is_read(write):
    model = colmap_model.read_colmap(write("text") / "sparse/0")
    assert [image.name for image in model.images] == [f"top/v{i}.png" for i in range(6)]
    np.testing.assert_allclose(model.points, POINTS)
    np.testing.assert_allclose(model.images[3].camera_to_world, camera_to_world(3, "opencv")[:3], atol=1e-12)


def test_largest_of_several_models_is_used_and_named(write, tmp_path, capsys):
    root = write("text")
    (root / "sparse/0").rename(root / "sparse/1")
    assert len(load(root)) == len(TRAIN)
    assert "COLMAP" not in capsys.readouterr().out, "one model, whatever its number"
    fragment = root / "sparse/0"
    fragment.mkdir()
    for name in ("cameras.txt", "points3D.txt"):
        shutil.copy(root / "sparse/1" / name, fragment)
    lines = [line for line in (root / "sparse/1/images.txt").read_text().splitlines() if not line.startswith("#")]
    (fragment / "images.txt").write_text("\n".join(lines[:4]) + "\n")
    source = FORMATS["colmap"].open(root)
    assert len(source.load("train")) == len(TRAIN)
    source.load("test")
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 1, "the line is printed once"
    assert f"{root}/sparse/0 (2 images), {root}/sparse/1 (6 images); {root}/sparse/1 is used" in lines[0]


@pytest.mark.parametrize("form", ["binary", "text"])
def test_points_give_depths_to_the_images_that_observe_them(form: str, tmp_path: Path) -> None:
    """Only the second image of the file, v0, observes the points."""
    views = load(write_colmap(tmp_path, form=form), "test", depths=True)
    assert views.names == ["top/v0.png", "top/v3.png"]
    depth = views.maps["depth"][..., 0]
    assert not depth[1].any()
    pixels, along_axis = views.cameras.select([0]).project(TORCH_POINTS)
    column, row = pixels[0].long().unbind(-1)
    inside = (along_axis[0] > 0) & (column >= 0) & (column < WIDTH) & (row >= 0) & (row < HEIGHT)
    assert inside.sum() > 3
    nearest = torch.full_like(depth[0], torch.inf)
    for x, y, point in zip(column[inside], row[inside], TORCH_POINTS[inside], strict=True):
        distance = (point - views.cameras.camera_to_world[0, :, 3]).norm()
        nearest[y, x] = torch.minimum(nearest[y, x], distance)
    torch.testing.assert_close(depth[0], torch.where(nearest.isfinite(), nearest, 0.0))

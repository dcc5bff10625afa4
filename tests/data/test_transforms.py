"""Formats with transforms files (Blender, OpenCV, nerfstudio), and the messages about wrong files."""

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import trimesh
from PIL import Image

from nerfro.core.errors import NerfroError
from nerfro.data.base import Views
from nerfro.data.formats.transforms import BlenderData, NerfstudioData, OpenCVData
from tests.conftest import refused

from .formats import (
    ANGLE,
    FORMATS,
    IDEAL,
    SHARED,
    K,
    P,
    change_json,
    write_blender,
    write_nerfstudio,
    write_opencv,
    write_transforms,
)
from .photographs import CX, CY, FX, FY, HEIGHT, WIDTH, camera_to_world, check_views, picture, save_mask


def load(root: Path, split: str = "train", **options: Any) -> Views:
    return NerfstudioData(str(root), **{"near": 0.5, "far": 9.0} | options).load(split)


def edit(root: Path, change: Callable[[dict], Any]) -> Path:
    change_json(root / "transforms_train.json", change)
    return root


# Blender and OpenCV


def test_extensions_are_found_in_lower_and_upper_case(tmp_path: Path) -> None:
    root = write_blender(tmp_path)
    (root / "train/r_1.png").rename(root / "train/r_1.PNG")
    (root / "train/r_2.png").rename(root / "train/r_2.PNG")
    edit(root, lambda d: d["frames"][1].update(file_path="train/r_2.png"))
    views = BlenderData(str(root)).load("train")
    assert [frame.image.name for frame in views.frames[:2]] == ["r_1.PNG", "r_2.PNG"]
    assert [views.names[i] for i in (0, 1)] == ["train/r_1", "train/r_2.png"]


def test_rounded_poses_and_poses_of_three_rows_are_accepted(tmp_path: Path) -> None:
    def change(document: dict) -> None:
        for frame in document["frames"]:
            frame["transform_matrix"] = np.round(frame["transform_matrix"], 4)[:3].tolist()

    assert len(BlenderData(str(edit(write_blender(tmp_path), change))).load("train")) == 4


def test_masks_are_found_by_the_paths_of_the_file(tmp_path: Path) -> None:
    root = write_transforms(tmp_path, {"camera_angle_x": ANGLE}, masks=True)
    (root / "train/mask_r_4.png").rename(root / "other.png")
    assert BlenderData(str(root)).load("train").masks is None
    for key in ("mask_path", "mask_file_path"):  # the second one is RefRef's
        edit(root, lambda d, key=key: d["frames"][2].update({key: "./other.png"}))
        np.testing.assert_array_equal(BlenderData(str(root)).load("train").masks[2], picture(4)[..., 0] > 127)
        edit(root, lambda d, key=key: d["frames"][2].pop(key))


def test_splits_are_listed_in_the_usual_order(tmp_path: Path) -> None:
    root = write_blender(tmp_path)
    for name in ("transforms_extra.json", "val_transforms.json"):
        (root / name).write_text((root / "transforms_train.json").read_text())
    source = BlenderData(str(root))
    assert source.splits == ["train", "val", "test", "extra"]
    assert all(len(source.load(split)) > 0 for split in source.splits)


def matrix(change: Callable[[np.ndarray], Any]) -> Callable[[dict], None]:
    """Change the pose of the second frame."""

    def edited(document: dict) -> None:
        pose = np.array(document["frames"][1]["transform_matrix"], dtype=object)
        change(pose)
        document["frames"][1]["transform_matrix"] = pose.tolist()

    return edited


FRAME = r"transforms_train\.json: frame 1 \('train/r_2'\)"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda d: d.pop("frames"), r"transforms_train\.json has no list 'frames'"),
        (lambda d: d.update(frames=[]), r"transforms_train\.json has an empty list 'frames'; a split needs"),
        (lambda d: d.update(frames=["train/r_1"]), r"transforms_train\.json: frame 0 is not an object"),
        (lambda d: d.pop("camera_angle_x"), r"transforms_train\.json: 'train/r_1' has no focal length; add fl_x"),
        (lambda d: d.update(camera_angle_x="wide"), "camera_angle_x='wide' is not allowed; take a number, not text"),
        (lambda d: d.update(camera_angle_x=39.6), "camera_angle_x=39.6 is not allowed; take more than 0"),
        (lambda d: d["frames"][1].pop("file_path"), r"transforms_train\.json: frame 1 has no 'file_path'"),
        (lambda d: d["frames"][1].pop("transform_matrix"), r"frame 1 has no 'transform_matrix'"),
        (lambda d: d["frames"][1].update(transform_matrix_end=[[1]]), "frame 1: transform_matrix_end says"),
        (lambda d: d["frames"][1].update(file_path=3), "frame 1: file_path=3 is not allowed; take text"),
        (lambda d: d["frames"][1].update(file_path="train/r_1"), "'train/r_1' occurs in several frames"),
        (lambda d: d["frames"][1].update(file_path="train/r_1.png"), "'train/r_1', 'train/r_1.png' occurs in several"),
        (lambda d: d["frames"][1].update(file_path="train/no"), r"\('train/no'\): image .*no\.png does not exist"),
        (lambda d: d["frames"][1].update(file_path="a" * 5000), r"image .*a\.png does not exist"),
        (lambda d: d["frames"][1].update(mask_path="a" * 5000), r"mask .*a of .*r_2\.png does not exist"),
        (lambda d: d.update(w="wide", h=6), "w='wide' is not allowed; take a number, not text"),
        (matrix(lambda m: np.put(m, 3, math.nan)), FRAME + ": transform_matrix holds NaN or infinite numbers"),
        (matrix(lambda m: np.put(m, 3, math.inf)), FRAME + ": transform_matrix holds NaN or infinite numbers"),
        (matrix(lambda m: np.put(m, 3, "x")), FRAME + ": transform_matrix is not a matrix of numbers; give 4x4 or 3x4"),
        (matrix(lambda m: np.put(m, 12, 0.5)), FRAME + ": the last row of transform_matrix is .* must be 0, 0, 0, 1"),
        (lambda d: d["frames"][1].update(transform_matrix=[1, 2]), FRAME + ": transform_matrix has shape 2; give 4x4"),
        (lambda d: d["frames"][1].update(transform_matrix=None), "frame 1 has no 'transform_matrix'"),
        (matrix(lambda m: np.put(m, 0, True)), FRAME + ": transform_matrix is not a matrix of numbers"),
        (matrix(lambda m: np.multiply(m[:3, 0], -1, m[:3, 0])), FRAME + r".* is not a rotation \(it is a reflection\)"),
        (matrix(lambda m: np.multiply(m[:3, :3], 1.1, m[:3, :3])), FRAME + r".* \(R\^T R differs from 1 by 0.21\)"),
    ],
)
def test_wrong_transforms_files_give_a_one_line_error(
    tmp_path: Path, change: Callable[[dict], Any], message: str
) -> None:
    root = edit(write_blender(tmp_path), change)
    refused(message, lambda: BlenderData(str(root)).load("train"))


def test_files_without_the_expected_content_are_named(tmp_path: Path) -> None:
    for source in (BlenderData, NerfstudioData):
        with pytest.raises(NerfroError, match=r"holds no transforms_<split>\.json"):
            source(str(tmp_path)).load("train")
    path = write_blender(tmp_path) / "transforms_train.json"
    path.write_text(path.read_text()[:-40])
    refused(r"transforms_train\.json is not valid JSON \(.*\); copy", lambda: BlenderData(str(tmp_path)).load("train"))
    path.write_text("[1, 2]")
    refused("has no list 'frames'", lambda: BlenderData(str(tmp_path)).load("train"))


def test_evaluation_images_are_cropped_with_their_rays_and_training_images_are_not(tmp_path: Path) -> None:
    root = write_opencv(tmp_path, masks=True)
    (root / "transforms_train.json").write_text((root / "transforms_test.json").read_text())
    source = OpenCVData(str(root), eval_crop=0.5)
    full, test = source.load("train"), source.load("test")
    # A half of 18 // 2 is 4 and a half of 24 // 2 is 6 pixels on each side of the centre.
    rows, columns = slice(5, 13), slice(6, 18)
    assert full.images[0].shape == (HEIGHT, WIDTH, 3)
    assert torch.equal(test.images[0], full.images[0][rows, columns])
    assert torch.equal(test.masks[0], full.masks[0][rows, columns])
    directions = full.cameras.image_rays(0).directions.reshape(HEIGHT, WIDTH, 3)[rows, columns]
    torch.testing.assert_close(test.cameras.image_rays(0).directions.reshape(8, 12, 3), directions)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"cam_mat": None}, "'train/r_1' has no focal length; add .* cam_mat"),
        ({"cam_mat": "wide"}, "cam_mat is not a matrix of numbers"),
        ({"cam_mat": [[True, 0, 4], [0, 9, 3], [0, 0, 1]]}, "cam_mat is not a matrix of numbers"),
        ({"cam_mat": [[1.0, 0], [0, 1]]}, "cam_mat has shape 2x2; give 3x3 numbers"),
        ({"cam_mat": [[np.nan, 0, 4], [0, 9, 3], [0, 0, 1]]}, "cam_mat holds NaN"),
        ({"cam_mat": [[-9.0, 0, 4], [0, 9, 3], [0, 0, 1]]}, "cam_mat: fl_x=-9.0 is not allowed; take more than 0"),
        ({"cam_mat": [[9.0, 1, 4], [0, 9, 3], [0, 0, 1]]}, "cam_mat must have no skew and the last row 0, 0, 1"),
        ({"cam_mat": [[9.0, 0, 4], [0, 9, 3], [0, 0, 2]]}, "cam_mat must have no skew and the last row 0, 0, 1"),
        *(
            ({"dist": dist}, "must be 4, 5 or 8 numbers in OpenCV's order")
            for dist in ([0.1], "none", [1, 2, 3, None], [[0.1, 0.2]])
        ),
    ],
)
def test_wrong_camera_matrices_and_distortions_are_refused(tmp_path: Path, changes: dict, message: str) -> None:
    refused(message, lambda: OpenCVData(str(write_opencv(tmp_path, **changes))).load("train"))


# nerfstudio


def test_every_tenth_frame_by_name_is_a_test_view(tmp_path: Path) -> None:
    root = write_nerfstudio(tmp_path, seeds=reversed(range(12)))
    check_views(load(root), [1, 10, 11, 2, 3, 4, 5, 6, 7, 9], k=K, p=P)
    assert [name[-7:] for name in load(root, "test").names] == ["f_0.png", "f_8.png"]
    assert load(root, "val").names == load(root, "test").names


def test_split_files_and_field_of_view_are_read(tmp_path: Path) -> None:
    root = write_nerfstudio(tmp_path, seeds=(1, 0), top={"camera_angle_x": ANGLE}, name="transforms_train.json")
    assert NerfstudioData(str(root), near=0.5, far=9.0).splits == ["train"]
    check_views(load(root), [1, 0], lens=IDEAL)


def usable(views: Views) -> np.ndarray:
    return np.stack([pixels.numpy() == 1 for pixels in views.usable])


def test_black_pixels_of_mask_path_are_not_usable(tmp_path: Path) -> None:
    root = write_nerfstudio(tmp_path, seeds=range(3), frame=lambda i: {"mask_path": f"masks/f_{i}.png"})
    for i in range(3):
        save_mask(root / f"masks/f_{i}.png", i)  # where other formats look for a silhouette
    views = load(root)
    assert views.masks is None
    white = np.stack([picture(i)[..., 0] > 127 for i in (1, 2)])
    np.testing.assert_array_equal(usable(views), white)
    whole = white.reshape(2, HEIGHT // 2, 2, WIDTH // 2, 2).all((2, 4))
    np.testing.assert_array_equal(usable(load(root, downscale=2)), whole)
    assert 0 < whole.sum() < whole.size


def test_masks_beside_the_images_are_silhouettes_unless_named_by_mask_path(tmp_path: Path) -> None:
    root = write_nerfstudio(tmp_path, seeds=range(3))
    for i in range(3):
        save_mask(root / f"images/mask_f_{i}.png", i)
    views = load(root)
    check_views(views, [1, 2], lens=(FX, FY, CX, CY), k=K, p=P)
    assert views.masks is not None
    write_nerfstudio(tmp_path, seeds=range(3), frame=lambda i: {"mask_path": f"./images/mask_f_{i}.png"})
    views = load(root)
    assert views.masks is None
    assert views.usable is not None


def test_mask_path_rounds_grey_levels_and_accepts_labels_0_and_1(tmp_path: Path) -> None:
    root = write_nerfstudio(tmp_path, seeds=range(2), frame=lambda i: {"mask_path": "mask.png"})
    levels = np.full((HEIGHT, WIDTH), 127, np.uint8)
    levels[3, 5] = 128
    for mask in (levels, levels - 127):
        Image.fromarray(mask).save(root / "mask.png")
        assert np.argwhere(usable(load(root))).tolist() == [[0, 3, 5]]


@pytest.mark.parametrize(
    ("draw", "message"),
    [
        (lambda path: None, r"mask .*ignore\.png of .*f_1\.png does not exist"),
        (lambda path: path.write_bytes(b"no image"), r"ignore\.png cannot be read"),
        (lambda path: save_mask(path, 1, WIDTH, HEIGHT - 1), "24x17 pixels but its image has 24x18"),
        (
            lambda path: Image.new("L", (WIDTH, HEIGHT)).save(path),
            r"mask .*ignore\.png excludes all pixels of .*f_1\.png: black pixels are ignored, white pixels are used",
        ),
    ],
)
def test_mask_path_without_a_usable_mask_is_named(tmp_path: Path, draw: Callable[[Path], Any], message: str) -> None:
    root = write_nerfstudio(tmp_path, seeds=range(2), frame=lambda i: {"mask_path": "ignore.png"})
    draw(root / "ignore.png")
    refused(message, load, root)


def test_mask_path_of_some_frames_and_of_other_types_is_named(tmp_path: Path) -> None:
    root = write_nerfstudio(tmp_path, seeds=range(3), frame=lambda i: {"mask_path": "ignore.png"} if i == 1 else {})
    save_mask(root / "ignore.png", 1)
    refused(r"1 of 2 images have no mask .*f_2\.png is the first", load, root)
    refused("mask_path=3 is not allowed; take text", load, write_nerfstudio(tmp_path, frame=lambda i: {"mask_path": 3}))


@pytest.mark.parametrize(
    ("top", "frame", "message"),
    [
        ({"w": 30}, {}, "calibrated for 30x18 pixels but the images have 24x18 and another aspect ratio"),
        ({"k1": -9.0}, {}, "lens distortion is not invertible everywhere in the image"),
        ({"test_filenames": ["images/x.png"]}, {}, "no 'train_filenames'"),
        ({"train_filenames": ["images/x.png"]}, {}, "train_filenames lists 'images/x.png', but no frame has this name"),
        ({}, {"object_mask_path": "gone.png"}, "gone.png of .* does not exist"),
        ({"ply_file_path": 3}, {}, "ply_file_path=3 is not allowed; take text"),
    ],
)
def test_wrong_values_are_named(tmp_path: Path, top: dict, frame: dict, message: str) -> None:
    with pytest.raises(NerfroError, match=message):
        load(write_nerfstudio(tmp_path, seeds=range(3), top=SHARED | top, frame=lambda i: frame), near=None)


def test_frames_without_an_image_are_skipped_with_one_warning_or_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    root = write_nerfstudio(tmp_path)
    for i in (1, 4):
        (root / f"images/f_{i}.png").unlink()
    source = NerfstudioData(str(root), near=0.5, far=9.0, test_every=4)
    assert [name[-7:] for name in source.load("train").names] == ["f_2.png", "f_3.png", "f_5.png"]
    assert [name[-7:] for name in source.load("test").names] == ["f_0.png"]
    assert capsys.readouterr().out.count("2 of 6 frames have no image and are skipped: images/f_4.png, ") == 1
    refused(r"image .*images/f_4\.png does not exist", load, root, missing="refuse")
    for i in range(6):
        (root / f"images/f_{i}.png").unlink(missing_ok=True)
    refused(r"f_4\.png does not exist", load, root)


def test_listed_frames_without_an_image_are_skipped(tmp_path: Path) -> None:
    files = [f"images/f_{i}.png" for i in range(4)]
    lists = {"train_filenames": files[:2], "val_filenames": files[2:3], "test_filenames": files[3:]}
    root = write_nerfstudio(tmp_path, seeds=range(4), top=SHARED | lists)
    for name in files[1:3]:
        (root / name).unlink()
    source = NerfstudioData(str(root), near=0.5, far=9.0)
    assert [source.load(split).names for split in ("train", "test")] == [files[:1], files[3:]]
    refused("no image of val_filenames exists; restore images/f_2.png", source.load, "val")


def test_bounds_are_estimated_from_the_cameras(tmp_path: Path) -> None:
    # The cameras look at about the origin from a distance of 3.
    root = str(write_nerfstudio(tmp_path, seeds=range(12)))
    cameras = NerfstudioData(root).load("train").cameras
    assert 0 < cameras.near < 1
    assert 5 < cameras.far < 7
    given = NerfstudioData(root, far=4.0).load("test").cameras
    assert (given.near, given.far) == (cameras.near, 4.0)


def test_bounds_enclose_the_sparse_points(tmp_path: Path) -> None:
    root = write_nerfstudio(tmp_path, seeds=range(12), top=SHARED | {"ply_file_path": "sparse_pc.ply"})
    points = np.random.default_rng(0).normal(size=(200, 3))
    points *= 0.2 / np.linalg.norm(points, axis=1, keepdims=True)
    trimesh.PointCloud(points).export(root / "sparse_pc.ply")
    cameras = NerfstudioData(str(root)).load("train").cameras
    assert cameras.near == pytest.approx(0.9 * 2.8, rel=0.03)
    assert cameras.far == pytest.approx(1.1 * 3.2, rel=0.03)
    (root / "sparse_pc.ply").write_bytes(b"ply?")
    refused(r"sparse_pc\.ply has no readable points", lambda: NerfstudioData(str(root)).load("train"))


def test_cameras_without_a_common_target_need_near_and_far(tmp_path: Path) -> None:
    def outwards(i: int) -> dict:
        pose = camera_to_world(i, "opengl")
        pose[:3, :3] = pose[:3, :3] @ np.diag([-1.0, 1.0, -1.0])  # turned round
        return {"transform_matrix": pose.tolist()}

    root = write_nerfstudio(tmp_path, seeds=range(12), frame=outwards)
    refused(r"data\.near and data\.far cannot be found", lambda: NerfstudioData(str(root)).load("train"))
    assert load(root).cameras.near == 0.5


@pytest.mark.parametrize(
    ("form", "suffix", "stated"),
    [("nerfstudio", ".avif", True), ("blender", ".HEIC", True), ("blender", ".heic", False)],
)
def test_images_of_other_types_are_refused_by_their_type(form: str, suffix: str, stated: bool, tmp_path: Path) -> None:
    root = FORMATS[form].write(tmp_path)
    file = root / ("transforms.json" if form == "nerfstudio" else "transforms_train.json")
    first = json.loads(file.read_text())["frames"][1]["file_path"].removesuffix(".png")
    (root / f"{first}.png").rename(root / f"{first}{suffix}")
    change_json(file, lambda d: d["frames"][1].update(file_path=f"{first}{suffix if stated else ''}"))
    message = rf"{suffix} are not read; convert the images to PNG .* or JPEG, and correct the names in the file"
    refused(message, FORMATS[form].load, root)


def test_jfif_files_are_read_as_jpeg(tmp_path: Path) -> None:
    root = write_nerfstudio(tmp_path)
    Image.open(root / "images/f_1.png").convert("RGB").save(root / "images/f_1.jfif", "JPEG")
    (root / "images/f_1.png").unlink()
    change_json(root / "transforms.json", lambda d: d["frames"][4].update(file_path="images/f_1.jfif"))
    assert "images/f_1.jfif" in load(root, test_every=3).names


def test_sparse_points_are_read_from_windows_paths_and_reported_if_missing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "points").mkdir()
    trimesh.PointCloud(np.random.default_rng(0).uniform(-0.1, 0.1, (100, 3))).export(tmp_path / "points/sparse.ply")
    bounds = {}
    for path in ("points/sparse.ply", "points\\sparse.ply", "points/none.ply"):
        source = NerfstudioData(str(write_nerfstudio(tmp_path, top=SHARED | {"ply_file_path": path})), test_every=3)
        for split in ("train", "test"):
            cameras = source.load(split).cameras
        bounds[path] = cameras.near, cameras.far
        assert capsys.readouterr().out.count("(ply_file_path) do not exist, so near and far are") == ("none" in path)
    assert bounds["points\\sparse.ply"] == bounds["points/sparse.ply"] != bounds["points/none.ply"]


def test_rolling_shutter_of_zeros_is_a_global_shutter(tmp_path: Path) -> None:
    for shutter, right in (([0.0] * 4, True), ([[0, 0], [0, 0]], True), ([0.0, 0.0, 0.0, 0.01], False)):
        root = write_nerfstudio(tmp_path, top=SHARED | {"rolling_shutter": shutter})
        if right:
            assert len(load(root, test_every=3)) == 4
        else:
            refused("rolling_shutter=.* is not supported", load, root, test_every=3)


@pytest.mark.parametrize(
    ("form", "name"), [("nerfstudio", "transforms.json"), ("colmap", "sparse"), ("idr", "cameras_")]
)
def test_default_format_names_the_format_of_a_folder(form: str, name: str, tmp_path: Path) -> None:
    root = FORMATS[form].write(tmp_path)
    refused(
        rf"holds no transforms_<split>.json; it holds {name}.*, which data={form} reads",
        BlenderData(str(root)).load,
        "train",
    )


def test_depth_images_become_arc_lengths_in_every_split_and_size(tmp_path: Path) -> None:
    """Depths along the optical axis, of points that the cameras see, are distances from the cameras."""
    root = write_nerfstudio(tmp_path, frame=lambda i: {"depth_file_path": f"depths/{i}.png"})
    (root / "depths").mkdir()
    for i in range(6):
        Image.fromarray(np.full((HEIGHT, WIDTH), 1500 + i, np.uint16)).save(root / f"depths/{i}.png")
    assert NerfstudioData(str(root)).load("train").maps == {}
    views = NerfstudioData(str(root), depth_unit=0.001, downscale=2).load("train")
    depth = views.maps["depth"]
    assert depth.shape == (len(views), *views.images.shape, 1)
    rays, view = views.cameras.image_rays(1), int(Path(views.names[1]).stem[2:])
    points = rays.origins + depth[1].view(-1, 1) * rays.directions
    _, along_axis = views.cameras.select([1]).project(points)
    torch.testing.assert_close(along_axis[0], torch.full((len(points),), 0.001 * (1500 + view)))
    refused("depth_file_path", NerfstudioData(str(write_nerfstudio(tmp_path / "b")), depth_unit=1.0).load, "train")


def test_a_slice_of_images_is_a_tensor(tmp_path: Path) -> None:
    images = NerfstudioData(str(write_nerfstudio(tmp_path))).load("train").images
    assert torch.equal(images[1:3], torch.stack([images[1], images[2]]))

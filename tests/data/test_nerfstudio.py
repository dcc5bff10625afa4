"""nerfstudio's format, written here and read back."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
import torch
import trimesh
from PIL import Image

from nerfro.data.base import Views
from nerfro.data.nerfstudio import NerfstudioData
from nerfro.errors import NerfroError
from nerfro.training.ray_batches import RayBatches

from .photographs import (
    CX,
    CY,
    FX,
    FY,
    HEIGHT,
    POINTS,
    WIDTH,
    camera_to_world,
    check_views,
    picture,
    save_mask,
    save_picture,
)

K, P = (-0.12, 0.03, 0.004, -0.001), (0.002, -0.003)
SHARED = {"camera_model": "OPENCV", "fl_x": FX, "fl_y": FY, "cx": CX, "cy": CY, "w": WIDTH, "h": HEIGHT}
DISTORTION = {"k1": K[0], "k2": K[1], "k3": K[2], "k4": K[3], "p1": P[0], "p2": P[1]}


@pytest.fixture
def write(tmp_path):
    """Write transforms.json of some frames; `frame` gives further keys of frame i, `top` of the file."""

    def write(num_frames=6, top=SHARED | DISTORTION, frame=lambda i: {}, name="transforms.json", masks=False):
        frames = []
        for i in reversed(range(num_frames)):  # in no order
            save_picture(tmp_path / f"images/f_{i}.png", i)
            entry = {"file_path": f"./images/f_{i}.png", "transform_matrix": camera_to_world(i, "opengl").tolist()}
            if masks:
                save_mask(tmp_path / f"silhouettes/s{i}.png", i)
                entry["object_mask_path"] = f"silhouettes/s{i}.png"
            frames.append(entry | frame(i))
        (tmp_path / name).write_text(json.dumps(top | {"frames": frames}))
        return tmp_path

    return write


def load(root, split="train", **options):
    return NerfstudioData(str(root), near=0.5, far=9.0, **options).load(split)


def test_points_project_through_the_distorted_lens_and_every_tenth_frame_is_kept(write):
    root = write(12, masks=True)
    check_views(load(root), [1, 10, 11, 2, 3, 4, 5, 6, 7, 9], k=K, p=P)
    assert [name[-7:] for name in load(root, "test").names] == ["f_0.png", "f_8.png"]
    assert load(root, "val").names == load(root, "test").names


def test_frames_may_have_intrinsics_of_their_own(write):
    own = lambda i: {"fl_x": FX + 1, "k1": 0.1} if i == 2 else {}  # noqa: E731
    views = load(write(4, top=SHARED, frame=own), test_every=4)
    assert views.cameras.fx.tolist() == [FX, FX + 1, FX]
    assert views.cameras.distortion[:, 0].tolist() == pytest.approx([0, 0.1, 0])


def test_listed_splits_are_taken_in_their_order(write):
    lists = {f"{s}_filenames": [f"images/f_{i}.png" for i in n] for s, n in (("train", (3, 1)), ("test", (0,)))}
    root = write(4, top=SHARED | lists)
    check_views(load(root), [3, 1])
    check_views(load(root, "test"), [0])
    with pytest.raises(NerfroError, match="no 'val_filenames'"):
        load(root, "val")


def test_a_file_for_each_split_and_a_field_of_view_instead_of_a_focal_length(write):
    angle = 2 * math.atan(0.5 * WIDTH / FX)
    root = write(2, top={"camera_angle_x": angle}, name="transforms_train.json")
    assert NerfstudioData(str(root), 0.5, 9.0).splits == ["train"]
    check_views(load(root), [1, 0], lens=(FX, FX, WIDTH / 2, HEIGHT / 2))


def test_images_of_another_size_scale_the_intrinsics(write):
    root = write(2, top=SHARED | DISTORTION)
    for i in range(2):
        save_picture(root / f"images/f_{i}.png", i, WIDTH // 2, HEIGHT // 2)
    cameras = load(root).cameras
    assert (cameras.width, cameras.height) == (WIDTH // 2, HEIGHT // 2)
    assert cameras.fx.tolist() == [FX / 2]
    assert cameras.cy.tolist() == pytest.approx([CY / 2])


def test_downscaled_images_keep_the_directions(write):
    root = write(2)
    full, half = load(root).cameras, load(root, downscale=2).cameras
    points = torch.from_numpy(POINTS).float()
    torch.testing.assert_close(half.project(points)[0], full.project(points)[0] / 2)


def usable(views: Views) -> np.ndarray:
    return np.stack([pixels.numpy() == 1 for pixels in views.usable])


def test_black_of_mask_path_is_not_usable_and_no_silhouette(write):
    root = write(3, frame=lambda i: {"mask_path": f"masks/f_{i}.png"})
    for i in range(3):
        save_mask(root / f"masks/f_{i}.png", i)  # where a silhouette would be found in other formats
    views = load(root)
    assert views.masks is None
    white = np.stack([picture(i)[..., 0] > 127 for i in (1, 2)])
    np.testing.assert_array_equal(usable(views), white)
    whole = white.reshape(2, HEIGHT // 2, 2, WIDTH // 2, 2).all((2, 4))
    np.testing.assert_array_equal(usable(load(root, downscale=2)), whole)
    assert 0 < whole.sum() < whole.size
    for batching in ("single_image", "all_images"):
        batches = RayBatches(views, 20, batching)
        drawn = torch.cat([batches.batch(step).index for step in range(300)])
        # Of about 430 pixels, each is drawn 14 times: all that may be, and no other.
        assert drawn.unique().tolist() == np.flatnonzero(white).tolist()


def test_grey_of_mask_path_is_what_it_is_nearer_to_and_labels_are_0_and_1(write):
    root = write(2, frame=lambda i: {"mask_path": "mask.png"})
    levels = np.full((HEIGHT, WIDTH), 127, np.uint8)
    levels[3, 5] = 128
    Image.fromarray(levels).save(root / "mask.png")
    assert np.argwhere(usable(load(root))).tolist() == [[0, 3, 5]]
    Image.fromarray(levels - 127).save(root / "mask.png")
    assert np.argwhere(usable(load(root))).tolist() == [[0, 3, 5]]


def test_frames_without_mask_path_are_usable_throughout(write):
    assert load(write(2)).usable is None
    assert load(write(2, frame=lambda i: {"mask_path": None})).usable is None


@pytest.mark.parametrize(
    ("draw", "message"),
    [
        (lambda path: None, r"mask .*ignore\.png of .*f_1\.png does not exist"),
        (lambda path: path.write_bytes(b"no picture"), r"ignore\.png cannot be read"),
        (lambda path: save_mask(path, 1, WIDTH, HEIGHT - 1), "24x17 pixels but its image has 24x18"),
        (
            lambda path: Image.new("L", (WIDTH, HEIGHT)).save(path),
            r"mask .*ignore\.png rules out all pixels of .*f_1\.png: black is ignored, white is used",
        ),
    ],
)
def test_mask_path_that_cannot_be_obeyed_is_named(write, draw, message):
    root = write(2, frame=lambda i: {"mask_path": "ignore.png"})
    draw(root / "ignore.png")
    with pytest.raises(NerfroError, match=message):
        load(root)


def test_mask_path_of_some_frames_and_of_other_types_is_named(write):
    root = write(3, frame=lambda i: {"mask_path": "ignore.png"} if i == 1 else {})
    save_mask(root / "ignore.png", 1)
    with pytest.raises(NerfroError, match=r"1 of 2 images have no mask .*f_2\.png is the first"):
        load(root)
    with pytest.raises(NerfroError, match="'mask_path' must be text"):
        load(write(3, frame=lambda i: {"mask_path": 3}))


@pytest.mark.parametrize(
    ("top", "frame", "message"),
    [
        ({"camera_model": "OPENCV_FISHEYE"}, {}, "camera_model='OPENCV_FISHEYE' is not supported; undistort"),
        ({"fl_x": "long"}, {}, "fl_x='long' must be a number"),
        ({"fl_x": -3}, {}, "fl_x=-3, fl_y=29, w and h must be positive"),
        ({"w": 30}, {}, "calibrated for 30x18 pixels but the images have 24x18, of other proportions"),
        ({"k1": -9.0}, {}, "lens distortion cannot be undone everywhere in the image"),
        ({"test_filenames": ["images/x.png"]}, {}, "no 'train_filenames'"),
        ({"train_filenames": ["images/x.png"]}, {}, "train_filenames names 'images/x.png', which is no frame"),
        ({}, {"object_mask_path": "gone.png"}, "gone.png of .* does not exist"),
        ({}, {"transform_matrix": [[1, 0], [0, 1]]}, "transform_matrix has shape 2x2"),
    ],
)
def test_what_is_wrong_is_named(write, top, frame, message):
    with pytest.raises(NerfroError, match=message):
        load(write(3, top=SHARED | top, frame=lambda i: frame))


def test_missing_things_are_named(write, tmp_path):
    with pytest.raises(NerfroError, match=r"holds no transforms_<split>.json"):
        load(tmp_path)
    with pytest.raises(NerfroError, match="is not a folder"):
        load(tmp_path / "gone")
    root = write(3, top={})
    with pytest.raises(NerfroError, match="has neither 'fl_x' nor a valid 'camera_angle_x'"):
        load(root)
    with pytest.raises(NerfroError, match="has no split 'dev'"):
        load(root, "dev")
    (root / "transforms.json").write_text('{"frames": [')
    with pytest.raises(NerfroError, match="truncated"):
        load(root)


def test_frames_without_an_image_are_skipped_in_one_line_or_refused(write, capsys):
    root = write(6)
    for i in (1, 4):
        (root / f"images/f_{i}.png").unlink()
    source = NerfstudioData(str(root), near=0.5, far=9.0, test_every=4)
    assert [name[-7:] for name in source.load("train").names] == ["f_2.png", "f_3.png", "f_5.png"]
    assert [name[-7:] for name in source.load("test").names] == ["f_0.png"]
    assert capsys.readouterr().out.count("2 of 6 frames have no image and are skipped: ./images/f_4.png, ") == 1
    with pytest.raises(NerfroError, match=r"image .*images/f_4\.png does not exist"):
        load(root, missing="refuse")
    for i in range(6):
        (root / f"images/f_{i}.png").unlink(missing_ok=True)
    with pytest.raises(NerfroError, match=r"f_5\.png does not exist"):
        load(root)


def test_near_and_far_are_found_from_the_cameras(write):
    # They look at about the origin from a distance of 3.
    cameras = NerfstudioData(str(write(12))).load("train").cameras
    assert 0 < cameras.near < 1
    assert 5 < cameras.far < 7
    given = NerfstudioData(str(write(12)), far=4.0).load("test").cameras
    assert (given.near, given.far) == (cameras.near, 4.0)


def test_near_and_far_hold_the_sparse_points_where_there_are_any(write):
    root = write(12, top=SHARED | {"ply_file_path": "sparse_pc.ply"})
    points = np.random.default_rng(0).normal(size=(200, 3))
    points *= 0.2 / np.linalg.norm(points, axis=1, keepdims=True)
    trimesh.PointCloud(points).export(root / "sparse_pc.ply")
    cameras = NerfstudioData(str(root)).load("train").cameras
    assert cameras.near == pytest.approx(0.9 * 2.8, rel=0.03)
    assert cameras.far == pytest.approx(1.1 * 3.2, rel=0.03)
    (root / "sparse_pc.ply").write_bytes(b"ply?")
    with pytest.raises(NerfroError, match=r"sparse_pc\.ply holds no points"):
        NerfstudioData(str(root)).load("train")


def test_cameras_that_look_nowhere_in_common_ask_for_near_and_far(write):
    def outwards(i):
        pose = camera_to_world(i, "opengl")
        pose[:3, :3] = pose[:3, :3] @ np.diag([-1.0, 1.0, -1.0])  # turned round
        return {"transform_matrix": pose.tolist()}

    root = write(12, frame=outwards)
    with pytest.raises(NerfroError, match=r"data\.near and data\.far cannot be found"):
        NerfstudioData(str(root)).load("train")
    assert load(root).cameras.near == 0.5

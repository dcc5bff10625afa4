"""`python -m nerfro.calibrate` on photographs of boards whose lens and poses are known."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

pytest.importorskip("cv2")
pytest.importorskip("pyapriltags")

from nerfro.data.formats.transforms import OpenCVData
from nerfro.poses import calibration, collection
from nerfro.poses.boards import TagBoard, TagDetections, tag_grid, twelve_faces
from nerfro.poses.calibration import calibrate_by_tags
from nerfro.poses.collection import luminance
from tests.sheet_photographs import angle, around, photograph

SIZE = (640, 480)
MATRIX = np.array([[700.0, 0, 324.0], [0, 707.0, 236.0], [0, 0, 1]])
NUM_VIEWS = 7
BOARDS = {
    "twelve": (["board=twelve_faces"], twelve_faces, 1.7),
    "grid": (["board=grid", "columns=4", "rows=5"], lambda: tag_grid(5, 4, 0.05), 1.5),
}


def take(folder: Path, board: TagBoard, distance: float) -> dict[str, np.ndarray]:
    """Photographs p_0, p_2, ... of the board, and p_1, p_3 of an empty wall; the poses of those with the board."""
    generator = np.random.default_rng(3)
    folder.mkdir()
    sheets = board.sheets()
    truth = {}
    for view, pose in enumerate(around(sheets, NUM_VIEWS, distance, generator)):
        truth[f"p_{2 * view}.png"] = pose
        Image.fromarray(photograph(sheets, MATRIX, pose, SIZE, generator)).save(folder / f"p_{2 * view}.png")
    for view in (1, 3):
        Image.fromarray(photograph([], MATRIX, pose, SIZE, generator)).save(folder / f"p_{view}.png")
    return truth


@pytest.mark.parametrize("kind", BOARDS)
def test_lens_and_poses_are_recovered(kind: str, tmp_path: Path, command: Callable[..., str]) -> None:
    options, make, distance = BOARDS[kind]
    truth = take(tmp_path / "photos", make(), distance)
    out = tmp_path / "data"
    printed = command("calibrate", f"images={tmp_path / 'photos'}", f"out={out}", "test_every=4", *options)
    report = json.loads((out / "calibration.json").read_text())
    # Names stay with their poses though images between them are skipped, and those are listed.
    assert set(report["skipped"]) == {"p_1.png", "p_3.png"}
    assert "skipped: p_1.png: 0 " in printed
    assert set(report["images"]) == set(truth)
    assert max(image["error"] for image in report["images"].values()) < 0.5
    np.testing.assert_allclose(report["cam_mat"], MATRIX, atol=5.0)
    rotations, positions = [], []
    for split, count in (("train", 3), ("val", 2), ("test", 2)):
        document = json.loads((out / f"transforms_{split}.json").read_text())
        assert len(document["frames"]) == count
        for frame in document["frames"]:
            found, true = np.array(frame["transform_matrix"])[:3], truth[Path(frame["file_path"]).name]
            rotations.append(angle(found, true))
            positions.append(np.linalg.norm(found[:, 3] - true[:, 3]) / np.linalg.norm(true[:, 3]))
    assert np.median(rotations) < 0.1
    assert np.median(positions) < 0.005
    # The loader reads it, and sees the board's middle where it is: the conventions agree.
    views = OpenCVData(str(out), near=0.01, far=10).load("train")
    assert [Path(name).name for name in views.names] == ["p_10.png", "p_2.png", "p_6.png"]
    middle = np.concatenate([sheet.corners for sheet in make().sheets()]).mean(0)
    pixels, depth = views.cameras.project(torch.from_numpy(middle[None]).float())
    for view, name in enumerate(views.names):
        pose = truth[Path(name).name]
        expected = MATRIX @ pose[:, :3].T @ (middle - pose[:, 3])
        assert depth[view, 0] > 0
        np.testing.assert_allclose(pixels[view, 0].numpy(), expected[:2] / expected[2], atol=0.5)
    with Image.open(out / "cameras.png") as plot:
        assert np.ptp(np.asarray(plot.convert("L"))) > 100


def test_detected_tag_corners_are_not_displaced_outwards(tmp_path: Path) -> None:
    generator = np.random.default_rng(0)
    board = twelve_faces()
    outward = []
    for pose in around(board.sheets(), 3, 1.7, generator):
        Image.fromarray(photograph(board.sheets(), MATRIX, pose, SIZE, generator)).save(tmp_path / "p.png")
        found = board.detect(luminance(tmp_path / "p.png"))
        seen = (found.board_points - pose[:, 3]) @ pose[:, :3] @ MATRIX.T
        true = (seen[:, :2] / seen[:, 2:]).reshape(-1, 4, 2)
        away = true - true.mean(1, keepdims=True)
        away /= np.linalg.norm(away, axis=-1, keepdims=True)
        outward.append(((found.image_points.reshape(-1, 4, 2) - true) * away).sum(-1).ravel())
    # A median, for some tags are seen in part; 0.2 where edges are looked for in sRGB values.
    assert abs(np.median(np.concatenate(outward))) < 0.05


def detections_of(
    board: TagBoard, distortion: tuple[float, ...] = ()
) -> tuple[dict[str, TagDetections], list[np.ndarray]]:
    """Noisy projections of all tags that face the camera, without pictures."""
    import cv2

    generator = np.random.default_rng(0)
    poses = around(board.sheets(), 8, 1.7, generator)
    corners = board.tag_corners()
    points, tag_ids = np.concatenate(list(corners.values())), np.repeat(list(corners), 4)
    detections = {}
    for view, pose in enumerate(poses):
        rotation = pose[:, :3].T
        lens = np.array(distortion) if distortion else None
        pixels, _ = cv2.projectPoints(points, cv2.Rodrigues(rotation)[0], -rotation @ pose[:, 3], MATRIX, lens)
        pixels = pixels.reshape(-1, 2) + generator.normal(0, 0.1, (len(points), 2))
        detections[f"v{view}"] = TagDetections(tag_ids, points, pixels)
    return detections, poses


def test_outlier_tags_are_removed() -> None:
    board = twelve_faces()
    detections, poses = detections_of(board)
    detections["v2"].image_points[40:48] += [25, -40]  # two tags, seen through the glass
    detections["v5"].image_points[4:8] += [3, 2]
    found = calibrate_by_tags(detections, SIZE, "pinhole")
    assert found.num_outliers == 12
    for view, pose in enumerate(poses):
        assert angle(found.poses[f"v{view}"].camera_to_world, pose) < 0.05
        assert found.poses[f"v{view}"].error < 0.2
    assert abs(found.intrinsics.matrix[0, 0] - 700) < 2
    assert found.intrinsics.focal_deviation is not None
    assert found.intrinsics.focal_deviation < 1


def test_outliers_of_the_last_estimate_are_not_counted() -> None:
    detections, _ = detections_of(twelve_faces())
    detections["v2"].image_points[40:48] += [25, -40]
    found = calibrate_by_tags(detections, SIZE, "pinhole", calibration.TagSettings(max_estimates=1))
    assert found.num_outliers == 0
    assert found.poses["v2"].num_observations == detections["v2"].num_tags


def test_distortion_is_estimated() -> None:
    truth = (-0.15, 0.05, 0.001, -0.002)
    detections, poses = detections_of(tag_grid(6, 6, 0.05), truth)
    found, pinhole = (calibrate_by_tags(detections, SIZE, model) for model in ("opencv", "pinhole"))
    np.testing.assert_allclose(found.intrinsics.distortion, truth, atol=0.02)
    for view, pose in enumerate(poses):
        one = found.poses[f"v{view}"]
        assert angle(one.camera_to_world, pose) < 0.2
        assert one.error < 0.2 < pinhole.poses[f"v{view}"].error


def test_tags_inside_the_objects_mask_do_not_count(tmp_path: Path, command: Callable[..., str]) -> None:
    options = ["board=grid", "columns=4", "rows=5"]
    truth = take(tmp_path / "photos", BOARDS["grid"][1](), 1.5)
    mask = np.zeros(SIZE[::-1], np.uint8)
    mask[100:380, 200:440] = 255
    Image.fromarray(mask).save(tmp_path / "photos" / "mask_p_0.png")
    command("calibrate", f"images={tmp_path / 'photos'}", f"out={tmp_path}", *options)
    images = json.loads((tmp_path / "calibration.json").read_text())["images"]
    assert set(images) == set(truth)
    counts = {name: image["num_observations"] for name, image in images.items()}
    assert counts.pop("p_0.png") <= 15 < min(counts.values())


def test_masks_of_linked_photographs_are_found(tmp_path: Path, command: Callable[..., str]) -> None:
    options, make, distance = BOARDS["grid"]
    names = take(tmp_path / "elsewhere", make(), distance)
    data = tmp_path / "data"
    (data / "masks").mkdir(parents=True)
    (data / "images").symlink_to(tmp_path / "elsewhere")
    for name in names:
        Image.fromarray(np.uint8(255 * (np.indices(SIZE[::-1]).sum(0) < 40))).save(data / "masks" / name)
    printed = command("calibrate", f"images={data / 'images'}", f"out={data}", *options)
    assert "nerfro.preprocess" in printed
    assert OpenCVData(str(data)).load("train").masks is not None


def test_boards_are_printed_in_their_size(tmp_path: Path, command: Callable[..., str]) -> None:
    command("calibrate", "write_board=true", f"out={tmp_path}", "size=0.03")
    assert (tmp_path / "board.pdf").read_bytes().startswith(b"%PDF")
    pages = sorted(tmp_path.glob("board_*.png"))
    assert len(pages) == 12
    board = twelve_faces(0.03)
    with Image.open(pages[8]) as page:
        per_metre = page.info["dpi"][0] / 0.0254
        levels = np.uint8(np.asarray(page.convert("L")))
    found = board.detect(levels)
    assert sorted(set(found.tag_ids)) == list(range(72, 81))
    sides = np.linalg.norm(found.image_points[0::4] - found.image_points[1::4], axis=1) / per_metre
    np.testing.assert_allclose(sides, 0.03, rtol=0.005)
    assert "board.pdf exists; give another out=" in command("calibrate", "write_board=true", f"out={tmp_path}")


def test_mistakes_are_reported_in_one_line(tmp_path: Path, command: Callable[..., str]) -> None:
    photos = tmp_path / "photos"
    photos.mkdir()
    for name in ("a.png", "b.png", "c.png"):
        Image.fromarray(np.full((48, 64), 90, np.uint8)).save(photos / name)
    common = f"images={photos}", f"out={tmp_path}"
    assert "target='chess' is not allowed; choose 'apriltag'" in command("calibrate", *common, "target=chess")
    assert "set out=" in command("calibrate", f"images={photos}")
    assert "set images=" in command("calibrate", f"out={tmp_path}")
    assert "0 of 3 images show at least 3 tags" in command("calibrate", *common)
    assert "set board=grid" in command("calibrate", *common, "columns=3")
    assert "give size= in metres" in command("calibrate", f"out={tmp_path}", "write_board=true", "size=30")
    assert "no tag 587" in command("calibrate", *common, "write_board=true", "board=grid", "columns=30", "rows=30")
    (tmp_path / "cameras.png").write_bytes(b"mine")
    assert "cameras.png exists; give another out=... or overwrite=true" in command("calibrate", *common)
    Image.fromarray(np.full((64, 48), 90, np.uint8)).save(photos / "b.png")
    assert "b.png has 48x64 pixels, but 2 of 3 images have 64x48" in command("calibrate", *common)
    Image.fromarray(np.full((48, 64), 90, np.uint8)).save(photos / "a.jpg")
    assert "several images named a" in command("calibrate", *common)
    assert (tmp_path / "cameras.png").read_bytes() == b"mine"


def test_omitted_photographs_are_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for name in ("a.jpg", "b.jpg"):
        Image.new("RGB", (8, 6)).save(tmp_path / name)
    (tmp_path / "b.HEIC").touch()  # has a converted copy
    collection.list_photographs(tmp_path)
    assert capsys.readouterr().out == ""
    (tmp_path / "c.heic").touch()
    images, _ = collection.list_photographs(tmp_path)
    assert [image.name for image in images] == ["a.jpg", "b.jpg"]
    assert "photographs in HEIC format are left out: c.heic" in capsys.readouterr().out

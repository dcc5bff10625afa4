"""`python -m nerfro.calibrate target=colmap`: models that are imported, and one that is made."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from scipy.ndimage import gaussian_filter

pytest.importorskip("cv2")
pytest.importorskip("pycolmap")

import pycolmap

from nerfro.poses import structure_from_motion
from nerfro.poses.boards import Sheet
from nerfro.poses.structure_from_motion import numeric_order, sequential_pairs
from tests.conftest import refused
from tests.sheet_photographs import angle, look_at, photograph


def synthesized(folder: Path, camera: tuple[str, list[float]], noise: float, form: str = "text") -> Any:
    """Write a model of six images and 30 points to a folder; returns the model."""
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs = options.num_cameras_per_rig = 1
    options.num_frames_per_rig, options.num_points3D = 6, 30
    options.camera_model_id, options.camera_params = getattr(pycolmap.CameraModelId, camera[0]), camera[1]
    model = pycolmap.synthesize_dataset(options)
    generator = np.random.default_rng(0)
    for point in model.points3D.values():
        point.xyz = point.xyz + generator.normal(0, noise, 3)
    folder.mkdir(parents=True)
    getattr(model, f"write_{form}")(folder)
    return model


def blank(folder: Path, names: Iterable[str], size: tuple[int, int]) -> None:
    folder.mkdir()
    for name in names:
        Image.new("RGB", size).save(folder / name)


@pytest.mark.parametrize("form", ["text", "binary"])
def test_models_are_imported(form: str, tmp_path: Path, command: Callable[..., str]) -> None:
    model = synthesized(tmp_path / "sparse" / "0", ("SIMPLE_RADIAL", [1280.0, 512, 384, 0]), 0.004, form)
    expected = {}
    for image in model.images.values():
        pose = image.cam_from_world().matrix()
        squares = []
        for feature in image.points2D:
            if feature.has_point3D():
                x, y, z = pose @ [*model.points3D[feature.point3D_id].xyz, 1]
                squares.append((1280 * x / z + 512 - feature.xy[0]) ** 2 + (1280 * y / z + 384 - feature.xy[1]) ** 2)
        expected[image.name] = pose, 0.5 * np.sqrt(np.mean(squares))
    blank(tmp_path / "images", [*expected, "blurred.png"], (512, 384))  # half the size that was reconstructed
    printed = command("calibrate", f"images={tmp_path / 'images'}", f"out={tmp_path}", "target=colmap", "test_every=3")
    assert "skipped: blurred.png: no pose from COLMAP" in printed
    report = json.loads((tmp_path / "calibration.json").read_text())
    np.testing.assert_allclose(report["cam_mat"], [[640, 0, 256], [0, 640, 192], [0, 0, 1]])
    assert set(report["images"]) == set(expected)
    for split in ("train", "val", "test"):
        for frame in json.loads((tmp_path / f"transforms_{split}.json").read_text())["frames"]:
            pose, error = expected[Path(frame["file_path"]).name]
            found = np.array(frame["transform_matrix"])
            np.testing.assert_allclose(found[:3, :3], pose[:, :3].T, atol=1e-6)
            np.testing.assert_allclose(found[:3, 3], -pose[:, :3].T @ pose[:, 3], atol=1e-6)
            assert error > 0.1
            np.testing.assert_allclose(report["images"][Path(frame["file_path"]).name]["error"], error, atol=1e-3)


def test_models_without_points_have_no_reprojection_errors(tmp_path: Path, command: Callable[..., str]) -> None:
    folder = tmp_path / "sparse" / "0"
    model = synthesized(folder, ("SIMPLE_PINHOLE", [1280.0, 512, 384]), 0.0)
    blank(tmp_path / "images", [image.name for image in model.images.values()], (512, 384))
    (folder / "points3D.txt").unlink()
    printed = command("calibrate", f"images={tmp_path / 'images'}", f"out={tmp_path}", "target=colmap", "test_every=3")
    assert "nan" not in printed
    assert "RuntimeWarning" not in printed
    report = json.loads((tmp_path / "calibration.json").read_text(), parse_constant=pytest.fail)
    assert {(image["error"], image["num_observations"]) for image in report["images"].values()} == {(None, 0)}


def test_inconsistent_models_are_refused(tmp_path: Path) -> None:
    model = synthesized(tmp_path / "model", ("SIMPLE_PINHOLE", [1280.0, 512, 384]), 0.0)
    names = [image.name for image in model.images.values()]
    blank(tmp_path / "images", names, (512, 384))
    file = tmp_path / "model" / "images.txt"
    lines = file.read_text().splitlines()
    lines[-1] = ""  # features that points refer to
    file.write_text("\n".join(lines) + "\n")
    images = [tmp_path / "images" / name for name in names]
    refused("is not a valid COLMAP model", structure_from_motion.import_model, tmp_path / "model", images, (512, 384))


@pytest.mark.parametrize("place", ["sparse/0", "colmap/sparse/0", "."])
def test_existing_model_is_used(place: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    image, model = tmp_path / "images" / "a.png", tmp_path / place
    model.mkdir(parents=True, exist_ok=True)
    (model / "cameras.txt").touch()
    settings = structure_from_motion.SfmSettings()
    found = structure_from_motion.find_model(None, [image], [None], tmp_path / "out", settings, overwrite=False)
    assert found.samefile(model)
    assert f"using the COLMAP model {found}" in capsys.readouterr().out


def test_features_on_and_near_the_object_are_ignored(tmp_path: Path) -> None:
    mask = np.zeros((60, 200), np.uint8)
    mask[20:40, 50:100] = 255
    Image.fromarray(mask).save(tmp_path / "mask_a.png")
    structure_from_motion._write_ignored(
        tmp_path / "mask_a.png", tmp_path / "a.jpg.png", structure_from_motion.SfmSettings()
    )
    ignored = np.asarray(Image.open(tmp_path / "a.jpg.png")) == 0
    assert ignored[mask > 0].all()
    assert ignored[30, 48:102].all()  # 1 % of the width farther
    assert not ignored[30, 47]
    assert not ignored[30, 102]


def test_missing_model_is_computed(tmp_path: Path, command: Callable[..., str]) -> None:
    generator = np.random.default_rng(1)
    sheets = []
    for corner, right, down in (
        ((0, 1, 0), (1, 0, 0), (0, -1, 0)),
        ((0, 1, 0.6), (1, 0, 0), (0, 0, -0.6)),
        ((0, 0, 0.6), (0, 1, 0), (0, 0, -0.6)),
    ):
        noise = sum(gaussian_filter(generator.normal(size=(96, 96)), blur) * 2 * blur for blur in (0.6, 1.5, 4))
        steps = np.array([np.zeros(3), right, np.add(right, down), down])
        sheets.append(Sheet("", np.uint8(np.clip(128 + 60 * noise, 0, 255)), np.array(corner) + steps))
    matrix = np.array([[400.0, 0, 160], [0, 400, 120], [0, 0, 1]])
    (tmp_path / "images").mkdir()
    truth = {}
    for view in range(6):
        azimuth = np.radians(-60 + 10 * view)
        centre = np.array([0.4, 0.4, 0.2]) + 1.5 * np.array([np.cos(azimuth + 0.6), np.sin(azimuth + 0.3), 0.7])
        stem = f"#ü '%20' [p] ({view}).v"  # as telephones, downloads and people name photographs
        truth[f"{stem}.png"] = pose = look_at(centre, np.array([0.45, 0.45, 0.2]))
        picture = photograph(sheets, matrix, pose, (320, 240), generator)
        picture[90:150, 130:190] = generator.integers(0, 256, (60, 60)) if view % 2 else 128  # an object, other in each
        Image.fromarray(picture).save(tmp_path / "images" / f"{stem}.png")
        mask = np.zeros((240, 320), np.uint8)
        mask[90:150, 130:190] = 255
        Image.fromarray(mask).save(tmp_path / "images" / f"mask_{stem}.png")
    printed = command("calibrate", f"images={tmp_path / 'images'}", f"out={tmp_path}", "target=colmap", "test_every=3")
    assert "6 of them with a mask" in printed
    model = pycolmap.Reconstruction(tmp_path / "sparse" / "0")
    for image in model.images.values():
        places = np.array([feature.xy for feature in image.points2D])
        assert not ((places > [130, 90]) & (places < [190, 150])).all(1).any()
    report = json.loads((tmp_path / "calibration.json").read_text())
    assert set(report["images"]) == set(truth)
    assert max(image["error"] for image in report["images"].values()) < 0.5
    found = {}
    for split in ("train", "val", "test"):
        for frame in json.loads((tmp_path / f"transforms_{split}.json").read_text())["frames"]:
            found[Path(frame["file_path"]).name] = np.array(frame["transform_matrix"])[:3]
    # Turns from the first view do not depend on the world's axes.
    first = next(iter(truth))
    for name in truth:
        turns = [poses[first][:, :3].T @ poses[name][:, :3] for poses in (found, truth)]
        assert angle(turns[0], turns[1]) < 0.5


def test_incomplete_model_of_colmap_is_removed(tmp_path: Path) -> None:
    synthesized(tmp_path / "model", ("SIMPLE_PINHOLE", [1280.0, 512, 384]), 0.0, "binary")
    images = tmp_path / "model" / "images.bin"
    images.write_bytes(images.read_bytes()[:-1])
    refused("COLMAP cannot write to", structure_from_motion._copy_model, tmp_path / "model", tmp_path / "sparse" / "0")
    assert not (tmp_path / "sparse").exists()


@pytest.mark.parametrize(
    ("camera", "folder", "advised"),
    [
        (("RADIAL", [1280.0, 512, 384, 0.05, 0.0]), "out/sparse", False),
        (("SIMPLE_PINHOLE", [1280.0, 512, 384]), "out/sparse", True),
        (("SIMPLE_PINHOLE", [1280.0, 512, 384]), "model", False),  # a given model keeps its lens
    ],
)
def test_distortion_is_advised_only_if_the_option_has_an_effect(
    camera: tuple[str, list[float]], folder: str, advised: bool, tmp_path: Path, command: Callable[..., str]
) -> None:
    model = tmp_path / folder / "0"
    names = [image.name for image in synthesized(model, camera, 0.02).images.values()]
    blank(tmp_path / "images", names, (1024, 768))
    own = [f"images={tmp_path / 'images'}", f"out={tmp_path / 'out'}", "target=colmap"]
    printed = command("calibrate", *own, f"reconstruction={model}", "test_every=3")
    report = json.loads((tmp_path / "out" / "calibration.json").read_text())
    assert set(report["images"]) == set(names)
    assert np.mean([image["error"] for image in report["images"].values()]) > 0.7
    assert ("lens=radial" in printed) == advised


def test_numbered_names_give_the_order_of_a_sequence() -> None:
    assert numeric_order([f"IMG_{number}.JPG" for number in range(7039, 7136, 3)]) == list(range(33))
    unsorted = [f"p_{number}.png" for number in (1, 10, 11, *range(2, 10))]
    assert numeric_order(unsorted) == [0, *range(3, 11), 1, 2]
    assert numeric_order(["left.png", "right.png"]) is None
    assert numeric_order(["a_1.png", "b_2.png", "a_3.png"]) is None
    assert numeric_order(["20240101.png", "20260730.png", "20260731.png", "20260801.png"]) is None


def test_sequence_is_matched_densely_with_near_and_sparsely_with_far_frames() -> None:
    pairs = sequential_pairs(range(40))
    assert len(pairs) == len(set(pairs)) == sum(40 - stride for stride in (*range(1, 11), 16, 32))
    assert {abs(i - j) for i, j in pairs} == {*range(1, 11), 16, 32}
    assert sequential_pairs([2, 0, 1]) == [(2, 0), (0, 1), (2, 1)]


def test_pycolmap_does_not_change_the_handler_of_sigterm() -> None:
    program = "import signal; signal.signal(15, lambda *_: exit(130)); "
    program += (
        "from nerfro.poses.structure_from_motion import require_pycolmap; require_pycolmap(); signal.raise_signal(15)"
    )
    assert subprocess.run([sys.executable, "-c", program], stderr=subprocess.DEVNULL).returncode == 130

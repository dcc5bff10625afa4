"""A tiny data set in every format: six photographs of known cameras, of which 0 and 3 are the test views."""

from __future__ import annotations

import io
import json
import struct
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from nerfro.data.base import DataSource, Views
from nerfro.data.formats import colmap_model, idr, llff, refref
from nerfro.data.formats.colmap import ColmapData
from nerfro.data.formats.transforms import BlenderData, NerfstudioData, OpenCVData

from .photographs import (
    CX,
    CY,
    FX,
    FY,
    HEIGHT,
    POINTS,
    WIDTH,
    camera_to_world,
    picture,
    save_mask,
    save_picture,
    world_to_camera,
)

TRAIN, TEST = (1, 2, 4, 5), (0, 3)
IDEAL = (FX, FX, WIDTH / 2, HEIGHT / 2)
ANGLE = 2 * np.arctan(0.5 * WIDTH / FX)
K, P = (-0.12, 0.03, 0.004, -0.001), (0.002, -0.003)
SHARED = {"camera_model": "OPENCV", "fl_x": FX, "fl_y": FY, "cx": CX, "cy": CY, "w": WIDTH, "h": HEIGHT}
DISTORTION = {"k1": K[0], "k2": K[1], "k3": K[2], "k4": K[3], "p1": P[0], "p2": P[1]}
CAM_MAT = [[FX, 0.0, CX], [0.0, FY, CY], [0.0, 0.0, 1.0]]
OPENCV = ("OPENCV", (FX, FY, CX, CY, *K[:2], *P))
NEAR, FAR = 1.5, 4.5  # depths in LLFF's file
# IDR's world is larger than the unit sphere of the object and lies elsewhere.
SCALE, SHIFT = 2.5, np.array([0.3, -0.2, 0.7])


def change_json(path: Path, change: Callable[[dict], Any]) -> None:
    document = json.loads(path.read_text())
    change(document)
    path.write_text(json.dumps(document))


def write_transforms(
    root: Path, top: dict, seeds: Sequence[int] = TRAIN, split: str = "train", axes: str = "opengl", masks: bool = False
) -> Path:
    """Write transforms_<split>.json with images in a folder of the split, and return the root."""
    frames = []
    for seed in seeds:
        save_picture(root / split / f"r_{seed}.png", seed)
        if masks:
            save_mask(root / split / f"mask_r_{seed}.png", seed)
        frames.append({"file_path": f"./{split}/r_{seed}", "transform_matrix": camera_to_world(seed, axes).tolist()})
    (root / f"transforms_{split}.json").write_text(json.dumps(top | {"frames": frames}))
    return root


def write_blender(root: Path, masks: bool = False) -> Path:
    write_transforms(root, {"camera_angle_x": ANGLE}, TEST, "test", masks=masks)
    return write_transforms(root, {"camera_angle_x": ANGLE}, masks=masks)


def write_opencv(root: Path, masks: bool = False, **changes: object) -> Path:
    top = {"cam_mat": CAM_MAT, "dist": [*K[:2], *P, K[2]]} | changes
    write_transforms(root, top, TEST, "test", "opencv", masks)
    return write_transforms(root, top, TRAIN, "train", "opencv", masks)


def write_nerfstudio(
    root: Path,
    masks: bool = False,
    seeds: Iterable[int] = (4, 0, 5, 2, 1, 3),
    top: dict = SHARED | DISTORTION,
    frame: Callable[[int], dict] = lambda seed: {},
    name: str = "transforms.json",
) -> Path:
    """Write one file; `top` gives its keys, `frame` further keys of each frame."""
    frames = []
    for i in seeds:
        save_picture(root / f"images/f_{i}.png", i)
        entry = {"file_path": f"./images/f_{i}.png", "transform_matrix": camera_to_world(i, "opengl").tolist()}
        if masks:
            save_mask(root / f"silhouettes/s{i}.png", i)
            entry["object_mask_path"] = f"silhouettes/s{i}.png"
        frames.append(entry | frame(i))
    (root / name).write_text(json.dumps(top | {"frames": frames}))
    return root


def write_colmap(
    root: Path,
    masks: bool = False,
    form: str = "binary",
    cameras: dict = {1: OPENCV},  # noqa: B006
    camera: Callable[[int], int] = lambda seed: 1,
    points: np.ndarray = POINTS,
) -> Path:
    """Write images and a model; `cameras` are models and parameters by identifier, `camera` the one of each image."""
    images = []
    for i in (4, 0, 5, 2, 1, 3):  # in no order
        save_picture(root / f"images/top/v{i}.png", i)
        if masks:
            save_mask(root / f"masks/top/v{i}.png.png", i)
        matrix = world_to_camera(i)
        quaternion = np.roll(Rotation.from_matrix(matrix[:, :3]).as_quat(), 1)  # scalar first
        images.append((f"top/v{i}.png", camera(i), (*quaternion, *matrix[:, 3])))
    folder = root / "sparse/0"
    folder.mkdir(parents=True, exist_ok=True)
    (_write_colmap_binary if form == "binary" else _write_colmap_text)(folder, cameras, images, points)
    return root


def _write_colmap_binary(folder: Path, cameras: dict, images: list, points: np.ndarray) -> None:
    numbers = {name: i for i, (name, _) in enumerate(colmap_model.CAMERA_MODELS)}
    content = struct.pack("<Q", len(cameras))
    for number, (model, params) in cameras.items():
        content += struct.pack(f"<iiQQ{len(params)}d", number, numbers[model], WIDTH, HEIGHT, *params)
    (folder / "cameras.bin").write_bytes(content)
    content = struct.pack("<Q", len(images))
    for i, (name, camera, pose) in enumerate(images, 1):
        content += struct.pack("<i7di", i, *pose, camera) + name.encode() + b"\0"
        # The second image observes all points; the features of the others belong to none.
        seen = range(1, len(points) + 1) if i == 2 else (-1, -1)
        content += struct.pack("<Q", len(seen)) + b"".join(struct.pack("<ddq", 1.5, 2.5, n) for n in seen)
    (folder / "images.bin").write_bytes(content)
    content = struct.pack("<Q", len(points))
    for i, point in enumerate(points, 1):
        content += struct.pack("<Q3d3BdQ", i, *point, 9, 8, 7, 0.4, 1) + struct.pack("<ii", 2, i - 1)
    (folder / "points3D.bin").write_bytes(content)


def _write_colmap_text(folder: Path, cameras: dict, images: list, points: np.ndarray) -> None:
    def row(*values: object) -> str:
        return " ".join(repr(float(v)) if isinstance(v, float) else str(v) for v in values) + "\n"

    lines = [row(n, model, WIDTH, HEIGHT, *map(float, p)) for n, (model, p) in cameras.items()]
    (folder / "cameras.txt").write_text("# Camera list\n" + "".join(lines))
    lines = []
    for i, (name, camera, pose) in enumerate(images, 1):
        # The second line lists features and may be empty.
        seen = " ".join(f"1.5 2.5 {n}" for n in range(1, len(points) + 1)) if i == 2 else ""
        lines.append(row(i, *map(float, pose), camera, name) + seen + "\n")
    (folder / "images.txt").write_text("# Image list\n" + "".join(lines))
    lines = [row(i, *map(float, point), 9, 8, 7, 0.4, 2, i - 1) for i, point in enumerate(points, 1)]
    (folder / "points3D.txt").write_text("".join(lines))


def write_llff(root: Path, masks: bool = False, seeds: Iterable[int] = range(6), size=(HEIGHT, WIDTH, FX)) -> Path:
    """Write views with depths from 1.5 + i / 10 to 4.5 - i / 10."""
    rows = []
    for i, seed in enumerate(seeds):
        save_picture(root / f"images/img_{i:03d}.png", seed)
        if masks:
            save_mask(root / f"images/mask_img_{i:03d}.png", seed)
        right, up, back, centre = camera_to_world(seed, "opengl")[:3].T
        row = np.stack([-up, right, back, centre, size], -1)
        rows.append([*row.ravel(), NEAR + i / 10, FAR - i / 10])
    np.save(root / "poses_bounds.npy", np.array(rows))
    return root


def write_idr(root: Path, masks: bool = False, **changes: np.ndarray | None) -> Path:
    """Write views whose unit sphere is the world of `photographs`; `changes` replaces or removes matrices."""
    intrinsics = np.array([[FX, 0, CX - 0.5], [0, FY, CY - 0.5], [0, 0, 1]])  # pixel centres are whole numbers
    scale = np.diag([SCALE, SCALE, SCALE, 1.0])
    scale[:3, 3] = SHIFT
    arrays: dict[str, Any] = {}
    for i in range(6):
        save_picture(root / f"image/{i:06d}.png", i)
        if masks:
            save_mask(root / f"mask/{i:03d}.png", i)  # DTU's mask numbers are shorter
        matrix = np.vstack([intrinsics @ world_to_camera(i), [0, 0, 0, 1]]) @ np.linalg.inv(scale)
        arrays |= {f"world_mat_{i}": matrix.astype(np.float32), f"scale_mat_{i}": scale}
    np.savez(root / "cameras_sphere.npz", **{k: v for k, v in (arrays | changes).items() if v is not None})
    return root


def write_refref(
    root: Path,
    masks: bool = True,
    scene: str = "cube_smcvx_ampoule",
    files: Sequence[Sequence[int]] = ((1, 2, 0), (3, 4, 5)),
    drop: str | None = None,
    far_away: int | None = None,
) -> Path:
    parquet, pyarrow = pytest.importorskip("pyarrow.parquet"), pytest.importorskip("pyarrow")

    def png(levels: np.ndarray) -> dict:
        stream = io.BytesIO()
        Image.fromarray(levels).save(stream, "PNG")
        return {"bytes": stream.getvalue(), "path": None}

    (root / "cubebg_single-convex").mkdir(exist_ok=True)
    for number, seeds in enumerate(files):
        rows = []
        for i in seeds:
            pose = camera_to_world(i, "opengl").copy()
            pose[:3, 3] *= 2 if i == far_away else 1
            levels = picture(i)
            row = {"image": png(levels), "depth": png(levels[..., 0]), "transform_matrix": pose.tolist()}
            row["mask"] = png(np.uint8(255 * (levels[..., 0] > 127)))
            rows.append({key: value for key, value in row.items() if key != drop})
        file = f"cubebg_single-convex/{scene}-{number:05d}-of-{len(files):05d}.parquet"
        parquet.write_table(pyarrow.Table.from_pylist(rows), root / file)
    return root


@dataclass(frozen=True)
class Format:
    """A data format: its class, the writer, options of the class, views of the splits and the lens."""

    source: type[Any]
    write: Callable[..., Path]
    options: dict[str, Any] = field(default_factory=dict)
    train: Sequence[int] = TRAIN
    test: Sequence[int] = TEST
    lens: dict[str, Any] = field(default_factory=dict)

    def open(self, root: Path, **options: Any) -> DataSource:
        return self.source(str(root), **{"near": 0.5, "far": 9.0} | self.options | options)

    def load(self, root: Path, split: str = "train", **options: Any) -> Views:
        return self.open(root, **options).load(split)


THIRD = {"test_every": 3}
REFREF_LENS = (0.5 * WIDTH / np.tan(0.5 * 1.1656107902526855),) * 2 + (WIDTH / 2, HEIGHT / 2)
BROWN = {"k": K[:2], "p": P}
FORMATS = {
    "blender": Format(BlenderData, write_blender, lens={"lens": IDEAL}),
    "opencv": Format(OpenCVData, write_opencv, lens={"k": K[:3], "p": P}),
    "nerfstudio": Format(NerfstudioData, write_nerfstudio, THIRD, lens={"k": K, "p": P}),
    "colmap": Format(ColmapData, write_colmap, THIRD, lens=BROWN),
    "llff": Format(llff.LlffData, write_llff, {"frame": "file"} | THIRD, lens={"lens": IDEAL}),
    "idr": Format(idr.IdrData, write_idr, THIRD),
    "refref": Format(refref.RefRefData, write_refref, train=[1, 2], test=[4, 5], lens={"lens": REFREF_LENS}),
}


@pytest.fixture
def few_refref_views(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let a split of RefRef have two views instead of a hundred."""
    monkeypatch.setattr(refref, "_VIEWS_PER_SPLIT", 2)

"""RefRef's parquet files, written here and read back."""

from __future__ import annotations

import io
import math

import numpy as np
import pytest
from PIL import Image

from nerfro.data import refref
from nerfro.data.blender import BlenderData
from nerfro.data.refref import RefRefData
from nerfro.errors import NerfroError

from .photographs import HEIGHT, WIDTH, camera_to_world, check_views, picture

pyarrow = pytest.importorskip("pyarrow")
parquet = pytest.importorskip("pyarrow.parquet")

FOCAL = 0.5 * WIDTH / math.tan(0.5 * 1.1656107902526855)


def png(levels: np.ndarray) -> dict:
    stream = io.BytesIO()
    Image.fromarray(levels).save(stream, "PNG")
    return {"bytes": stream.getvalue(), "path": None}


def pose(view: int, farther: float) -> np.ndarray:
    matrix = camera_to_world(view, "opengl").copy()
    matrix[:3, 3] *= farther
    return matrix


@pytest.fixture
def write(tmp_path, monkeypatch):
    """Write six views in two files; a split has two instead of a hundred."""
    monkeypatch.setattr(refref, "_VIEWS_PER_SPLIT", 2)

    def write(scene="cube_smcvx_ampoule", parts=((0, 1, 2), (3, 4, 5)), drop=None, far_away=None):
        folder = tmp_path / "cubebg_single-convex"
        folder.mkdir(exist_ok=True)
        for part, seeds in enumerate(parts):
            rows = [
                {
                    "image": png(picture(i)),
                    "depth": png(picture(i)[..., 0]),
                    "mask": png(np.uint8(255 * (picture(i)[..., 0] > 127))),
                    "transform_matrix": pose(i, 2 if i == far_away else 1).tolist(),
                }
                for i in seeds
            ]
            table = pyarrow.Table.from_pylist([{k: v for k, v in row.items() if k != drop} for row in rows])
            parquet.write_table(table, folder / f"{scene}-{part:05d}-of-{len(parts):05d}.parquet")
        return tmp_path

    return write


def test_splits_are_the_rows_in_turn_across_files(write):
    source = RefRefData(str(write()))
    lens = {"lens": (FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2)}
    for split, seeds in (("train", [0, 1]), ("val", [2, 3]), ("test", [4, 5])):
        views = source.load(split)
        check_views(views, seeds, **lens)
        assert views.cameras.far == pytest.approx(3 + math.sqrt(3) * 7.3)
    assert views.names == ["image_0004.png", "image_0005.png"]


def test_bounds_are_those_of_all_splits_and_no_file_is_named_that_is_gone(write):
    source = RefRefData(str(write(far_away=4)))
    for split in ("train", "val", "test"):
        views = source.load(split)
        assert views.cameras.far == pytest.approx(6 + math.sqrt(3) * 7.3)
        assert not views.frames


def test_one_of_several_scenes(write):
    root = write()
    write("env_mmncvx_jar", parts=((5, 4),))
    with pytest.raises(NerfroError, match=r"several scenes; choose data\.scene=cube_smcvx_ampoule, env_mmncvx_jar"):
        RefRefData(str(root)).load("train")
    check_views(RefRefData(str(root), scene="env_mmncvx_jar").load("train"), [5, 4],
                lens=(FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2))  # fmt: skip
    with pytest.raises(NerfroError, match="holds 2 rows, none from 4 on"):
        RefRefData(str(root), scene="env_mmncvx_jar").load("test")


def test_folders_of_refref_are_read_as_blender_data(write_blender, random_image, edit_transforms):
    mask = np.zeros((6, 8), np.uint8)
    mask[2:5, 1:4] = 255
    root = write_blender([random_image(0)])
    Image.fromarray(mask).save(root / "silhouette.png")
    edit_transforms(root, lambda document: document["frames"][0].update(mask_file_path="./silhouette.png"))
    np.testing.assert_array_equal(BlenderData(str(root)).load("train").masks[0].numpy(), mask / 255)


def test_what_is_wrong_is_named(write, tmp_path):
    with pytest.raises(NerfroError, match=r"holds no \*\.parquet; download"):
        RefRefData(str(tmp_path)).load("train")
    root = write(drop="mask")
    with pytest.raises(NerfroError, match="has no column 'mask'; is it a file of RefRef"):
        RefRefData(str(root)).load("train")
    file = next(root.rglob("*-00000-*.parquet"))
    file.write_bytes(file.read_bytes()[:300])
    with pytest.raises(NerfroError, match=r"parquet cannot be read .* download it again"):
        RefRefData(str(root)).load("train")
    with pytest.raises(NerfroError, match="has no split 'dev'"):
        RefRefData(str(root)).load("dev")

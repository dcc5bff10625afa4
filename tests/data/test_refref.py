"""RefRef's parquet files."""

import math

import numpy as np
import pytest

from nerfro.core.errors import NerfroError
from nerfro.data.formats import refref
from tests.conftest import refused

from .formats import REFREF_LENS, few_refref_views, write_refref  # noqa: F401
from .photographs import check_views

RefRefData = refref.RefRefData

pytestmark = pytest.mark.usefixtures("few_refref_views")
pytest.importorskip("pyarrow")


def test_splits_number_their_rows_across_files_with_equal_bounds(tmp_path):
    source = RefRefData(str(write_refref(tmp_path, far_away=5)))
    for split, num in (("train", [1, 2]), ("val", [0, 3]), ("test", [4, 5])):
        views = source.load(split)
        assert views.cameras.far == pytest.approx(6 + math.sqrt(3) * 7.3)
        assert not views.frames, "the unpacked files are deleted with the process"
        if split != "test":
            check_views(views, num, lens=REFREF_LENS)
    assert views.names == ["image_0004.png", "image_0005.png"]


@pytest.mark.parametrize("image", ["text", 3, [1, 2], b"bytes", {"bytes": "text"}, {"path": "a.png"}])
def test_rows_without_an_image_are_named(tmp_path, image):
    parquet, pyarrow = pytest.importorskip("pyarrow.parquet"), pytest.importorskip("pyarrow")
    row = {"image": image, "mask": image, "transform_matrix": np.eye(4).tolist()}
    parquet.write_table(pyarrow.Table.from_pylist([row]), tmp_path / "scene-00000-of-00001.parquet")
    refused(r"row 0: 'image' holds no image; download the file again", lambda: RefRefData(str(tmp_path)).load("train"))
    for scene in ("/etc", "**", "a/../b"):
        with pytest.raises(NerfroError, match=r"holds no .*\.parquet; download"):
            RefRefData(str(tmp_path), scene=scene).load("train")


def test_wrong_files_are_named(tmp_path):
    refused(r"holds no \*\.parquet; download", lambda: RefRefData(str(tmp_path)).load("train"))
    root = write_refref(tmp_path, drop="mask")
    refused("has no column 'mask', so it is not a file of RefRef", lambda: RefRefData(str(root)).load("train"))
    file = next(root.rglob("*-00000-*.parquet"))
    file.write_bytes(file.read_bytes()[:300])
    refused(r"parquet cannot be read .* download it again", lambda: RefRefData(str(root)).load("train"))

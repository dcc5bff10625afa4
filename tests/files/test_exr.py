"""OpenEXR files keep values to the bit, and damaged ones are told."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from nerfro.files.exr import load_exr, save_exr

# Mitsuba's reader never comes back on a machine of one core.
READ = "import sys, numpy, mitsuba as m; m.set_variant('scalar_rgb'); numpy.save(sys.argv[2], m.Bitmap(sys.argv[1]))"


@pytest.mark.parametrize("num_channels", [1, 3])
def test_what_is_written_is_read_by_mitsuba(num_channels: int, tmp_path: Path) -> None:
    pytest.importorskip("mitsuba")
    values = np.random.default_rng(0).normal(scale=1e3, size=(7, 33, num_channels)).astype(np.float32)
    save_exr(tmp_path / "picture.exr", values)
    try:
        files = [str(tmp_path / name) for name in ("picture.exr", "values.npy")]
        subprocess.run([sys.executable, "-c", READ, *files], timeout=20, check=True)
    except subprocess.TimeoutExpired:
        pytest.skip("Mitsuba's reader waits for ever here")
    np.testing.assert_array_equal(np.load(tmp_path / "values.npy").reshape(values.shape), values)


def test_what_is_written_is_read_to_the_bit(tmp_path: Path) -> None:
    values = np.random.default_rng(0).normal(scale=1e3, size=(7, 33, 3)).astype(np.float32)
    save_exr(tmp_path / "picture.exr", values)
    np.testing.assert_array_equal(load_exr(tmp_path / "picture.exr"), values)


def test_damaged_and_grey_files_are_told(tmp_path: Path) -> None:
    save_exr(tmp_path / "grey.exr", np.ones((2, 2, 1), np.float32))
    (tmp_path / "damaged.exr").write_bytes(b"v/1\x01and no more")
    for name in ("grey", "damaged"):
        with pytest.raises(OSError, match="no OpenEXR picture of red, green and blue"):
            load_exr(tmp_path / f"{name}.exr")

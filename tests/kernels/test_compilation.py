"""Kernels compile wherever nerfro is installed."""

from __future__ import annotations

from pathlib import Path

import numba
import pytest

from nerfro.kernels.compilation import compiled


def _square(x: float) -> float:
    return x * x


def test_machine_code_is_kept_in_the_cache_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NERFRO_CACHE", str(tmp_path))
    before = numba.config.CACHE_DIR
    assert compiled(_square)(3.0) == 9.0
    assert list(tmp_path.rglob("*.nbi"))
    # Other packages' kernels are none of our business.
    assert before == numba.config.CACHE_DIR


def test_kernels_work_where_nothing_can_be_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("NERFRO_CACHE", str(tmp_path / "file" / "below"))
    assert compiled(_square)(3.0) == 9.0

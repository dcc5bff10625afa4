"""Mapped arrays are whole or not there, and the cache folder does not grow without end."""

import os
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from nerfro.errors import NerfroError
from nerfro.files import cache as cache_module
from nerfro.files.mapped import mapped_array
from tests.conftest import refused

SHAPE, TYPE = (4, 1000), np.dtype(np.uint16)


def rows() -> Iterator[np.ndarray]:
    return iter(np.arange(4000, dtype=np.uint16).reshape(SHAPE))


def broken() -> Iterator[np.ndarray]:
    yield np.zeros(1000, np.uint16)
    raise NerfroError("a picture cannot be read")


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("NERFRO_CACHE", str(tmp_path))
    return tmp_path


def test_what_is_written_to_an_array_stays_in_the_process() -> None:
    array = mapped_array("a", SHAPE, TYPE, rows)
    assert np.array_equal(array, np.arange(4000).reshape(SHAPE))
    array[0] = 7
    assert np.array_equal(mapped_array("a", SHAPE, TYPE, rows), np.arange(4000).reshape(SHAPE))


def test_nothing_is_left_of_an_array_that_could_not_be_made(cache: Path) -> None:
    refused("a picture cannot be read", mapped_array, "a", SHAPE, TYPE, broken)
    assert list(cache.iterdir()) == []


def test_arrays_used_longest_ago_go_first(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cache_module, "LIMIT", 2.5 * 8200)
    for age, key in ((300, "a"), (200, "b")):
        mapped_array(key, SHAPE, TYPE, rows)
        os.utime(cache / f"mapped_{key}.npy", (1e9 - age, 1e9 - age))
    used = mapped_array("a", SHAPE, TYPE, broken)  # which is there, so that nothing is made
    mapped_array("c", SHAPE, TYPE, rows)
    assert sorted(path.name for path in cache.iterdir()) == ["mapped_a.npy", "mapped_c.npy"]
    mapped_array("d", SHAPE, TYPE, rows)
    mapped_array("e", SHAPE, TYPE, rows)
    assert np.array_equal(used, np.arange(4000).reshape(SHAPE))  # removed, but still mapped here


def test_what_a_killed_process_left_goes_after_a_day(cache: Path) -> None:
    for name, age in ((".mapped_old.npy.x.partial", 1e9), (".mapped_new.npy.x.partial", 2e9), (".mine.partial", 1e9)):
        (cache / name).touch()
        os.utime(cache / name, (age, age))
    mapped_array("a", SHAPE, TYPE, rows)
    assert sorted(path.name for path in cache.iterdir()) == [
        ".mapped_new.npy.x.partial",
        ".mine.partial",
        "mapped_a.npy",
    ]


@pytest.mark.parametrize("place", [-1, -500, 200])
def test_array_that_does_not_match_its_checksum_is_made_again(place: int, cache: Path) -> None:
    mapped_array("a", SHAPE, TYPE, rows)
    content = bytearray((cache / "mapped_a.npy").read_bytes())
    content[place] ^= 1
    (cache / "mapped_a.npy").write_bytes(content)
    assert np.array_equal(mapped_array("a", SHAPE, TYPE, rows), np.arange(4000).reshape(SHAPE))
    assert np.array_equal(mapped_array("a", SHAPE, TYPE, broken), np.arange(4000).reshape(SHAPE))

"""The disk cache never returns stale or damaged arrays, never fails a run, and has a bounded size."""

import os
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from nerfro.core.errors import NerfroError
from nerfro.files import cache
from nerfro.files.cache import cached_arrays, content_hash, mapped_array, save_arrays
from nerfro.files.reading import load_arrays
from tests.conftest import refused


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of the cache, which is empty."""
    monkeypatch.setenv("NERFRO_CACHE", str(tmp_path))
    return tmp_path


class _Counter:
    calls = 0

    def compute(self) -> dict[str, np.ndarray]:
        self.calls += 1
        return {"values": np.arange(5.0)}


def test_arrays_are_computed_once() -> None:
    counter = _Counter()
    for _ in range(3):
        np.testing.assert_array_equal(cached_arrays("distance_entry", counter.compute)["values"], np.arange(5.0))
    assert counter.calls == 1
    cached_arrays("distance_entry", counter.compute, enabled=False)
    assert counter.calls == 2


def replaced(**arrays: np.ndarray) -> Callable[[Path], None]:
    return lambda file: np.savez(file, **arrays)


@pytest.mark.parametrize(
    "damage",
    [
        replaced(values=np.full(5, np.nan)),
        replaced(others=np.arange(5.0)),
        replaced(values=np.arange(6.0)),
        replaced(values=np.arange(5.0), checksum=np.array("of something else")),
        lambda file: file.write_bytes(b""),
        lambda file: file.write_bytes(b"\x93NUMPY"),
        lambda file: (save_arrays(file, {"values": np.arange(5.0)}), os.truncate(file, 50)),
    ],
)
def test_entry_with_a_wrong_checksum_is_recomputed(damage: Callable[[Path], None], folder: Path) -> None:
    damage(folder / "distance_entry.npz")
    counter = _Counter()
    for _ in range(2):
        (arrays,) = cached_arrays("distance_entry", counter.compute).items()
        assert arrays[0] == "values"
        np.testing.assert_array_equal(arrays[1], np.arange(5.0))
    assert counter.calls == 1


def test_cache_size_is_bounded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cache, "LIMIT", 1000)
    (tmp_path / "mine.npz").write_bytes(bytes(2000))
    for number in range(5):
        cached_arrays(f"distance_{number}", lambda: {"values": np.random.default_rng(0).random(50)})
        os.utime(tmp_path / f"distance_{number}.npz", (number, number))
    assert sorted(path.name for path in tmp_path.iterdir()) == ["distance_4.npz", "mine.npz"]


def test_concurrently_removed_entries_are_ignored(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("distance_0.npz", "distance_1.npz", ".distance_2.npz.partial"):
        (tmp_path / name).write_bytes(bytes(10))
    listed = Path.glob

    def removed_after_listing(folder: Path, pattern: str) -> list[Path]:
        found = list(listed(folder, pattern))
        for path in found:
            if path.name != "distance_1.npz":
                path.unlink()
        return found

    monkeypatch.setattr(Path, "glob", removed_after_listing)
    cache.make_room(tmp_path, 0)
    assert [path.name for path in tmp_path.iterdir()] == ["distance_1.npz"]


def test_uncreatable_folder_only_disables_caching(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("NERFRO_CACHE", str(tmp_path / "file" / "below"))
    assert len(cached_arrays("distance_entry", _Counter().compute)["values"]) == 5


def test_hash_depends_on_values_shapes_types_and_order() -> None:
    a = np.arange(6.0)
    hashes = [
        content_hash(a, 1),
        content_hash(1, a),
        content_hash(a.reshape(2, 3), 1),
        content_hash(a.astype(np.float32), 1),
        content_hash(a + 1e-12, 1),
        content_hash(a, 1.0),
        content_hash(a, "1"),
    ]
    assert len(set(hashes)) == len(hashes)
    assert content_hash(a, 1) == content_hash(a.copy(), 1)


def test_pickled_code_is_not_executed(tmp_path: Path) -> None:
    np.savez(tmp_path / "evil.npz", values=np.array([{"a": 1}], dtype=object))
    refused("plain arrays", load_arrays, tmp_path / "evil.npz")


# --- mapped arrays, which are whole or not there ---


SHAPE, TYPE = (4, 1000), np.dtype(np.uint16)


def rows() -> Iterator[np.ndarray]:
    return iter(np.arange(4000, dtype=np.uint16).reshape(SHAPE))


def broken() -> Iterator[np.ndarray]:
    yield np.zeros(1000, np.uint16)
    raise NerfroError("a picture cannot be read")


def test_changes_of_a_cached_array_stay_in_the_process() -> None:
    array = mapped_array("a", SHAPE, TYPE, rows)
    assert np.array_equal(array, np.arange(4000).reshape(SHAPE))
    array[0] = 7
    assert np.array_equal(mapped_array("a", SHAPE, TYPE, rows), np.arange(4000).reshape(SHAPE))


def test_failed_computation_leaves_no_file(folder: Path) -> None:
    refused("a picture cannot be read", mapped_array, "a", SHAPE, TYPE, broken)
    assert list(folder.iterdir()) == []


def test_least_recently_used_arrays_are_removed_first(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cache, "LIMIT", 2.5 * 8200)
    for age, key in ((300, "a"), (200, "b")):
        mapped_array(key, SHAPE, TYPE, rows)
        os.utime(folder / f"mapped_{key}.npy", (1e9 - age, 1e9 - age))
    used = mapped_array("a", SHAPE, TYPE, broken)  # which is there, so that nothing is made
    mapped_array("c", SHAPE, TYPE, rows)
    assert sorted(path.name for path in folder.iterdir()) == ["mapped_a.npy", "mapped_c.npy"]
    mapped_array("d", SHAPE, TYPE, rows)
    mapped_array("e", SHAPE, TYPE, rows)
    assert np.array_equal(used, np.arange(4000).reshape(SHAPE))  # removed, but still mapped here


def test_files_of_a_killed_process_are_removed_after_a_day(folder: Path) -> None:
    for name, age in ((".mapped_old.npy.x.partial", 1e9), (".mapped_new.npy.x.partial", 2e9), (".mine.partial", 1e9)):
        (folder / name).touch()
        os.utime(folder / name, (age, age))
    mapped_array("a", SHAPE, TYPE, rows)
    assert sorted(path.name for path in folder.iterdir()) == [
        ".mapped_new.npy.x.partial",
        ".mine.partial",
        "mapped_a.npy",
    ]


@pytest.mark.parametrize("place", [-1, -500, 200])
def test_array_with_a_wrong_checksum_is_recomputed(place: int, folder: Path) -> None:
    mapped_array("a", SHAPE, TYPE, rows)
    content = bytearray((folder / "mapped_a.npy").read_bytes())
    content[place] ^= 1
    (folder / "mapped_a.npy").write_bytes(content)
    assert np.array_equal(mapped_array("a", SHAPE, TYPE, rows), np.arange(4000).reshape(SHAPE))
    assert np.array_equal(mapped_array("a", SHAPE, TYPE, broken), np.arange(4000).reshape(SHAPE))

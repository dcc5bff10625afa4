"""Files and checkpoints are written whole, or not at all."""

import errno
import os
import stat
import tempfile
from collections.abc import Callable
from pathlib import Path

import pytest
import torch

from nerfro.files.atomic import atomic_file, write_atomically
from nerfro.training.trainer import CheckpointFiles
from tests.conftest import refused


def save_checkpoint(path: Path, content: str) -> None:
    CheckpointFiles().save_checkpoint({"content": content}, path)


@pytest.mark.parametrize("write", [write_atomically, save_checkpoint])
@pytest.mark.parametrize("step", ["fsync", "replace"])
def test_full_disk_keeps_the_old_file_and_no_temporary_file(
    write: Callable[[Path, str], None], step: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "metrics.json"
    write(path, "old")
    before = path.read_bytes()

    def fail(*arguments: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, step, fail)
    refused(r"metrics\.json: No space left on device", write, path, "new")
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


def test_disk_that_fills_up_within_a_checkpoint_keeps_the_old_one(tmp_path: Path) -> None:
    path = tmp_path / "last.ckpt"
    save_checkpoint(path, "old")
    before = path.read_bytes()
    resource = pytest.importorskip("resource")
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, limits[1]))
    message = r"last\.ckpt: File too large.*the old file is unchanged; free some space"
    try:
        refused(message, save_checkpoint, path, "new" * 100_000)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


def test_other_error_within_a_checkpoint_stays_as_it_is(tmp_path: Path) -> None:
    class Broken:
        def __reduce__(self) -> str:
            raise RuntimeError("device-side assert")

    with pytest.raises(RuntimeError, match="device-side assert"):
        CheckpointFiles().save_checkpoint({"content": Broken()}, tmp_path / "last.ckpt")
    assert list(tmp_path.iterdir()) == []


def test_text_is_utf8_and_has_the_permissions_of_other_new_files(tmp_path: Path) -> None:
    (tmp_path / "ordinary").touch()
    write_atomically(tmp_path / "new" / "table.md", "PSNR ↑\n")
    assert (tmp_path / "new" / "table.md").read_bytes() == "PSNR ↑\n".encode()
    modes = {stat.S_IMODE(path.stat().st_mode) for path in (tmp_path / "ordinary", tmp_path / "new" / "table.md")}
    assert len(modes) == 1


def test_writing_does_not_change_the_umask_of_the_process(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "umask", lambda mask: pytest.fail("the umask belongs to the whole process"))
    write_atomically(tmp_path / "table.md", "PSNR")


def test_uncreatable_folder_gives_a_one_line_error(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    refused("cannot write", write_atomically, tmp_path / "file" / "metrics.json", "{}")


@pytest.mark.parametrize("stop", [ValueError, KeyboardInterrupt])
def test_interrupted_write_keeps_the_old_file_and_no_temporary_file(tmp_path: Path, stop: type) -> None:
    path = tmp_path / "paths.npz"
    write_atomically(path, "old")

    def write_half() -> None:
        with atomic_file(path) as file:
            file.write(b"half of the n")
            raise stop

    with pytest.raises(stop):
        write_half()
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_checkpoint_is_written_beside_the_old_one_and_not_elsewhere(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "missing"))
    for number in (1, 2):
        CheckpointFiles().save_checkpoint({"step": number}, tmp_path / "run" / "last.ckpt")
        assert torch.load(tmp_path / "run" / "last.ckpt", weights_only=True) == {"step": number}
    assert [path.name for path in (tmp_path / "run").iterdir()] == ["last.ckpt"]

"""Configurations of other users' runs are plain values, which cannot read from this machine."""

from itertools import pairwise
from pathlib import Path

import pytest
import torch

from nerfro.files.reading import foreign_config
from nerfro.training.run_folder import load_checkpoint
from tests.conftest import refused


def test_plain_values_are_read_as_they_were_written() -> None:
    config = foreign_config("name: a\nfield: {scale: 1e-3, sizes: [1, 2]}\n", Path("c.yaml"))
    assert config == {"name": "a", "field": {"scale": 1e-3, "sizes": [1, 2]}}


HOSTILE = [
    "name: ${oc.env:NERFRO_SECRET}",
    'field: {widths: [1, "\\x24{oc.env:NERFRO_SECRET}"]}',
    "${oc.env:NERFRO_SECRET}: 3",
    "name: ${seed}\nseed: 1",
]


BOMB = "a: &a [1, 2]\n" + "".join(f"{x}: &{x} [{', '.join([f'*{w}'] * 9)}]\n" for w, x in pairwise("abcdefgh"))
LONG = "a: " + 10**6 * "1"
OTHERS = ["{[: no yaml", "name: !!python/name:os.system", "- 1", "a: 1\na: 2", BOMB, LONG, "a: &a [*a]", "[" * 3000]


@pytest.mark.parametrize("text", [*HOSTILE, *OTHERS])
def test_content_that_no_run_writes_is_refused(text: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NERFRO_SECRET", "hunter2")
    torch.save({"nerfro_config": text}, tmp_path / "last.ckpt")
    for read in (lambda: foreign_config(text, Path("c.yaml")), lambda: load_checkpoint(tmp_path / "last.ckpt")):
        assert "hunter2" not in refused(r"c\.yaml|last\.ckpt", read)

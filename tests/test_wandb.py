"""Weights & Biases without an account: the file of a run contains the values of TensorBoard and CSV."""

import csv
import json
import struct
from collections import defaultdict
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from tests.conftest import Runner

PICTURES = {"val/prediction_reference_error", "val/depth_opacity", "val/sky", "val/paths"}
_BLOCK = 32768  # records are split at multiples of it, as in LevelDB's logs


def records(file: Path) -> Iterator[bytes]:
    """Payloads of a .wandb file: a header of 7 bytes, then chunks of checksum, length and kind (1 whole, 4 last)."""
    content = file.read_bytes()
    assert content[:4] == b":W&B"
    at, whole = 7, b""
    while at + 7 <= len(content):
        if _BLOCK - at % _BLOCK < 7:
            at += _BLOCK - at % _BLOCK
            continue
        _, length, kind = struct.unpack_from("<IHB", content, at)
        whole += content[at + 7 : at + 7 + length]
        at += 7 + length
        if kind in (1, 4):
            yield whole
            whole = b""


def read(file: Path) -> tuple[dict[str, Any], dict[str, dict[int, Any]]]:
    """Settings that the run's own file holds, and logged values by key and by step of the trainer."""
    from wandb.proto import wandb_internal_pb2

    def values(items: Any) -> dict[str, Any]:
        return {item.key or "/".join(item.nested_key): json.loads(item.value_json) for item in items}

    settings: dict[str, Any] = {}
    history: dict[str, dict[int, Any]] = defaultdict(dict)
    for payload in records(file):
        record = wandb_internal_pb2.Record()
        record.ParseFromString(payload)
        settings |= values(record.config.update) | values(record.run.config.update)
        row = values(record.history.item)
        for key, value in row.items():
            history[key][row["trainer/global_step"]] = value
    return settings, history


@pytest.mark.slow
def test_offline_run_needs_no_account_and_logs_the_values_of_tensorboard_and_csv(
    train_paper: Runner, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    monkeypatch.setenv("WANDB_SILENT", "true")
    monkeypatch.delenv("WANDB_API_KEY", raising=False)
    train_paper(
        "logger=wandb", "logger.wandb.offline=true", "trainer.max_steps=4", "evaluation.every=2",
        "trainer.log_every_n_steps=1", "loss.background.start=0", "loss.smoothness.start=0",
    )  # fmt: skip
    folder = tmp_path / "run"
    (log,) = folder.glob("wandb/offline-run-*/run-*.wandb")
    settings, logged = read(log)
    assert (settings["trainer"]["max_steps"], settings["loss"]["background"]["start"]) == (4, 0)
    events = EventAccumulator(str(folder / "tensorboard"), {"images": 0, "scalars": 0}).Reload()
    tags = events.Tags()

    scalars = set(tags["scalars"])
    assert "epoch" not in logged
    assert {
        "loss/total", "loss/photometric", "loss/background", "loss/smoothness", "weight/background", "train/psnr",
        "val/psnr", "train/rays_per_second", "train/peak_memory_gib", "optimizer/learning_rate/common",
    } <= scalars  # fmt: skip
    with (folder / "csv" / "metrics.csv").open() as stream:
        assert scalars <= set(next(csv.reader(stream)))
    for name in scalars:
        assert logged[name] == pytest.approx({event.step: event.value for event in events.Scalars(name)}), name

    assert set(tags["images"]) == PICTURES
    for name in PICTURES:
        assert len(events.Images(name)) == 2
        for event in events.Images(name):
            file = log.parent / "files" / logged[f"{name}/filenames"][event.step][0]
            with Image.open(file) as ours, Image.open(BytesIO(event.encoded_image_string)) as theirs:
                assert np.array_equal(np.asarray(ours.convert("RGB")), np.asarray(theirs.convert("RGB"))), name

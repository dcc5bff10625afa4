"""Extraction of sharp frames from a video."""

import os
import shutil
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("cv2")

import cv2
from omegaconf import OmegaConf

from nerfro.poses.calibrated_data import REPORT
from nerfro.poses.collection import collect_photographs, extract_frames
from tests.conftest import refused

SHARP = (1, 7, 8, 13)  # one in each quarter of the video


@pytest.fixture(scope="module")
def video(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Sixteen frames of a moving pattern, of which four are sharp."""
    path = tmp_path_factory.mktemp("video") / "clip.mp4"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"mp4v"), 25.0, (96, 64))
    pattern = np.random.default_rng(0).integers(0, 256, (16, 24, 3), np.uint8).repeat(4, 0).repeat(4, 1)
    for number in range(16):
        frame = np.roll(pattern, 3 * number, 1)
        writer.write(frame if number in SHARP else cv2.GaussianBlur(frame, (0, 0), 3))
    writer.release()
    return path


def test_sharpest_frame_of_each_interval_is_written(video: Path, tmp_path: Path) -> None:
    files = extract_frames(video, tmp_path, 4)
    assert [file.name for file in files] == [f"frame_{number:05d}.jpg" for number in SHARP]
    assert cv2.imread(str(files[0])).shape == (64, 96, 3)
    written = files[1].read_bytes()
    files[0].write_bytes(b"kept")
    files[1].unlink()
    assert extract_frames(video, tmp_path, 4) == files
    assert files[0].read_bytes() == b"kept"
    assert files[1].read_bytes() == written


def test_frames_of_another_extraction_are_deleted(video: Path, tmp_path: Path) -> None:
    extract_frames(video, tmp_path, 8)
    (tmp_path / "notes.txt").write_text("of the user")
    files = extract_frames(video, tmp_path, 4)
    assert sorted(tmp_path.glob("*.jpg")) == files
    assert (tmp_path / "notes.txt").is_file()


def test_frames_of_another_video_are_replaced_whatever_its_time(video: Path, tmp_path: Path) -> None:
    again = Path(shutil.copy(video, tmp_path / "again.mp4"))
    files = extract_frames(again, tmp_path / "frames", 4)
    for file in files:
        file.write_bytes(b"of the first video")
    touched = again.read_bytes() + b"\0" * 8  # the same frames in another file, which looks older than the frames
    again.write_bytes(touched)
    os.utime(again, ns=(0, 0))
    assert extract_frames(again, tmp_path / "frames", 4) == files
    assert all(cv2.imread(str(file)).shape == (64, 96, 3) for file in files)
    (tmp_path / REPORT).write_text("{}")
    config = OmegaConf.create({"video": str(again), "images": None, "masks": None, "frames": 4})
    assert len(collect_photographs(config, tmp_path)) == 4
    again.write_bytes(touched + b"\0")
    refused("has poses of the frames of another video than", collect_photographs, config, tmp_path)


def test_files_without_a_video_are_refused(video: Path, tmp_path: Path) -> None:
    text = tmp_path / "text.mp4"
    text.write_text("no video")
    for path, count, message in (
        (text, 4, "cannot be read; give a video file such as .mp4 or .mov"),
        (tmp_path / "none.mp4", 4, "does not exist; give a video file, or images=FOLDER"),
        (video, 17, "has 16 readable frames, and frames=17 are asked for"),
    ):
        refused(message, extract_frames, path, tmp_path / "frames", count)

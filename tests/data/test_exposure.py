"""Exposures that files tell."""

from __future__ import annotations

from pathlib import Path

import pytest
from PIL import ExifTags, Image
from PIL.TiffImagePlugin import IFDRational

from nerfro.data.exposure import exif_exposures


def photograph(path: Path, time: object = None, number: object = None, sensitivity: object = None) -> Path:
    exif = Image.Exif()
    tags = exif.get_ifd(ExifTags.IFD.Exif)
    named = (ExifTags.Base.ExposureTime, time), (ExifTags.Base.FNumber, number)
    for tag, value in (*named, (ExifTags.Base.ISOSpeedRatings, sensitivity)):
        if value is not None:
            tags[tag] = value
    Image.new("RGB", (8, 8)).save(path, exif=exif.tobytes())
    return path


def test_exposure_is_time_times_sensitivity_over_the_f_number_squared(tmp_path: Path) -> None:
    files = [
        photograph(tmp_path / "a.jpg", IFDRational(1, 50), IFDRational(28, 10), 100),
        photograph(tmp_path / "b.jpg", IFDRational(1, 100), IFDRational(14, 10), 400),
    ]
    first, second = exif_exposures(files).tolist()
    assert second / first == pytest.approx(0.5 * 4 * 4)


def test_what_no_file_tells_is_taken_as_alike(tmp_path: Path) -> None:
    files = [photograph(tmp_path / "a.png", IFDRational(1, 50)), photograph(tmp_path / "b.png", IFDRational(1, 25))]
    first, second = exif_exposures(files).tolist()
    assert second / first == pytest.approx(2)


@pytest.mark.parametrize("other", [{}, {"time": IFDRational(1, 0)}, {"time": IFDRational(1, 50), "sensitivity": 100}])
def test_files_that_do_not_all_tell_say_nothing(tmp_path: Path, other: dict[str, object]) -> None:
    files = [photograph(tmp_path / "a.jpg", IFDRational(1, 50)), photograph(tmp_path / "b.jpg", **other)]
    assert exif_exposures(files) is None
    assert exif_exposures([]) is None

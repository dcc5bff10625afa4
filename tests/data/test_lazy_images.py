"""Images are read from their files on demand, and training pixels keep every bit."""

import os
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from nerfro.core.errors import NerfroError
from nerfro.data import pixel_store
from nerfro.data.image_files import read_rgb
from nerfro.data.lazy_images import LazyImages, decoded_once
from nerfro.data.pixel_store import PixelStore

read = partial(read_rgb, alpha="drop")


def save(folder: Path, count: int, bits: int = 8, seed: int = 0) -> tuple[list[Path], np.ndarray]:
    shape = (count, 4, 6, 3) if bits == 8 else (count, 4, 6)  # Pillow has no deep colour
    levels = np.random.default_rng(seed).integers(0, 2**bits, shape).astype(f"uint{bits}")
    paths = [folder / f"{number}.png" for number in range(count)]
    for path, picture in zip(paths, levels, strict=True):
        Image.fromarray(picture).save(path)
    return paths, levels


class Reader:
    """Reads colours, and lists what it has read."""

    def __init__(self) -> None:
        self.decoded: list[Path] = []

    def __call__(self, path: Path) -> np.ndarray:
        self.decoded.append(path)
        return read(path)


def test_images_keep_the_order_of_files_and_are_block_means(tmp_path: Path) -> None:
    paths, levels = save(tmp_path, 30)
    whole, half = LazyImages.of(paths, read), LazyImages.of(paths, read, 2)
    assert np.array_equal(np.stack(list(whole.all_levels())), levels)
    mean = torch.from_numpy(levels.reshape(30, 2, 2, 3, 2, 3).mean((2, 4)) / 255).float()
    torch.testing.assert_close(torch.stack(list(half)), mean, rtol=0, atol=0.51 / 65535)


def test_few_images_are_decoded_ahead(tmp_path: Path) -> None:
    paths, _ = save(tmp_path, 60)
    reader = Reader()
    pictures = LazyImages.of(paths, reader)
    assert reader.decoded == []
    levels = pictures.all_levels()
    next(levels)
    assert 1 <= len(reader.decoded) <= 10
    levels.close()


def test_image_is_decoded_once_per_size(tmp_path: Path) -> None:
    paths, _ = save(tmp_path, 3)
    reader = Reader()
    with decoded_once():
        for downscale in (1, 2, 1, 2):
            pictures = LazyImages.of(paths, reader, downscale, recipe="drop")
            shown = np.stack(list(pictures.all_levels()))
        assert sorted(reader.decoded) == sorted(paths * 2)
        os.utime(paths[0], (0, 0))
        assert np.array_equal(np.stack(list(pictures.select([0, 1]).all_levels())), shown[:2])
        assert reader.decoded[6:] == [paths[0]]
    LazyImages.of(paths, reader, recipe="drop").levels(2)
    assert reader.decoded[7:] == [paths[2]]


def test_image_that_changes_its_size_is_refused(tmp_path: Path) -> None:
    paths, _ = save(tmp_path, 2)
    pictures = LazyImages.of(paths, read)
    Image.new("RGB", (2, 2)).save(paths[1])
    with pytest.raises(NerfroError, match=r"1\.png has changed during"):
        pictures[1]


NUM_VIEWS = 3
EVERY = torch.arange(NUM_VIEWS * 4 * 6)


@pytest.mark.parametrize("bits", [8, 16])
def test_drawn_colours_equal_the_image_exactly(bits: int, tmp_path: Path) -> None:
    pictures = LazyImages.of(save(tmp_path, NUM_VIEWS, bits)[0], read)
    store = PixelStore(pictures)
    expected = torch.stack(list(pictures)).view(-1, 3)
    order = EVERY.flip(0)
    assert torch.equal(store[order], expected[order])
    assert store._levels.nbytes == len(EVERY) * 3 * bits // 8


@pytest.mark.parametrize("bits", [8, 16])
def test_mapped_pixels_are_cached_by_content(bits: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NERFRO_CACHE", str(tmp_path / "cache"))
    paths, _ = save(tmp_path, NUM_VIEWS, bits)
    resident = PixelStore(LazyImages.of(paths, Reader()))[EVERY]
    monkeypatch.setattr(pixel_store, "_MAPPED_FROM", 0)
    reader = Reader()
    for _ in range(2):
        assert torch.equal(PixelStore(LazyImages.of(paths, reader))[EVERY], resident)
    assert len(reader.decoded) == NUM_VIEWS
    mapped = PixelStore(LazyImages.of(paths, reader))
    mapped.release_memory()
    assert torch.equal(mapped[EVERY], resident)
    half = PixelStore(LazyImages.of(paths, reader, recipe="other"))
    assert len(reader.decoded) == 2 * NUM_VIEWS  # another recipe may make other colours of the same files
    assert torch.equal(half[EVERY], resident)
    save(tmp_path, NUM_VIEWS, bits, seed=1)  # other pictures under the same names
    assert not torch.equal(PixelStore(LazyImages.of(paths, reader))[EVERY], resident)
    for path in (tmp_path / "cache").glob("*.npy"):
        path.write_bytes(path.read_bytes()[:-10])
    save(tmp_path, NUM_VIEWS, bits)
    assert torch.equal(PixelStore(LazyImages.of(paths, reader))[EVERY], resident)

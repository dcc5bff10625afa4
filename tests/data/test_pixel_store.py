"""Pixels are kept in the bits of their files, in memory or mapped from a file, and drawn as what they are."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from nerfro.data import pixel_store
from nerfro.data.image_files import read_rgb
from nerfro.data.lazy_images import LazyImages
from nerfro.data.pixel_store import PixelStore

NUM_VIEWS, HEIGHT, WIDTH = 3, 5, 4
EVERY = torch.arange(NUM_VIEWS * HEIGHT * WIDTH)


class Reader:
    """Reads colours, and counts how often."""

    def __init__(self) -> None:
        self.count = 0

    def __call__(self, path: Path) -> np.ndarray:
        self.count += 1
        return read_rgb(path, "drop")


def save(folder: Path, bits: int, seed: int = 0) -> list[Path]:
    shape = (NUM_VIEWS, HEIGHT, WIDTH, 3) if bits == 8 else (NUM_VIEWS, HEIGHT, WIDTH)  # Pillow has no deep colour
    levels = np.random.default_rng(seed).integers(0, 2**bits, shape).astype(f"uint{bits}")
    paths = [folder / f"{view}.png" for view in range(NUM_VIEWS)]
    for path, picture in zip(paths, levels, strict=True):
        Image.fromarray(picture).save(path)
    return paths


@pytest.mark.parametrize("bits", [8, 16])
def test_drawn_colours_are_those_of_the_pictures_to_the_last_bit(bits: int, tmp_path: Path) -> None:
    pictures = LazyImages.of(save(tmp_path, bits), partial(read_rgb, alpha="drop"))
    store = PixelStore(pictures)
    expected = torch.stack(list(pictures)).view(-1, 3)
    order = EVERY.flip(0)
    assert torch.equal(store[order], expected[order])
    assert store._levels.nbytes == len(EVERY) * 3 * bits // 8


@pytest.mark.parametrize("bits", [8, 16])
def test_mapped_pixels_are_made_once_for_a_content(bits: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NERFRO_CACHE", str(tmp_path / "cache"))
    paths = save(tmp_path, bits)
    resident = PixelStore(LazyImages.of(paths, Reader()))[EVERY]
    monkeypatch.setattr(pixel_store, "_MAPPED_FROM", 0)
    reader = Reader()
    for _ in range(2):
        assert torch.equal(PixelStore(LazyImages.of(paths, reader))[EVERY], resident)
    assert reader.count == NUM_VIEWS
    mapped = PixelStore(LazyImages.of(paths, reader))
    mapped.forget()
    assert torch.equal(mapped[EVERY], resident)
    half = PixelStore(LazyImages.of(paths, reader, recipe="other"))
    assert reader.count == 2 * NUM_VIEWS  # another recipe may make other colours of the same files
    assert torch.equal(half[EVERY], resident)
    save(tmp_path, bits, seed=1)  # other pictures under the same names
    assert not torch.equal(PixelStore(LazyImages.of(paths, reader))[EVERY], resident)
    for path in (tmp_path / "cache").glob("*.npy"):
        path.write_bytes(path.read_bytes()[:-10])
    save(tmp_path, bits)
    assert torch.equal(PixelStore(LazyImages.of(paths, reader))[EVERY], resident)

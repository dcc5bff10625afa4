"""Untrusted files, and configurations of other users' runs, are refused quickly and in one line."""

import json
import os
import struct
import zlib
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image, ImageFile

from nerfro.core.errors import NerfroError
from nerfro.data.image_files import read_levels, read_rgb, read_size
from nerfro.files.images import load_png
from nerfro.files.reading import foreign_config, load_array, load_arrays, read_foreign_config, read_json
from nerfro.geometry.mesh import load_mesh
from nerfro.training.run_folder import load_checkpoint
from tests.conftest import refused


def chunk(kind: bytes, content: bytes) -> bytes:
    return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))


def png(width: int, height: int, bits: int, colour: int, rows: bytes, *chunks: bytes) -> bytes:
    """A PNG file by its specification; colour is 0 (grey), 2 (RGB) or 3 (palette)."""
    header = chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, bits, colour, 0, 0, 0))
    parts = (header, *chunks, chunk(b"IDAT", zlib.compress(rows)), chunk(b"IEND", b""))
    return b"\x89PNG\r\n\x1a\n" + b"".join(parts)


def test_truncated_png_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "image.png"
    Image.fromarray(np.random.default_rng(0).integers(0, 256, (5, 4, 3), dtype=np.uint8)).save(path)
    content = path.read_bytes()
    for length in range(len(content)):
        path.write_bytes(content[:length])
        for read in (read_levels, load_png):
            refused(r"image\.png cannot be read \(.+\); copy or export it again", read, path)
    path.write_bytes(content + b"bytes behind the last chunk, as some programs write them")
    assert read_levels(path).shape == (5, 4, 3)


TOO_LARGE = "has more than 134 million pixels; downscale the image"
IMAGES = {
    "no palette": (png(4, 3, 8, 3, (b"\0" + b"\1" * 4) * 3), r"cannot be read \(it has no palette\); copy or export"),
    "16 bits": (png(60_000, 60_000, 16, 2, b"\0"), TOO_LARGE),
    "as large as the format allows": (png(2**31 - 1, 2**31 - 1, 16, 0, b"\0"), TOO_LARGE),
    "zeros": (png(12_000, 12_000, 8, 0, bytes(1000)), TOO_LARGE),
}


@pytest.mark.parametrize("image", IMAGES)
def test_images_without_palette_and_of_enormous_size_are_refused(
    tmp_path: Path, image: str, recwarn: pytest.WarningsRecorder
) -> None:
    content, message = IMAGES[image]
    (tmp_path / "image.png").write_bytes(content)
    refused(message, read_levels, tmp_path / "image.png")
    assert len(recwarn) == 0


READERS = [read_levels, read_size, load_png, load_array, load_arrays, lambda path: read_json(path, ""), load_checkpoint,
           read_foreign_config, load_mesh]  # fmt: skip


@pytest.mark.parametrize("read", READERS)
def test_pipes_are_refused_without_blocking(tmp_path: Path, read: Callable[[Path], object]) -> None:
    os.mkfifo(tmp_path / "pipe.png")
    refused(r"pipe\.png is not a regular file; give a file on a disk", read, tmp_path / "pipe.png")


def test_arrays_that_decompress_beyond_the_limit_are_refused(tmp_path: Path) -> None:
    np.savez_compressed(tmp_path / "rays.npz", origins=np.zeros((1000, 3)))
    assert load_arrays(tmp_path / "rays.npz", most_bytes=25_000)["origins"].shape == (1000, 3)
    with pytest.raises(NerfroError, match=r"rays\.npz holds 0\.0 GiB of arrays, but at most .* split the file"):
        load_arrays(tmp_path / "rays.npz", most_bytes=24_000)


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "utf-32"])
def test_json_is_read_with_and_without_a_byte_order_mark(tmp_path: Path, encoding: str) -> None:
    (tmp_path / "a.json").write_text(json.dumps({"é": 1}, ensure_ascii=False), encoding=encoding)
    assert read_json(tmp_path / "a.json", "") == {"é": 1}


def grey(levels: list[int], bits: int) -> bytes:
    """One row of grey levels, padded to whole bytes."""
    row = "".join(format(level, f"0{bits}b") for level in levels)
    return b"\0" + int(row.ljust(-(-len(row) // 8) * 8, "0"), 2).to_bytes(-(-len(row) // 8), "big")


@pytest.mark.parametrize("bits", [1, 2, 4, 8, 16])
def test_one_transparent_grey_level_is_transparency(tmp_path: Path, bits: int) -> None:
    levels = [0, 1, 2**bits - 1, 1, 0]
    content = png(5, 1, bits, 0, grey(levels, bits), chunk(b"tRNS", struct.pack(">H", 1)))
    (tmp_path / "image.png").write_bytes(content)
    read = read_levels(tmp_path / "image.png")
    assert read.shape == (1, 5, 2)
    full = np.iinfo(read.dtype).max
    assert read[0, :, 0].tolist() == [level * full // (2**bits - 1) for level in levels]
    assert read[0, :, 1].tolist() == [0 if level == 1 else full for level in levels]


@pytest.mark.parametrize("bits", [8, 16])
def test_one_transparent_colour_is_composited(tmp_path: Path, bits: int) -> None:
    rows = np.zeros((2, 3), ">u1" if bits == 8 else ">u2")
    rows[1] = 2**bits - 1, 0, 0
    transparency = chunk(b"tRNS", struct.pack(">3H", 0, 0, 0))
    (tmp_path / "image.png").write_bytes(png(2, 1, bits, 2, b"\0" + rows.tobytes(), transparency))
    read = {alpha: read_rgb(tmp_path / "image.png", alpha)[0].tolist() for alpha in ("white", "black")}
    assert read == {"white": [[65535] * 3, [65535, 0, 0]], "black": [[0] * 3, [65535, 0, 0]]}
    refused("convert it, with transparency composited first", load_png, tmp_path / "image.png")


def exif_chunks(orientation: int) -> dict[str, bytes]:
    """Chunks of a PNG file with an orientation, in all forms that Pillow reads."""
    exif = Image.Exif()
    exif[274] = orientation
    content = b"Exif\0\0" + exif.tobytes().removeprefix(b"Exif\0\0")
    text = b"\nexif\n%8d\n" % len(content) + content.hex().encode() + b"\n"
    return {
        "eXIf": chunk(b"eXIf", content[6:]),
        "profile": chunk(b"zTXt", b"Raw profile type exif\0\0" + zlib.compress(text)),
        "XMP": chunk(b"iTXt", b"XML:com.adobe.xmp\0\0\0\0\0" + xmp(orientation)),
    }


def xmp(orientation: int) -> bytes:
    return b'<rdf:Description tiff:Orientation="%d"/>' % orientation


@pytest.mark.parametrize("form", ["eXIf", "profile", "XMP"])
@pytest.mark.parametrize("after", ["IHDR", "IDAT"])
def test_orientation_is_found_anywhere_in_a_png_file(tmp_path: Path, form: str, after: str) -> None:
    path, content = tmp_path / "a.png", png(1, 1, 8, 0, b"\0\0")
    place = content.index(b"IDAT" if after == "IHDR" else b"IEND") - 4
    for orientation in (1, 6):
        path.write_bytes(content[:place] + exif_chunks(orientation)[form] + content[place:])
        if orientation == 1:
            assert read_size(path) == (1, 1, 8)
            assert read_levels(path).tolist() == [[[0]]]
        else:
            for read in (read_size, read_levels):
                refused("EXIF orientation 6; rotate its pixels", read, path)


@pytest.mark.parametrize("suffix", [".jpg", ".webp"])
def test_orientation_is_found_in_xmp(tmp_path: Path, suffix: str) -> None:
    for orientation in (1, 6):
        Image.new("L", (2, 1)).save(tmp_path / f"{orientation}{suffix}", xmp=xmp(orientation))
    assert read_size(tmp_path / f"1{suffix}") == (2, 1, 8)
    refused("EXIF orientation 6; rotate its pixels", read_size, tmp_path / f"6{suffix}")


def test_pixels_are_decoded_only_if_metadata_follow_them(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path, content = tmp_path / "a.png", png(1, 1, 8, 0, b"\0\0", exif_chunks(1)["eXIf"])
    place = content.index(b"IEND") - 4
    path.write_bytes(content[:place] + chunk(b"tEXt", b"date:create\0today") + content[place:])
    monkeypatch.setattr(ImageFile.ImageFile, "load", lambda image: pytest.fail("decoded"))
    assert read_size(path) == (1, 1, 8)


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

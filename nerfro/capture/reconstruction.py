"""Structure from motion with pycolmap, where there is no COLMAP model."""

from __future__ import annotations

import itertools
import re
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float
from PIL import Image
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn, track
from scipy.ndimage import binary_dilation

from nerfro.capture.calibration import Intrinsics, LensModel
from nerfro.capture.model_import import require_pycolmap
from nerfro.data.image_files import read_mask, to_unit
from nerfro.errors import NerfroError
from nerfro.files.atomic import refuse_existing
from nerfro.paths import user_path

Pairs = Literal["sequential", "all"]

_MODEL_FOLDERS = ("sparse/0", "sparse")
# COLMAP's cameras that have the distortion of ours.
_CAMERAS = {"pinhole": "PINHOLE", "radial": "RADIAL", "opencv": "OPENCV"}
# A feature describes its neighbourhood: those near the object's outline see it too. Share of the image's width.
_MARGIN = 0.01
_SEED, _ALL_THREADS = 0, -1
# An image of a sequence is matched with so many next ones, and with those that are further powers of two away.
_NEXT = 10
# Names count where most numbers follow each other by no more than so many times the usual step.
_LARGE_STEP, _MOST = 4, 0.9
# COLMAP says nothing while it works, so it is given its work in pieces: images, and pairs of them.
_IMAGES_AT_ONCE, _PAIRS_AT_ONCE = 4, 100


@dataclass(frozen=True)
class Making:
    """How a model is made: the lens's model or a lens that is kept, which pairs are matched, and threads.

    Without `pairs` images are matched in sequence where their names count, and all with all if that leaves some out.
    """

    lens: LensModel = "pinhole"
    given: Intrinsics | None = None
    pairs: Pairs | None = None
    threads: int | None = None


def find_model(
    model: str | None, images: list[Path], masks: list[Path | None], made: Path, making: Making, overwrite: bool
) -> Path:
    """The folder of the COLMAP model: the one that is named, else one beside the images, else one in `made`."""
    if model is not None:
        return user_path(model)
    folder = images[0].parent
    for candidate in (root / name for root in (folder.parent, folder) for name in _MODEL_FOLDERS):
        if any((candidate / f"cameras{suffix}").is_file() for suffix in (".bin", ".txt")):
            print(f"taking the model {candidate}")
            return candidate
    refuse_existing([made], overwrite)
    num_masks = sum(mask is not None for mask in masks)
    print(f"no COLMAP model: making one from {len(images)} images, {num_masks} of them with masks of the object")
    return reconstruct(images, masks, made, making)


def reconstruct(images: Sequence[Path], masks: Sequence[Path | None], folder: Path, making: Making) -> Path:
    """Structure from motion of the images of one folder with one lens; the folder of the model with most images.

    Features on the refractive object are discarded: rays that were bent do not meet in a point, and what is seen
    through the object would pull the poses. A lens that is given is kept.
    """
    pycolmap = require_pycolmap()
    pycolmap.set_random_seed(_SEED)
    pycolmap.logging.minloglevel = pycolmap.logging.Level.ERROR.value
    names, threads = [image.name for image in images], making.threads or _ALL_THREADS
    with tempfile.TemporaryDirectory() as scratch:
        database = Path(scratch) / "database.db"
        _extract(pycolmap, images, masks, Path(scratch), making, threads)
        order = count_order(names) if making.pairs != "all" else None
        if making.pairs == "sequential" and order is None:
            order = sorted(range(len(names)), key=names.__getitem__)
        pairs = list(itertools.combinations(range(len(names)), 2)) if order is None else sequential_pairs(order)
        _match(pycolmap, database, [(names[i], names[j]) for i, j in pairs], threads)
        found = _place(pycolmap, database, images, folder, making, threads)
        if making.pairs is None and order is not None and _most_placed(found) < len(images):
            print(f"{_most_placed(found)} of {len(images)} images are placed by their sequence: matching all pairs")
            left = set(itertools.combinations(range(len(names)), 2)) - {(min(pair), max(pair)) for pair in pairs}
            _match(pycolmap, database, [(names[i], names[j]) for i, j in sorted(left)], threads)
            found = _place(pycolmap, database, images, folder, making, threads)
    if not found:
        raise NerfroError(
            f"COLMAP cannot place the {len(images)} images: too few features match; photograph with more overlap and "
            "texture around the object, or lay a board beside it (target=apriltag)"
        )
    return folder / str(max(found, key=lambda number: found[number].num_reg_images()))


def count_order(names: Sequence[str]) -> list[int] | None:
    """The order in which names count, as IMG_0007.jpg does; None where they do not."""
    parts = [re.fullmatch(r"(.*?)(\d+)\D*", name) for name in names]
    if any(part is None for part in parts) or len({part[1] for part in parts if part}) != 1:
        return None
    numbers = [int(part[2]) for part in parts if part]
    order = sorted(range(len(names)), key=numbers.__getitem__)
    steps = np.diff(np.array(numbers)[order])
    if len(steps) == 0 or steps.min() < 1 or (steps <= _LARGE_STEP * np.median(steps)).mean() < _MOST:
        return None
    return order


def sequential_pairs(order: Sequence[int]) -> list[tuple[int, int]]:
    """Each with the ten that follow it, and with those 16, 32, 64, ... places on, which close circles."""
    strides = [*range(1, _NEXT + 1), *(2**power for power in range(4, len(order).bit_length()))]
    return [(order[i], order[i + stride]) for stride in strides for i in range(len(order) - stride)]


def _extract(
    pycolmap: Any,
    images: Sequence[Path],
    masks: Sequence[Path | None],
    scratch: Path,
    making: Making,
    threads: int,
) -> None:
    """Find features, but for those on the object, and write them to the database."""
    masked = scratch / "masks"
    masked.mkdir()
    for image, mask in zip(images, masks, strict=True):
        if mask is not None:
            _write_ignored(mask, masked / f"{image.name}.png")
    reader, options = pycolmap.ImageReaderOptions(), pycolmap.FeatureExtractionOptions()
    reader.camera_model, options.num_threads = _CAMERAS[making.lens], threads
    if any(mask is not None for mask in masks):
        reader.mask_path = masked
    if making.given is not None:
        matrix, distortion = making.given.matrix, making.given.distortion
        numbers = [*matrix[[0, 1, 0, 1], [0, 1, 2, 2]], *(distortion or [0.0] * 4)]
        reader.camera_model, reader.camera_params = "OPENCV", ",".join(f"{number:.12g}" for number in numbers)
    for chunk in _chunks([image.name for image in images], _IMAGES_AT_ONCE, "finding features"):
        pycolmap.extract_features(
            scratch / "database.db",
            images[0].parent,
            image_names=chunk,
            camera_mode=pycolmap.CameraMode.SINGLE,
            reader_options=reader,
            extraction_options=options,
        )
        reader.existing_camera_id = 1  # the first piece has made it


def _match(pycolmap: Any, database: Path, pairs: Sequence[tuple[str, str]], threads: int) -> None:
    """Match features of pairs of images."""
    options, pairing = pycolmap.FeatureMatchingOptions(), pycolmap.ImportedPairingOptions()
    options.num_threads, pairing.match_list_path = threads, database.with_name("pairs.txt")
    for chunk in _chunks(pairs, _PAIRS_AT_ONCE, f"matching {len(pairs)} pairs"):
        pairing.match_list_path.write_text("".join(f"{one} {other}\n" for one, other in chunk), encoding="utf-8")
        pycolmap.match_image_pairs(database, matching_options=options, pairing_options=pairing)


def _place(
    pycolmap: Any, database: Path, images: Sequence[Path], folder: Path, making: Making, threads: int
) -> dict[int, Any]:
    """Place cameras one after the other; models by number, written to the folder."""
    options = pycolmap.IncrementalPipelineOptions()
    if making.given is not None:
        options.ba_refine_focal_length = options.ba_refine_extra_params = False
    else:
        options.ba_refine_principal_point = False
    options.random_seed, options.num_threads = _SEED, threads
    folder.mkdir(parents=True, exist_ok=True)
    columns = TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn()
    with Progress(*columns) as progress:
        task = progress.add_task("placing cameras", total=len(images))
        return pycolmap.incremental_mapping(
            database,
            images[0].parent,
            folder,
            options,
            initial_image_pair_callback=lambda: progress.advance(task, 2),
            next_image_callback=lambda: progress.advance(task),
        )


def _chunks(items: Sequence[Any], size: int, told: str) -> Iterator[Sequence[Any]]:
    starts = range(0, len(items), size)
    return (items[start : start + size] for start in track(starts, told))


def _most_placed(models: dict[int, Any]) -> int:
    return max((model.num_reg_images() for model in models.values()), default=0)


def _write_ignored(mask: Path, file: Path) -> None:
    """COLMAP's mask: black where features are ignored."""
    inside: Float[np.ndarray, "H W"] = to_unit(read_mask(mask)) > 0.5
    margin = max(1, round(_MARGIN * inside.shape[1]))
    Image.fromarray(np.where(binary_dilation(inside, iterations=margin), 0, 255).astype(np.uint8)).save(file)

"""Structure from motion with pycolmap, and import of lens and poses from a COLMAP model."""

from __future__ import annotations

import itertools
import re
import signal
import sqlite3
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from PIL import Image
from scipy.ndimage import binary_dilation
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components

from nerfro.core.errors import NerfroError, optional
from nerfro.core.paths import user_path
from nerfro.core.progress import counting_bar, track
from nerfro.core.provenance import AlgorithmSettings
from nerfro.data.formats.colmap_model import MODEL_FOLDERS, find_model_folder, lens_of, read_colmap
from nerfro.data.image_files import read_mask, to_unit
from nerfro.data.lenses import Lens, check_lenses
from nerfro.files.atomic import refuse_existing, require_room, write_atomically
from nerfro.poses.calibration import Calibration, Intrinsics, Pose
from nerfro.poses.options import LensModel, Pairs

_MODELS = "models"  # temporary folder of new models
# COLMAP's camera model for each of nerfro's lens models.
_CAMERAS = {"pinhole": "PINHOLE", "radial": "RADIAL", "opencv": "OPENCV"}


@dataclass(frozen=True)
class SfmSettings(AlgorithmSettings):
    """Settings of structure from motion.

    Attributes:
        lens: distortion coefficients to estimate.
        pairs: pairs of images to match. None matches in sequence if the file names are numbered, and then
            images whose pose is missing or uncertain with all images.
        threads: number of threads; None uses all cores.
        mask_labels: labels of the object in the masks, see `nerfro.data.image_files.read_mask`.
        margin: features within this distance of the object's outline also describe the object; fraction of the image
            width.
        num_neighbors: sequential matching pairs each image with so many following ones, and with those 16, 32, 64, ...
            images later.
        min_common_points: sequential matching is not trusted for groups of images whose links to other images have
            fewer points in common. On a simulated tumbler, a link of 41 points was wrong; correct links of the other
            captures have 55 points or more.
    """

    lens: LensModel = "pinhole"
    pairs: Pairs | None = None
    threads: int | None = None
    mask_labels: Sequence[int] | None = None
    margin: float = 0.01
    num_neighbors: int = 10
    min_common_points: int = 50


def find_model(
    model: str | None, images: list[Path], masks: list[Path | None], out: Path, settings: SfmSettings, overwrite: bool
) -> Path:
    """Return the folder of the COLMAP model: the given one, else one beside the images, else a new one in `out`."""
    if model is not None:
        return user_path(model)
    folder = images[0].parent
    existing = find_model_folder(root / name for root in (folder.parent, folder) for name in MODEL_FOLDERS)
    if existing is not None:
        print(f"using the COLMAP model {existing} with its lens; move its files away to compute another model")
        return existing
    refuse_existing([out], overwrite)
    num_masks = sum(mask is not None for mask in masks)
    print(f"structure from motion of {len(images)} images, {num_masks} of them with a mask of the object")
    return run_structure_from_motion(images, masks, out, settings)


def run_structure_from_motion(
    images: Sequence[Path], masks: Sequence[Path | None], folder: Path, settings: SfmSettings
) -> Path:
    """Run structure from motion on the images of one folder, taken with one lens.

    Features on the refractive object are discarded, because refracted rays do not intersect in a scene point and would
    bias the poses.

    Args:
        images: the photographs.
        masks: mask of the object in each image, if any.
        folder: output folder.
        settings: settings of COLMAP.

    Returns:
        Folder of the model with the most images, which is a new folder in `folder`.

    Raises:
        NerfroError: no image has a pose, or the disk is full.
    """
    pycolmap = require_pycolmap()
    settings.use()
    pycolmap.set_random_seed(0)
    pycolmap.logging.minloglevel = pycolmap.logging.Level.ERROR.value
    names, threads = [image.name for image in images], settings.threads or -1
    with tempfile.TemporaryDirectory() as scratch:
        # The database has 4 MB per image, and COLMAP would abort the process.
        require_room(Path(scratch), 2**22 * len(images), "TMPDIR")
        database = Path(scratch) / "database.db"
        _extract(pycolmap, images, masks, Path(scratch), settings, threads)
        order = numeric_order(names) if settings.pairs != "all" else None
        if settings.pairs == "sequential" and order is None:
            order = sorted(range(len(names)), key=names.__getitem__)
        all_pairs = list(itertools.combinations(range(len(names)), 2))
        pairs = all_pairs if order is None else sequential_pairs(order, settings.num_neighbors)
        _match(pycolmap, database, [(names[i], names[j]) for i, j in pairs], threads)
        models = _map(pycolmap, database, images, threads)
        if settings.pairs is None and order is not None and len(linked := _linked(models, settings)) < len(images):
            print(f"{len(linked)} of {len(images)} images have a certain pose: matching the others with all images")
            left = set(all_pairs) - {(min(pair), max(pair)) for pair in pairs}
            left = {pair for pair in left if not {names[pair[0]], names[pair[1]]} <= linked}
            _match(pycolmap, database, [(names[i], names[j]) for i, j in sorted(left)], threads)
            models = _map(pycolmap, database, images, threads)
        if not models:
            raise NerfroError(
                f"COLMAP finds no poses for the {len(images)} images, because too few features match; photograph with "
                "more overlap and texture around the object, or lay a board beside the object (target=apriltag)"
            )
        largest = max(models, key=lambda number: models[number].num_reg_images())
        return _copy_model(database.parent / _MODELS / str(largest), folder / "0")


def _copy_model(model: Path, folder: Path) -> Path:
    """Copy a model atomically, because COLMAP ignores a full disk; `find_model` finds the file that is written last."""
    try:
        read_colmap(model)
    except NerfroError as error:
        raise NerfroError(
            f"COLMAP cannot write to {model}; free some space, or set TMPDIR to another folder"
        ) from error
    for file in sorted(model.iterdir(), key=lambda file: file.stem == "cameras"):
        write_atomically(folder / file.name, file.read_bytes())
    return folder


def numeric_order(names: Sequence[str]) -> list[int] | None:
    """Return the order of numbered file names such as IMG_0007.jpg; None if the names are not a sequence.

    Names are a sequence if at least 90 % of the steps between their numbers are at most four median steps.
    """
    parts = [re.fullmatch(r"(.*?)(\d+)\D*", name) for name in names]
    if any(part is None for part in parts) or len({part[1] for part in parts if part}) != 1:
        return None
    numbers = [int(part[2]) for part in parts if part]
    order = sorted(range(len(names)), key=numbers.__getitem__)
    steps = np.diff(np.array(numbers)[order])
    if len(steps) == 0 or steps.min() < 1 or (steps <= 4 * np.median(steps)).mean() < 0.9:
        return None
    return order


def sequential_pairs(order: Sequence[int], num_neighbors: int = 10) -> list[tuple[int, int]]:
    """Pair each image with the following ones, and with those 16, 32, 64, ... places later, which close loops."""
    strides = [*range(1, num_neighbors + 1), *(2**power for power in range(4, len(order).bit_length()))]
    return [(order[i], order[i + stride]) for stride in strides for i in range(len(order) - stride)]


def _extract(
    pycolmap: Any,
    images: Sequence[Path],
    masks: Sequence[Path | None],
    scratch: Path,
    settings: SfmSettings,
    threads: int,
) -> None:
    """Detect features outside the object and write them to the database."""
    masked = scratch / "masks"
    masked.mkdir()
    for image, mask in zip(images, masks, strict=True):
        if mask is not None:
            _write_ignored(mask, masked / f"{image.name}.png", settings)
    reader, extraction = pycolmap.ImageReaderOptions(), pycolmap.FeatureExtractionOptions()
    reader.camera_model, extraction.num_threads = _CAMERAS[settings.lens], threads
    if any(mask is not None for mask in masks):
        reader.mask_path = masked
    for chunk in _chunks([image.name for image in images], 4, "finding features"):
        pycolmap.extract_features(
            scratch / "database.db",
            images[0].parent,
            image_names=chunk,
            camera_mode=pycolmap.CameraMode.SINGLE,
            reader_options=reader,
            extraction_options=extraction,
        )
        reader.existing_camera_id = 1  # created by the first chunk


def _match(pycolmap: Any, database: Path, pairs: Sequence[tuple[str, str]], threads: int) -> None:
    """Match features of pairs of images.

    COLMAP reads pairs from a text file, which cannot contain names with spaces. Therefore, the images in the database
    have numbers as names while they are matched.
    """
    matching, pairing = pycolmap.FeatureMatchingOptions(), pycolmap.ImportedPairingOptions()
    matching.num_threads, pairing.match_list_path = threads, database.with_name("pairs.txt")
    with closing(sqlite3.connect(database)) as connection, connection:
        numbers = dict(connection.execute("SELECT name, image_id FROM images"))
        connection.execute("UPDATE images SET name = image_id")
    for chunk in _chunks(pairs, 100, f"matching {len(pairs)} pairs"):
        lines = [f"{numbers[one]} {numbers[other]}\n" for one, other in chunk]
        pairing.match_list_path.write_text("".join(lines), encoding="utf-8")
        pycolmap.match_image_pairs(database, matching_options=matching, pairing_options=pairing)
    with closing(sqlite3.connect(database)) as connection, connection:
        connection.executemany("UPDATE images SET name = ? WHERE image_id = ?", numbers.items())


def _map(pycolmap: Any, database: Path, images: Sequence[Path], threads: int) -> dict[int, Any]:
    """Register the images one after the other and write models beside the database; returns the models by number."""
    mapping = pycolmap.IncrementalPipelineOptions()
    mapping.ba_refine_principal_point = False
    mapping.random_seed, mapping.num_threads = 0, threads
    folder = database.with_name(_MODELS)
    folder.mkdir(exist_ok=True)
    # Registrations in a model that COLMAP discards are counted again in the next one.
    with counting_bar("registering images", len(images)) as advance:
        return pycolmap.incremental_mapping(
            database,
            images[0].parent,
            folder,
            mapping,
            initial_image_pair_callback=lambda: advance(2),
            next_image_callback=advance,
        )


def _chunks(items: Sequence[Any], size: int, description: str) -> Iterator[Sequence[Any]]:
    """Divide work into chunks with a progress bar, because COLMAP reports no progress."""
    return (items[start : start + size] for start in track(description, range(0, len(items), size)))


def _linked(models: dict[int, Any], settings: SfmSettings) -> set[str]:
    """Return the names of the images of the largest model that are linked by pairs with many points in common.

    Other images have no pose or may have a wrong one, which the reprojection error does not reveal.
    """
    if not models:
        return set()
    model = max(models.values(), key=lambda model: model.num_reg_images())
    images = list(model.images.values())
    points = [sorted({feature.point3D_id for feature in image.points2D if feature.has_point3D()}) for image in images]
    _, columns = np.unique(np.concatenate(points), return_inverse=True)
    rows = np.repeat(np.arange(len(images)), [len(some) for some in points])
    seen = csr_array((np.ones(len(rows)), (rows, columns)))
    _, group = connected_components(seen @ seen.T >= settings.min_common_points)
    return {image.name for image, number in zip(images, group, strict=True) if number == np.bincount(group).argmax()}


def _write_ignored(mask: Path, file: Path, settings: SfmSettings) -> None:
    """Write a COLMAP mask, in which features at black pixels are ignored."""
    inside: Float[np.ndarray, "H W"] = to_unit(read_mask(mask, settings.mask_labels)) > 0.5
    margin = max(1, round(settings.margin * inside.shape[1]))
    Image.fromarray(np.where(binary_dilation(inside, iterations=margin), 0, 255).astype(np.uint8)).save(file)


def import_model(folder: Path, images: Sequence[Path], size: tuple[int, int]) -> tuple[Calibration, Any]:
    """Import a COLMAP model in text or binary format.

    Args:
        folder: folder of the model.
        images: the photographs.
        size: width and height of the photographs, in pixels; the lens is scaled to this size.

    Returns:
        Lens and poses, and the 3-D points [points, 3].

    Raises:
        NerfroError: the model contains none of the images, or more than one camera.
    """
    pycolmap = require_pycolmap()
    parsed = read_colmap(folder)  # this reader detects truncated files, pycolmap does not
    names = {image.name for image in images}
    registered = [image for image in parsed.images if image.name in names]
    if not registered:
        raise NerfroError(
            f"{folder} contains none of the images (its first image is {parsed.images[0].name}); set images= to the "
            "folder that the model was made from"
        )
    numbers = {image.camera for image in registered}
    if len(numbers) > 1:
        raise NerfroError(
            f"{folder} has {len(numbers)} cameras, and the data set that calibrate writes holds one; reconstruct with "
            "a single camera, or train on the model itself with data=colmap"
        )
    camera, where = parsed.cameras[numbers.pop()], f"{folder}: the camera"
    lens = lens_of(camera, where).resized((camera.width, camera.height), size, where)
    check_lenses([lens], [where], size)
    errors = _reprojection_errors(pycolmap, folder, size[0] / camera.width) if len(parsed.points) else {}
    poses = {}
    for image in registered:
        error, num_points = errors.get(image.name, (float("nan"), 0))
        poses[image.name] = Pose(image.camera_to_world, num_points, error)
    skipped = {image.name: "no pose from COLMAP" for image in images if image.name not in poses}
    return Calibration(_intrinsics(lens), poses, skipped, 0), parsed.points


def _reprojection_errors(pycolmap: Any, folder: Path, scale: float) -> dict[str, tuple[float, int]]:
    """Compute the root mean square reprojection error in pixels and the number of points, by image name.

    The error of an image without points is NaN.
    """
    try:
        reconstruction = pycolmap.Reconstruction(folder)
    except Exception as cause:  # COLMAP raises several kinds of exceptions for files that contradict each other
        reason = str(cause).strip().split("\n")[0]
        raise NerfroError(f"{folder} is not a valid COLMAP model ({reason}); export the model again") from cause
    errors = {}
    for image in reconstruction.images.values():
        residuals = []
        for feature in image.points2D:
            if feature.has_point3D():
                projected = image.project_point(reconstruction.points3D[feature.point3D_id].xyz)
                if projected is not None:
                    residuals.append(np.linalg.norm(projected - feature.xy))
        error = scale * float(np.sqrt(np.mean(np.square(residuals)))) if residuals else float("nan")
        errors[image.name] = error, len(residuals)
    return errors


def _intrinsics(lens: Lens) -> Intrinsics:
    matrix = np.array([[lens.fx, 0, lens.cx], [0, lens.fy, lens.cy], [0, 0, 1]])
    if lens.distortion is None:
        return Intrinsics(matrix)
    k1, k2, k3, _, p1, p2, *below = lens.distortion  # COLMAP's camera models have no k4
    return Intrinsics(matrix, (k1, k2, p1, p2, k3, *below) if k3 or any(below) else (k1, k2, p1, p2))


def require_pycolmap() -> Any:
    """Import pycolmap, or raise an error with the command that installs pycolmap."""
    handler = signal.getsignal(signal.SIGTERM)
    pycolmap = optional("pycolmap", "capture", "target=colmap needs pycolmap")
    signal.signal(signal.SIGTERM, handler)  # the import replaces the handler by one for crashes
    return pycolmap

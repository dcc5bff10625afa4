"""Lens and poses from a COLMAP model, made here with pycolmap where there is none."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from PIL import Image
from scipy.ndimage import binary_dilation

from nerfro.capture.calibration import Calibration, Intrinsics, LensModel, Pose
from nerfro.data.colmap import lens_of
from nerfro.data.colmap_model import read_colmap
from nerfro.data.frames import Lens
from nerfro.data.image_files import read_mask, to_unit
from nerfro.errors import NerfroError
from nerfro.files.atomic import refuse_existing
from nerfro.paths import user_path

_MODEL_FOLDERS = ("sparse/0", "sparse")
# COLMAP's cameras that have the distortion of ours.
_CAMERAS = {"pinhole": "PINHOLE", "radial": "RADIAL", "opencv": "OPENCV"}
# A feature describes its neighbourhood: those near the object's outline see it too. Share of the image's width.
_MARGIN = 0.01
_SEED = 0


def find_model(
    model: str | None,
    images: list[Path],
    masks: list[Path | None],
    made: Path,
    lens: LensModel,
    given: Intrinsics | None,
    overwrite: bool,
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
    return reconstruct(images, masks, made, lens, given)


def reconstruct(
    images: Sequence[Path],
    masks: Sequence[Path | None],
    folder: Path,
    model: LensModel,
    given: Intrinsics | None,
) -> Path:
    """Structure from motion of the images of one folder with one lens; the folder of the model with most images.

    Features on the refractive object are discarded: rays that were bent do not meet in a point, and what is seen
    through the object would pull the poses. A lens that is given is kept.
    """
    pycolmap = _pycolmap()
    pycolmap.set_random_seed(_SEED)
    pycolmap.logging.minloglevel = pycolmap.logging.Level.ERROR.value
    with tempfile.TemporaryDirectory() as scratch:
        database, masked = Path(scratch) / "database.db", Path(scratch) / "masks"
        masked.mkdir()
        for image, mask in zip(images, masks, strict=True):
            if mask is not None:
                _write_ignored(mask, masked / f"{image.name}.png")
        reader = pycolmap.ImageReaderOptions()
        reader.camera_model = _CAMERAS[model]
        if any(mask is not None for mask in masks):
            reader.mask_path = masked
        if given is not None:
            numbers = [*given.matrix[[0, 1, 0, 1], [0, 1, 2, 2]], *(given.distortion or [0.0] * 4)]
            reader.camera_model, reader.camera_params = "OPENCV", ",".join(f"{number:.12g}" for number in numbers)
        pycolmap.extract_features(
            database,
            images[0].parent,
            image_names=[image.name for image in images],
            camera_mode=pycolmap.CameraMode.SINGLE,
            reader_options=reader,
        )
        pycolmap.match_exhaustive(database)
        options = pycolmap.IncrementalPipelineOptions()
        if given is not None:
            options.ba_refine_focal_length = options.ba_refine_extra_params = False
        else:
            options.ba_refine_principal_point = False
        options.random_seed = _SEED
        folder.mkdir(parents=True, exist_ok=True)
        found = pycolmap.incremental_mapping(database, images[0].parent, folder, options)
    if not found:
        raise NerfroError(
            f"COLMAP cannot place the {len(images)} images: too few features match; photograph with more overlap and "
            "texture around the object, or lay a board beside it (target=apriltag)"
        )
    return folder / str(max(found, key=lambda number: found[number].num_reg_images()))


def import_model(folder: Path, images: Sequence[Path], size: tuple[int, int]) -> tuple[Calibration, Any]:
    """Lens and poses of a model, text or binary, for images of a size (width, height), and its 3-D points [P, 3]."""
    pycolmap = _pycolmap()
    parsed = read_colmap(folder)  # first, for pycolmap does not notice a file that is cut off
    names = {image.name for image in images}
    registered = [image for image in parsed.images if image.name in names]
    if not registered:
        raise NerfroError(
            f"{folder} knows none of the images (its first is {parsed.images[0].name}); set images= to its folder"
        )
    numbers = {image.camera for image in registered}
    if len(numbers) > 1:
        raise NerfroError(
            f"{folder} has {len(numbers)} cameras, and this format holds one; reconstruct with one (single camera), "
            "or train on the model itself: data=colmap"
        )
    camera, where = parsed.cameras[numbers.pop()], f"{folder}: the camera"
    lens = lens_of(camera, where).resized((camera.width, camera.height), size, where)
    errors = _reprojection_errors(pycolmap.Reconstruction(folder), size[0] / camera.width)
    poses = {}
    for image in registered:
        error, num_points = errors[image.name]
        poses[image.name] = Pose(image.camera_to_world, num_points, error)
    skipped = {image.name: "not placed by COLMAP" for image in images if image.name not in poses}
    return Calibration(_intrinsics(lens), poses, skipped, 0), parsed.points


def _reprojection_errors(reconstruction: Any, scale: float) -> dict[str, tuple[float, int]]:
    """Root mean square in pixels and number of points, by image."""
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
    k1, k2, k3, _, p1, p2, *below = lens.distortion  # COLMAP's models have no fourth
    return Intrinsics(matrix, (k1, k2, p1, p2, k3, *below) if k3 or any(below) else (k1, k2, p1, p2))


def _write_ignored(mask: Path, file: Path) -> None:
    """COLMAP's mask: black where features are ignored."""
    inside: Float[np.ndarray, "H W"] = to_unit(read_mask(mask)) > 0.5
    margin = max(1, round(_MARGIN * inside.shape[1]))
    Image.fromarray(np.where(binary_dilation(inside, iterations=margin), 0, 255).astype(np.uint8)).save(file)


def _pycolmap() -> Any:
    try:
        import pycolmap
    except ImportError as error:
        raise NerfroError(f"target=colmap needs pycolmap ({error}); pip install 'nerfro[capture]'") from error
    return pycolmap

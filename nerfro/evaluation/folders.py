"""Pairs of predictions and references in two folders, matched by file name."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from nerfro.core.errors import NerfroError
from nerfro.data.image_files import VIEW_SUFFIXES, Alpha, read_rgb, suffix_list, to_unit
from nerfro.data.masks import find_mask, find_masks, require_used


@dataclass(frozen=True)
class ImagePair:
    """A prediction with its reference.

    Attributes:
        name: common name of both files, without extension.
        prediction: file of the predicted image.
        reference: file of the reference image.
        mask: file of the object's silhouette, or None to use the transparency of the reference, if any.
        mask_labels: labels of the object in the mask, see `nerfro.data.image_files.read_mask`.
    """

    name: str
    prediction: Path
    reference: Path
    mask: Path | None
    mask_labels: Sequence[int] | None = None

    def load(self, alpha: Alpha) -> tuple[Float[Tensor, "H W 3"], Float[Tensor, "H W 3"], Float[Tensor, "H W"] | None]:
        """Read the images.

        Args:
            alpha: treatment of transparency, see `read_rgb`.

        Returns:
            Prediction and reference, sRGB in [0, 1], and the coverage of each pixel by the object in [0, 1], or None.

        Raises:
            NerfroError: a file cannot be read, or sizes differ.
        """
        prediction, reference = (
            torch.tensor(to_unit(read_rgb(path, alpha))) for path in (self.prediction, self.reference)
        )
        if prediction.shape != reference.shape:
            raise NerfroError(
                f"{self.prediction} has {_size(prediction)} pixels but its reference {self.reference} has "
                f"{_size(reference)}; render both in the same size"
            )
        size = reference.shape[1], reference.shape[0]
        masks = find_masks([self.reference], [self.mask], 1, size, self.mask_labels)
        return prediction, reference, None if masks is None else masks[0]


def match_folders(
    predictions: Path,
    references: Path,
    masks: Path | None,
    labels: Sequence[int] | None = None,
    read_names: Callable[[], Mapping[str, str]] = dict,
) -> list[ImagePair]:
    """Match the images of two folders by name without extension.

    Args:
        predictions: folder of predicted images.
        references: folder of reference images. Files `mask_<name>.png` are masks.
        masks: folder of masks. By default, `find_mask` searches the folder of references.
        labels: labels of the object in the masks, see `nerfro.data.image_files.read_mask`.
        read_names: returns the names of predictions by the names of their references and masks, where these differ.
            It may raise an error if references have the names of the predictions.

    Returns:
        The pairs, sorted by name.

    Raises:
        NerfroError: a folder does not exist or holds no images, an image has no counterpart, or a name occurs twice.
    """
    predicted, truth = _list_images(predictions, "predictions"), _list_images(references, "references")
    truth = {name: path for name, path in truth.items() if not name.startswith("mask_") or name[5:] not in truth}
    try:
        renamed = read_names()
    except NerfroError as error:
        if not predicted.keys() & truth.keys():
            raise NerfroError(
                f"the images in predictions={predictions} and references={references} have different names, and the "
                f"data set that relates them cannot be loaded ({error}); if it has moved, give its folder as root=DIR"
            ) from error
        renamed = {}
    truth = {renamed.get(name, name): path for name, path in truth.items()}
    _require(predicted, truth, f"reference in references={references}")
    _require(truth, predicted, f"prediction in predictions={predictions}")
    if masks is None:
        mask_files = {name: find_mask(references, path) for name, path in truth.items()}
        require_used(references, list(truth.values()), list(mask_files.values()))
        files = {name: path for name, path in mask_files.items() if path is not None}
        where = f"references={references}, where others have one"
    else:
        named = {name.removeprefix("mask_"): path for name, path in _list_images(masks, "masks").items()}
        files = {renamed.get(name, name): path for name, path in named.items()}
        where = f"masks={masks}"
    if files:
        _require(truth, files, f"mask in {where}")
    return [ImagePair(name, predicted[name], truth[name], files.get(name), labels) for name in sorted(predicted)]


def _list_images(folder: Path, option: str) -> dict[str, Path]:
    """List the images of a folder by name without extension."""
    if not folder.is_dir():
        raise NerfroError(f"{option}={folder} is not a folder; give a folder of images")
    images: dict[str, Path] = {}
    for path in sorted(folder.iterdir()):
        if path.suffix.lower() not in VIEW_SUFFIXES or path.name.startswith("."):
            continue
        if path.stem in images:
            raise NerfroError(f"{images[path.stem]} and {path} have the same name; keep one in {option}={folder}")
        images[path.stem] = path
    if not images:
        raise NerfroError(f"{option}={folder} holds no images; allowed are {suffix_list(VIEW_SUFFIXES)}")
    return images


def _require(images: Mapping[str, Path], counterparts: Collection[str], description: str) -> None:
    unmatched = [path for name, path in images.items() if name not in counterparts]
    if unmatched:
        raise NerfroError(
            f"{len(unmatched)} of {len(images)} images have no {description} ({unmatched[0]} is the first); "
            "files are matched by name without extension: add or rename the missing files, or remove these"
        )


def _size(image: Tensor) -> str:
    return f"{image.shape[1]}x{image.shape[0]}"

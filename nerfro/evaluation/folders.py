"""Folders of predictions and references, of any program, matched by the names of their files."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from nerfro.data.image_files import IMAGE_SUFFIXES, Alpha, read_rgb, to_unit
from nerfro.data.masks import find_mask, find_masks
from nerfro.errors import NerfroError
from nerfro.evaluation.regions import object_pixels


@dataclass(frozen=True)
class PicturePair:
    """A prediction and what it is compared with."""

    name: str  # what both files are called, without extension
    prediction: Path
    reference: Path
    mask: Path | None  # says where the object is; None to take the reference's transparency, if it has any

    def load(self, alpha: Alpha) -> tuple[Float[Tensor, "H W 3"], Float[Tensor, "H W 3"], Float[Tensor, "H W"] | None]:
        """Read the prediction, the reference, and the share of each pixel that the object covers, if it is known.

        Raises:
            NerfroError: a file cannot be read, sizes differ, or the mask is empty.
        """
        prediction, reference = (
            torch.tensor(to_unit(read_rgb(path, alpha))) for path in (self.prediction, self.reference)
        )
        if prediction.shape != reference.shape:
            raise NerfroError(
                f"{self.prediction} has {_size(prediction)} pixels but its reference {self.reference} has "
                f"{_size(reference)}; render it in the reference's size, or give references of the predictions' size"
            )
        masks = find_masks([self.reference], [self.mask], 1, (reference.shape[1], reference.shape[0]))
        coverage = None if masks is None else masks[0]
        if coverage is not None and not object_pixels(coverage).any():
            raise NerfroError(
                f"the mask {self.mask or f'(transparency) of {self.reference}'} is empty: no pixel is covered by half; "
                "correct it, or leave the view out"
            )
        return prediction, reference, coverage


def match_folders(predictions: Path, references: Path, masks: Path | None) -> list[PicturePair]:
    """Pair the pictures of two folders by their names without extension, in the order of their names.

    Masks among the references (`mask_<name>.png`) are not references. Without a folder of masks, they are looked for as
    `find_mask` does, beside the references and in masks/ there.

    Raises:
        NerfroError: a folder does not exist or has no pictures, a picture has no partner, or a name occurs twice.
    """
    predicted, truth = _pictures(predictions, "predictions"), _pictures(references, "references")
    truth = {name: path for name, path in truth.items() if not name.startswith("mask_") or name[5:] not in truth}
    _require(predicted, truth, f"reference in references={references}")
    _require(truth, predicted, f"prediction in predictions={predictions}")
    if masks is None:
        found = {name: find_mask(references, path) for name, path in truth.items()}
        files = {name: path for name, path in found.items() if path is not None}
        where = f"references={references}, where others have one"
    else:
        files = {name.removeprefix("mask_"): path for name, path in _pictures(masks, "masks").items()}
        where = f"masks={masks}"
    if files:
        _require(truth, files, f"mask in {where}")
    return [PicturePair(name, predicted[name], truth[name], files.get(name)) for name in sorted(predicted)]


def _pictures(folder: Path, option: str) -> dict[str, Path]:
    """The pictures of a folder by their names without extension."""
    if not folder.is_dir():
        raise NerfroError(f"{option}={folder} is not a folder; give one that holds pictures")
    pictures: dict[str, Path] = {}
    for path in sorted(folder.iterdir()):
        if path.suffix.lower() not in IMAGE_SUFFIXES or path.name.startswith("."):
            continue
        if path.stem in pictures:
            raise NerfroError(f"{pictures[path.stem]} and {path} have one name; keep one of them in {option}={folder}")
        pictures[path.stem] = path
    if not pictures:
        raise NerfroError(f"{option}={folder} holds no pictures; allowed are {', '.join(IMAGE_SUFFIXES)}")
    return pictures


def _require(pictures: Mapping[str, Path], partners: Collection[str], partner: str) -> None:
    bare = [path for name, path in pictures.items() if name not in partners]
    if bare:
        raise NerfroError(
            f"{len(bare)} of {len(pictures)} pictures have no {partner} ({bare[0]} is the first); "
            "files are matched by their names without extension: add or rename what is missing, or take it out"
        )


def _size(picture: Tensor) -> str:
    return f"{picture.shape[1]}x{picture.shape[0]}"

"""Tracking of an object through ordered photographs by Segment Anything 2 (Ravi et al., 2024)."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor
from torch.nn.functional import interpolate

from nerfro.core.errors import NerfroError, optional

# Mean and standard deviation of the network's input, sRGB, as in its training.
_MEAN, _STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
_TOP_LEFT, _BOTTOM_RIGHT = 2, 3  # labels of the corners of a box
_OBJECT = 1  # identifier of the only tracked object


def load_tracker(folder: Path) -> Any:
    """Load a `Sam2VideoModel` from a folder with `config.json` and `model.safetensors`.

    Nothing is downloaded, and no pickled file is read.

    Raises:
        NerfroError: the package transformers is missing, or the folder contains no such network.
    """
    transformers = optional("transformers", "sam2", f"sam2={folder} needs transformers")
    if not (folder / "config.json").is_file():
        raise NerfroError(
            f"sam2={folder} has no config.json; give a folder with the files config.json and model.safetensors of a "
            "Segment Anything 2 network in the format of transformers"
        )
    logging = optional("transformers.utils", "sam2", "sam2= needs transformers").logging
    logging.set_verbosity_error()
    logging.disable_progress_bar()
    try:
        model, found = transformers.Sam2VideoModel.from_pretrained(
            str(folder), local_files_only=True, use_safetensors=True, output_loading_info=True
        )
    except Exception as error:  # the library raises many kinds of exceptions for damaged files
        reason = str(error).strip().split("\n")[0] or type(error).__name__
        raise NerfroError(f"sam2={folder} cannot be loaded ({reason}); download the network again") from error
    if found["missing_keys"]:
        raise NerfroError(
            f"sam2={folder} lacks {len(found['missing_keys'])} weights of a Segment Anything 2 network for videos "
            f"({min(found['missing_keys'])}); give the folder of such a network"
        )
    return model.eval().to("cuda" if torch.cuda.is_available() else "cpu")


@torch.no_grad()
def track_object(
    model: Any,
    images: Sequence[UInt8[np.ndarray, "H W 3"]],
    masks: Mapping[int, Bool[np.ndarray, "H W"]],
    boxes: Mapping[int, Sequence[float]],
    progress: Callable[[], None] = lambda: None,
) -> dict[int, Bool[np.ndarray, "H W"]]:
    """Segment an object in all images, forward and backward from the first prompt.

    Args:
        model: network of `load_tracker`.
        images: 8-bit sRGB images in the order of the video.
        masks: known masks by image, which prompt the network.
        boxes: boxes (left, top, right, bottom) around the object by image, in pixels, which prompt the network.
        progress: called once for each image without a prompt.

    Returns:
        Mask of every image without a known mask.
    """
    sam2_video = optional("transformers.models.sam2_video.modeling_sam2_video", "sam2", "sam2= needs transformers")
    side = model.config.image_size
    height, width = images[0].shape[:2]
    frames = torch.cat([_network_input(image, side) for image in images])
    session = sam2_video.Sam2VideoInferenceSession(
        frames, height, width, inference_device=model.device, dtype=frames.dtype
    )
    index = session.obj_id_to_idx(_OBJECT)
    for number, mask in masks.items():
        covered = interpolate(torch.from_numpy(mask)[None, None].float(), (side, side), mode="bilinear", antialias=True)
        session.add_mask_inputs(index, number, (covered >= 0.5).float())
    for number, box in boxes.items():
        corners = torch.tensor(box, dtype=torch.float32).reshape(1, 1, 2, 2) * side / torch.tensor([width, height])
        labels = torch.tensor([[[_TOP_LEFT, _BOTTOM_RIGHT]]], dtype=torch.int32)
        session.add_point_inputs(index, number, {"point_coords": corners, "point_labels": labels})
    prompted, found = sorted({*masks, *boxes}), {}

    def keep(number: int, logits: Float[Tensor, "1 1 h w"]) -> None:
        enlarged = interpolate(logits.float().cpu(), (height, width), mode="bilinear")
        found[number] = (enlarged[0, 0] > 0).numpy()

    for number in prompted:  # all prompts are known before the tracking starts
        session.obj_with_new_inputs = [_OBJECT]
        keep(number, model(session, frame_idx=number).pred_masks)
    for reverse in (False, True):
        for output in model.propagate_in_video_iterator(session, start_frame_idx=prompted[0], reverse=reverse):
            if output.frame_idx not in prompted:
                keep(output.frame_idx, output.pred_masks)
                progress()
    return {number: mask for number, mask in found.items() if number not in masks}


def _network_input(image: UInt8[np.ndarray, "H W 3"], side: int) -> Float[Tensor, "1 3 side side"]:
    pixels = torch.from_numpy(image).permute(2, 0, 1)[None].float() / 255
    resized = interpolate(pixels, (side, side), mode="bilinear", antialias=True)
    mean, std = (torch.tensor(values).reshape(3, 1, 1) for values in (_MEAN, _STD))
    return (resized - mean) / std

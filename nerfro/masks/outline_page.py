"""Page on which the user draws outlines of the object and sees the masks that follow in all views."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, UInt8
from PIL import Image
from skimage.measure import approximate_polygon, find_contours

from nerfro.core.errors import NerfroError
from nerfro.data.base import Frame
from nerfro.data.image_files import read_size
from nerfro.files.images import data_uri
from nerfro.files.templates import fill_template
from nerfro.masks.mask_files import read_outlines
from nerfro.masks.masking import Segmentation
from nerfro.viewing.server import PageServer, open_page

_TEMPLATE = Path(__file__).with_name("outlines.html.jinja")

Outlines = dict[str, list]


@dataclass
class OutlinePage:
    """Answers the requests of the page: the outlines come in, the masks of all views go out.

    Attributes:
        images: 8-bit sRGB images of all views.
        frames: frames of these views.
        outlines: present outlines by image name.
        segment: computes the masks of all views from outlines.
        save: writes outlines and masks, and returns a message.
    """

    images: Sequence[UInt8[np.ndarray, "H W 3"]]
    frames: Sequence[Frame]
    outlines: Outlines
    segment: Callable[[Outlines], Segmentation]
    save: Callable[[Outlines, Segmentation], str]
    _found: Segmentation | None = None  # masks that follow from the present outlines

    def __post_init__(self) -> None:
        self._sizes = [read_size(frame.image)[:2] for frame in self.frames]
        self.outlines = {name: _polygon(outline) for name, outline in self.outlines.items()}

    def serve(self, title: str, host: str, port: int, opens: bool) -> None:
        """Serve the page until the user has saved the masks."""
        self._server = PageServer(host, port, self.answer)
        self._server.open(fill_template(_TEMPLATE, title=title, photographs=self._photographs()))
        print(f"nerfro: draw the outlines on {self._server.url}; Ctrl-C ends without masks", flush=True)
        if opens:
            open_page(self._server.url)
        while not self._server.ended.wait(1.0):  # without a limit, Windows does not interrupt the wait
            pass
        self._server.close()

    @torch.no_grad()
    def answer(self, request: Any) -> dict[str, Any]:
        """Return outlines, masks as polygons by view, notes by view, and a message.

        Args:
            request: `{"outlines": ..., "save": ...}`; outlines of None ask for the present ones.

        Raises:
            NerfroError: the request is invalid, or the masks cannot be saved.
        """
        if not isinstance(request, dict) or set(request) != {"outlines", "save"}:
            raise NerfroError("the request has no outlines; reload the page")
        if request["outlines"] is not None and (outlines := read_outlines(request["outlines"])) != self.outlines:
            self.outlines, self._found = outlines, None
        masks, notes = {}, {}
        try:
            segmentation = self._found = self._found or self.segment(self.outlines)
        except NerfroError as error:
            if request["save"]:
                raise
            message = str(error)
        else:
            masks = {view: self._contours(view, mask) for view, mask in segmentation.masks.items()}
            notes = {view: f"given, overlap {overlap:.3f}" for view, overlap in segmentation.agreement.items()}
            message = f"{len(segmentation.by_hull)} masks are projections of the {segmentation.shape}"
            if request["save"]:
                message = self.save(self.outlines, segmentation)
                self._server.finish()
        return {"outlines": self.outlines, "masks": masks, "notes": notes, "message": message}

    def _photographs(self) -> list[dict[str, Any]]:
        photographs = []
        for frame, image, (width, height) in zip(self.frames, self.images, self._sizes, strict=True):
            picture = Image.fromarray(image)
            picture.thumbnail((960, 960))
            uri = data_uri(np.asarray(picture), "JPEG", quality=85)
            photographs.append({"name": frame.name, "width": width, "height": height, "image": uri})
        return photographs

    def _contours(self, view: int, mask: Bool[np.ndarray, "H W"]) -> list[list[list[float]]]:
        """Convert a mask to polygons of (column, row) in pixels of the image file."""
        scale = np.divide(self._sizes[view], mask.shape[::-1])
        rings = [
            # Vertices lie within half a pixel of the mask.
            approximate_polygon(ring, 0.5)
            for ring in find_contours(np.pad(mask, 1).astype(np.float32), 0.5)
        ]
        return [((ring[:, ::-1] - 0.5) * scale).round(1).tolist() for ring in rings]


def _polygon(outline: list) -> list:
    """Return a polygon, or the corners of a box."""
    if isinstance(outline[0], list):
        return outline
    left, top, right, bottom = outline
    return [[left, top], [right, top], [right, bottom], [left, bottom]]

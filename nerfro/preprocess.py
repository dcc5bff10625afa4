"""`python -m nerfro.preprocess data.root=DIR`: reconstruct the surface and the refractive index of an object.

The refractive index is estimated from the photographs unless `medium.ior` is given.

Examples:
    nerfro preprocess data=opencv data.root=data/glass medium.ior=1.33
    nerfro preprocess data=opencv data.root=data/glass refine=true
"""

from __future__ import annotations

from omegaconf import DictConfig

import nerfro.cli.startup  # noqa: F401 - before the other imports, which take seconds
from nerfro.capture.preprocess import preprocess_composed
from nerfro.capture.preprocess_options import PreprocessConfig, Request
from nerfro.cli.calls import Composition
from nerfro.cli.entry import entry_point
from nerfro.cli.overrides import as_overrides, print_next
from nerfro.rendering.scene_file import SCENE, with_scene


@entry_point("preprocess", PreprocessConfig, expand=with_scene)
def main(config: DictConfig) -> None:
    """Reconstruct the surface, search the index, refine the surface if requested, and print the next command."""
    request = Request(**vars(Composition.of_job(config)))
    scene, file = preprocess_composed(request), request.out / SCENE
    if scene.provenance.reflects is None and not scene.training_options:
        print("reflection and absorption are unknown; if the object reflects or absorbs light, add experiment=glass")
    options: dict[str, object] = {"scene": file} | scene.training_options
    print_next("train on it", "train", as_overrides(options))
    if scene.vessel:
        print_next("train on the vessel", "train", as_overrides(options | {"medium": "vessel"}))


if __name__ == "__main__":
    main()

"""`python -m nerfro.synthesize scene=torus`: render the ground truth of a synthetic scene with Mitsuba 3."""

from __future__ import annotations

from omegaconf import DictConfig

from nerfro.cli import entry_point
from nerfro.paths import CONF_DIR
from nerfro.scenes.synthesis import CAPTURES, SynthesizeConfig, synthesize


@entry_point("synthesize", SynthesizeConfig, CONF_DIR / "synthesize")  # conf/scene would turn `scene=` into a group
def main(config: DictConfig) -> None:
    """Render the missing images, and print the next command."""
    scene, folder = synthesize(config)
    print(f"done: {folder}")
    if config.scene in CAPTURES:
        print(f"calibrate it: python -m nerfro.calibrate images={folder / 'images'} target=apriltag out={folder}")
        return
    mesh = folder / "mesh.ply"
    print(f"train on it: python -m nerfro.train data.root={folder} medium.mesh={mesh} medium.ior={scene.ior}")


if __name__ == "__main__":
    main()

"""Assumptions about a photographed object, and the trainings that try them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from nerfro.capture.object_errors import COMMON_INDICES, SOLID, STRAIGHT, VESSEL
from nerfro.rendering.scene_file import SceneFile


@dataclass(frozen=True)
class Hypothesis:
    """An assumption about the object.

    Attributes:
        name: name in the table.
        options: options of `python -m nerfro.train` under this assumption, beside the scene file.
        doubt: reason for a failure of bent rays, for the message about the result; empty if unknown.
        speed: number of training steps in the time of one step with bent rays.
    """

    name: str
    options: list[str]
    doubt: str = ""
    speed: float = 1.0

    @property
    def folder(self) -> str:
        """Name of the folder of the trial."""
        return self.name.replace(" ", "_").replace(",", "")

    @property
    def choice(self) -> str:
        """Value of the option `hypothesis` that selects this hypothesis."""
        return {STRAIGHT: "straight", VESSEL: "vessel"}.get(self.name, "solid")

    def trial_options(self, steps: int) -> list[str]:
        """Return the options of a short training that is scored on validation photographs.

        Steps instead of seconds keep the comparison independent of compilation and of other programs.

        Args:
            steps: number of steps with bent rays; straight rays take more steps in the same time.
        """
        return [
            f"trainer.max_steps={round(self.speed * steps)}",
            "trainer.max_time=null",
            "batches.num_validation_views=5",
            "evaluation.split=val",
            "evaluation.every=0",
            "logger=none",
        ]


def hypotheses(scene: SceneFile) -> list[Hypothesis]:
    """List the assumptions about the object, straight rays first.

    Straight rays show an opaque object, and are the baseline of all other hypotheses. A body has the index that
    `preprocess` found; without a reliable index, the indices of water and of glass are the initial values of a learned
    index. A vessel needs the lengths of `preprocess vessel=true`.

    Args:
        scene: content of the scene file.
    """
    near = scene.surroundings == "near"
    # One step of bent rays takes the processor time of 1.25 steps of straight rays (docs/lab/simulated_glassware.md).
    straight = Hypothesis(STRAIGHT, ["+experiment=straight"], speed=1.25)
    # Surfaces from photographs are inaccurate: more steps gain more than several rays for diverging pixels.
    in_room = ["+experiment=glass_room", "batches.subdivision.side=1"]
    known_materials = in_room if near else ["+experiment=glass"]
    if "wall" in scene.medium:  # the materials of a vessel are known
        return [straight, Hypothesis(VESSEL, known_materials)]
    if scene.short is None:
        return [straight, Hypothesis("bodies", known_materials)]
    body = in_room if near else ["+experiment=unknown"]
    if not scene.provenance.doubts:
        learned = ["medium.learn_absorption=true"] if any(scene.provenance.absorbed) else []
        bodies = [Hypothesis(SOLID, [*body, *learned])]
    else:
        doubt = "the photographs do not determine its index"
        bodies = [
            Hypothesis(f"{SOLID}, {name}", [*body, f"medium.ior={index}", "medium.learn_ior=true"], doubt)
            for name, index in COMMON_INDICES.items()
        ]
    vessel = [Hypothesis(VESSEL, [*known_materials, "medium=vessel"])] if scene.vessel else []
    return [straight, *bodies, *vessel]


def worth_a_trial(candidates: Sequence[Hypothesis], unsupported: Sequence[str]) -> list[Hypothesis]:
    """Order hypotheses by the errors at pixels of the object, and omit solid bodies with an unlikely index.

    These errors compare colours with the surroundings in the exit directions, so inaccurate surroundings or a thin wall
    hide the effect of a body. Therefore at least one hypothesis of every choice remains.

    Args:
        candidates: the hypotheses.
        unsupported: names of bodies that these pixels do not support, the smallest error first.

    Returns:
        Straight rays, then the supported bodies, then the others by their error.
    """
    rank = {name: number for number, name in enumerate(unsupported, start=1)}
    ordered = sorted(candidates, key=lambda body: (body.name != STRAIGHT, rank.get(body.name, 0)))
    first = {hypothesis.choice: hypothesis for hypothesis in reversed(ordered)}
    return [body for body in ordered if body.name not in rank or first[body.choice] is body]

"""`python -m nerfro.train`: train an experiment, evaluate it on the test views, and print the scores.

Examples:
    nerfro train trainer.max_time=2m hydra.run.dir=outputs/first
    nerfro train experiment=glass data.root=data/glass medium.mesh=data/glass/mesh.ply medium.ior=1.5
"""

from __future__ import annotations

from dataclasses import replace

from omegaconf import DictConfig

import nerfro.cli.startup  # noqa: F401 - before the other imports, which take seconds
from nerfro.cli.calls import Composition
from nerfro.cli.entry import entry_point
from nerfro.evaluation.results import RunMetrics, optimized
from nerfro.rendering.scene_file import with_scene
from nerfro.training.config import TrainConfig, check_run, require_inputs
from nerfro.training.effects import warn_without_effect
from nerfro.training.sweeps import run_cell


@entry_point("train", TrainConfig, check=check_run, check_inputs=require_inputs, expand=with_scene)
def main(config: DictConfig) -> float | None:
    """Train one experiment, evaluate it, and return `optimized_metric`, which sweepers of Hydra optimize."""
    composition = Composition.of_job(config)
    warn_without_effect(composition)

    def train(config: DictConfig) -> RunMetrics | None:
        from nerfro.training.run import run_training  # Lightning takes seconds, and compositions do not need it

        return run_training(replace(composition, config=config)).scores

    scores = run_cell(config, composition.folder, train)
    return None if scores is None else optimized(scores.result, config.optimized_metric)


if __name__ == "__main__":
    main()

"""Every experiment and scene file composes, and every experiment trains."""

import functools
import json
from pathlib import Path

import jaxtyping
import pytest
from omegaconf import DictConfig, OmegaConf

from nerfro.core.paths import CONF_DIR
from nerfro.registry.registration import build, create, discover, find
from nerfro.training.build import Training
from tests.conftest import QUIET, Runner, composed, write_tiny_scene

discover()

EXPERIMENTS = sorted(path.stem for path in (CONF_DIR / "experiment").glob("*.yaml"))
# Each differs from another experiment in a few values.
ABLATIONS = [name for name in EXPERIMENTS if "ablation_" in name or "_no" in name]
SCENES = sorted(path.stem for path in (CONF_DIR / "scene").glob("*.yaml"))

# The embedded scene at 16x16 pixels, two of its validation views instead of the test views, and one small batch.
SMALL = [
    "data.downscale=8",
    "evaluation.split=val",
    "evaluation.every=1",
    "batches.size=16",
    "trainer.limit_test_batches=2",
    "trainer.max_steps=2",
    *QUIET,
]


@pytest.fixture(autouse=True)
def _checked(train_here: Runner, monkeypatch: pytest.MonkeyPatch) -> None:
    """Turn on the checks of annotations that other trainings do without."""
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", False)


def shrunk(config: DictConfig) -> list[str]:
    """Overrides that keep a configuration's structure and shrink its numbers."""
    small: dict[str, dict[str, int]] = {
        "medium": {"resolution": 32, "smoothing_size": 3},
        "field": {"width": 8, "view_width": 8, "num_levels": 2, "log2_table_size": 8},
        "background": {"width": 8},
        "evaluation.subdivision": {"side": 1},
        "loss.smoothness": {"tile_size": 4},
        "model": {"resolution": 16},
        "sampler.path": {"num_steps": 48},
        "sampler.points": {"num_coarse": 8, "num_fine": 8, "num_samples": 16, "resolution": 16},
    }
    return [
        f"{section}.{name}={value}"
        for section, fields in small.items()
        for name, value in fields.items()
        if name in (OmegaConf.select(config, section) or {})
    ]


@pytest.mark.parametrize("experiment", [name for name in EXPERIMENTS if name not in ABLATIONS])
def test_experiment_trains_for_two_steps(experiment: str, train_here: Runner, tmp_path: Path) -> None:
    small = shrunk(composed(f"+experiment={experiment}"))
    train_here(f"+experiment={experiment}", *SMALL, *small, f"hydra.run.dir={tmp_path}")
    metrics = json.loads((tmp_path / "metrics.json").read_text())
    assert metrics["steps"] == 2
    assert len(metrics["views"]) == 2
    assert OmegaConf.load(tmp_path / "config.yaml").name == experiment


@pytest.mark.slow
@pytest.mark.parametrize(
    "experiment", ["refractive", "glass", "glass_room", "unknown", "straight", "mipnerf_sky", "nerf"]
)
def test_training_is_independent_of_the_world_unit(experiment: str, train_here: Runner, tmp_path: Path) -> None:
    small, scores = shrunk(composed(f"+experiment={experiment}")), []
    for scale in (1, 1024):  # a power of two, so that products are exact
        scene, run = write_tiny_scene(tmp_path / f"scene_{scale}", scale), tmp_path / f"run_{scale}"
        given = [
            f"data.root={scene}",
            f"medium.mesh={scene}/mesh.ply",
            f"data.near={2 * scale}",
            f"data.far={6 * scale}",
        ]
        given = [option for option in given if "mesh" not in option or experiment not in ("mipnerf_sky", "nerf")]
        box = [f"content.box_{end}={[sign * scale] * 3}" for end, sign in (("min", -1), ("max", 1))]
        train_here(
            f"+experiment={experiment}", *SMALL[1:], *small, *given, *box, "trainer.max_steps=8", f"hydra.run.dir={run}"
        )
        scores.append(json.loads((run / "metrics.json").read_text())["test"]["psnr"])
    assert scores[0] == pytest.approx(scores[1], abs=0.02)


@pytest.mark.parametrize("experiment", ABLATIONS)
def test_ablation_composes_and_builds(experiment: str) -> None:
    config = composed(f"+experiment={experiment}", *SMALL, *shrunk(composed(f"+experiment={experiment}")))
    Training.start(config)
    assert config.name == experiment


@pytest.mark.parametrize(
    ("scene", "experiment"),
    [*((name, "paper_refractive") for name in SCENES), ("torus", "paper_ablation_noBD"), ("ball", "paper_mipnerf")],
)
def test_scene_composes_with_experiments_of_the_paper(scene: str, experiment: str) -> None:
    own = OmegaConf.load(CONF_DIR / "scene" / f"{scene}.yaml")
    order = [f"+experiment={experiment}", f"+scene={scene}"]  # either order is possible
    config = composed(*(reversed(order) if experiment == "paper_refractive" else order), "data.root=/data")
    assert config.data.near == own.data.near
    assert config.medium.ior == own.medium.ior
    assert config.medium.mesh == "/data/mesh.ply"
    assert config.trainer.max_steps == own.authors.max_steps
    if experiment != "paper_mipnerf":
        assert config.medium.resolution == own.authors.resolution
        assert config.sampler.path.num_steps == own.authors.num_steps
        weight = 0 if experiment == "paper_ablation_noBD" else own.authors.background_weight
        assert config.loss.background.weight == weight


def test_eight_scenes_of_the_paper_exist() -> None:
    assert set(SCENES) == {"torus", "ship", "deerglobe", "starlamp", "dolphin", "ball", "glass", "pen"}


@pytest.mark.parametrize("experiment", ["paper_ablation_noH", "glass_room"])
def test_experiment_accepts_another_point_sampler(experiment: str) -> None:
    config = composed(f"+experiment={experiment}", "sampler/points=logarithmic", "sampler.points.num_samples=7")
    assert {key: value for key, value in config.sampler.points.items() if key != "_target_"} == {"num_samples": 7}


def test_experiments_can_be_combined() -> None:
    config = composed("+experiment=[ablation_noH,ablation_noBD]")
    assert "num_samples" in config.sampler.points
    assert config.loss.background.weight == 0
    assert config.name == "ablation_noBD"


@pytest.mark.parametrize(
    ("experiment", "ablation", "changed"),
    [
        ("refractive", "ablation_noH", {"sampler.points"}),
        ("paper_refractive", "paper_ablation_noH", {"sampler.points"}),
        ("refractive", "ablation_noBD", {"loss.background.weight"}),
        ("paper_refractive", "paper_ablation_noBD", {"loss.background.weight"}),
        ("glass", "glass_noReflection", {"sampler.path.branches"}),
        ("glass", "glass_noTint", {"medium.learn_absorption"}),
        ("mipnerf", "mipnerf_sky", {"content.space", "background", "model.colour", "loss.total_variation.weight"}),
    ],
)
def test_ablation_changes_only_its_component(experiment: str, ablation: str, changed: set[str]) -> None:
    one, other = (OmegaConf.to_container(composed(f"+experiment={name}")) for name in (experiment, ablation))
    for key in ("name", *changed):
        *groups, setting = key.split(".")
        parts = [functools.reduce(dict.__getitem__, groups, config) for config in (one, other)]
        assert parts[0].pop(setting) != parts[1].pop(setting), key
    assert one == other


@pytest.mark.parametrize(("experiment", "learned"), [("glass", ["absorption"]), ("unknown", ["ior", "absorption"])])
def test_experiments_of_glass_learn_all_bodies_without_their_own_settings(experiment: str, learned: list[str]) -> None:
    ball = "surface: {name: ball, radius: 1}, ior: 1.5"
    bodies = f"medium.bodies={{own: {{{ball}, learn: [ior]}}, common: {{{ball}}}}}"
    medium = build(composed(f"+experiment={experiment}", bodies, "medium.resolution=16", "medium.cache=false").medium)
    assert [list(material.learned()) for material in medium.materials] == [["ior"], learned]


def test_short_trials_of_bent_rays_have_the_penalties_of_straight_rays() -> None:
    """Otherwise the trials of `nerfro.reconstruct` compare penalties instead of hypotheses."""
    straight, bent = (composed(f"+experiment={name}").loss for name in ("straight", "glass_room"))
    assert straight.keys() == bent.keys()
    for name in straight:
        one, other = (create(find("loss", name), {k: v for k, v in loss[name].items() if k != "_target_"})
                      for loss in (straight, bent))  # fmt: skip
        assert sum(map(other.weight_at, range(600))) <= 2 * sum(map(one.weight_at, range(600))), name


def test_settings_of_the_paper_match_the_authors() -> None:
    assert composed("+experiment=paper_ablation_noH").sampler.points.num_samples == 256
    config = composed("+experiment=paper_refractive")
    assert config.loss.background.weight == 0.025
    assert (config.field.width, config.field.depth) == (256, 8)
    assert (config.sampler.points.num_coarse, config.sampler.points.num_fine) == (64, 128)
    assert (config.sampler.path.integrator, config.sampler.path.num_steps) == ("euler", 768)
    assert (config.batches.size, config.trainer.max_steps) == (1024, 200_000)

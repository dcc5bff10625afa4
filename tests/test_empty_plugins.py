"""nerfro is complete without the folder plugins/, which holds templates and one method of others."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from omegaconf import OmegaConf

from nerfro.core.paths import CONF_DIR, PACKAGE_DIR, PLUGINS_PACKAGE
from tests.conftest import composed

EXPERIMENTS = sorted(path.stem for path in (CONF_DIR / "experiment").glob("*.yaml"))


@pytest.mark.parametrize("experiment", EXPERIMENTS)
def test_experiments_consist_of_components_of_the_package(experiment: str) -> None:
    targets = re.findall(r"_target_: (\S+)", OmegaConf.to_yaml(composed(f"+experiment={experiment}")))
    assert targets
    assert [target for target in targets if not target.startswith(("nerfro.", "lightning."))] == []


def test_package_names_no_plugin() -> None:
    files = [file for file in PACKAGE_DIR.rglob("*.py") if "_project" not in file.parts]
    users = {file.name for file in files if PLUGINS_PACKAGE in file.read_text(encoding="utf-8")}
    assert users == {"paths.py"}


@pytest.mark.slow
def test_package_without_plugins_trains(tmp_path: Path, tiny_default_run: list[str]) -> None:
    shutil.copytree(PACKAGE_DIR, tmp_path / "nerfro", copy_function=os.link)  # links, because assets are large
    shutil.rmtree(tmp_path / "nerfro" / "_project", ignore_errors=True)
    shutil.copytree(CONF_DIR, tmp_path / "conf")
    environment = os.environ | {"PYTHONPATH": str(tmp_path), "NERFRO_PLUGINS": ""}
    command = [sys.executable, "-m", "nerfro.train", *tiny_default_run, "trainer.max_steps=1", "hydra.run.dir=run"]
    ended = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
    assert ended.returncode == 0, ended.stderr
    assert (tmp_path / "run" / "metrics.json").is_file()

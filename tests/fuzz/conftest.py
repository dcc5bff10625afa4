"""Fixtures of the tests of broken inputs."""

from pathlib import Path

import pytest

from tests.fuzz.world import World


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory, tiny_scene: Path, tiny_default_run: list[str]) -> World:
    return World(tmp_path_factory.mktemp("world"), tiny_scene, tiny_default_run)

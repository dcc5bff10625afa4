"""Plugins from plugins/, from other folders, and from installed packages; and the command that lists them."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

import nerfro.plugins
import nerfro.registry
from nerfro.errors import NerfroError
from nerfro.paths import PLUGINS_DIR
from nerfro.registry import KINDS, discover, find, plugins

discover()

BOUNDARY = '''
"""A boundary."""
import torch
from nerfro.boundaries.base import Boundary
from nerfro.registry import register


@register("boundary", "{name}")
class OneGrey(Boundary):
    """The same grey in every direction."""

    def __init__(self, grey: float = 0.5) -> None:
        super().__init__()
        self.grey = grey

    def forward(self, exits):
        return torch.full_like(exits.directions, self.grey)
'''


pytestmark = pytest.mark.usefixtures("restored_registry")


@pytest.fixture
def write_plugin(tmp_path: Path) -> Callable[[str, str], Path]:
    def write(name: str, source: str) -> Path:
        folder = tmp_path / "plugins_of_mine"
        folder.mkdir(exist_ok=True)
        (folder / f"{name}.py").write_text(source)
        return folder

    return write


def test_file_in_a_plugin_folder_is_registered(write_plugin: Callable[[str, str], Path]) -> None:
    discover(write_plugin("grey_a", BOUNDARY.format(name="grey_a")))
    plugin = find("boundary", "grey_a")
    assert plugin.target == "nerfro_plugins.grey_a.OneGrey"
    assert nerfro.registry.build({"_target_": plugin.target, "grey": 0.25}).grey == 0.25


def test_package_in_a_plugin_folder_is_registered(tmp_path: Path) -> None:
    (tmp_path / "folder" / "grey_package").mkdir(parents=True)
    (tmp_path / "folder" / "grey_package" / "__init__.py").write_text("from . import inner\n")
    (tmp_path / "folder" / "grey_package" / "inner.py").write_text(BOUNDARY.format(name="grey_b"))
    discover(tmp_path / "folder")
    assert find("boundary", "grey_b").target == "nerfro_plugins.grey_package.inner.OneGrey"


def test_folders_of_the_environment_are_searched_too(
    write_plugin: Callable[[str, str], Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("NERFRO_PLUGINS", str(write_plugin("grey_c", BOUNDARY.format(name="grey_c"))))
    discover()
    assert find("boundary", "grey_c").summary == "The same grey in every direction."


def test_discovering_twice_changes_nothing(write_plugin: Callable[[str, str], Path]) -> None:
    folder = write_plugin("grey_d", BOUNDARY.format(name="grey_d"))
    discover(folder)
    before = plugins()
    discover(folder)
    assert plugins() == before


@pytest.mark.parametrize(
    ("source", "cause"),
    [
        ("import no_such_package", "ModuleNotFoundError: No module named 'no_such_package'"),
        ("def f(:", "SyntaxError: "),
        ("1 / 0", "ZeroDivisionError: division by zero"),
    ],
)
def test_plugin_that_fails_is_named_with_the_cause(
    source: str, cause: str, write_plugin: Callable[[str, str], Path]
) -> None:
    folder = write_plugin("broken", source)
    with pytest.raises(NerfroError) as caught:
        discover(folder)
    assert str(caught.value).startswith(f"plugin {folder / 'broken.py'} cannot be imported: {cause}")


def test_plugin_with_a_taken_name_names_both_modules_and_its_file(write_plugin: Callable[[str, str], Path]) -> None:
    folder = write_plugin("clash", BOUNDARY.format(name="constant"))
    with pytest.raises(NerfroError) as caught:
        discover(folder)
    for word in (str(folder / "clash.py"), "boundary=constant is registered twice", "nerfro.boundaries.constant"):
        assert word in str(caught.value)
    assert "nerfro_plugins.clash" in str(caught.value)


def test_two_files_of_one_name_are_refused(tmp_path: Path) -> None:
    for folder in ("one", "two"):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "same.py").write_text(BOUNDARY.format(name=f"grey_{folder}"))
    discover(tmp_path / "one")
    with pytest.raises(NerfroError, match=r"two plugin files are called same: .*one.* and .*two"):
        discover(tmp_path / "two")


def test_missing_plugin_folder_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NERFRO_PLUGINS", str(tmp_path / "nowhere"))
    with pytest.raises(NerfroError, match=r"plugin folder .*nowhere does not exist; correct NERFRO_PLUGINS"):
        discover()


def test_templates_are_registered() -> None:
    templates = {path.stem for path in PLUGINS_DIR.glob("example_*.py")}
    modules = {plugin.cls.__module__.removeprefix("nerfro_plugins.") for plugin in plugins()}
    assert templates
    assert templates <= modules


# The list.


def listed(arguments: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> str:
    monkeypatch.setattr(sys, "argv", ["nerfro.plugins", *arguments])
    monkeypatch.setenv("COLUMNS", "200")
    nerfro.plugins.main()
    return capsys.readouterr().out


def test_list_shows_every_plugin_with_its_fields_defaults_and_summary(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    shown = listed([], monkeypatch, capsys)
    words = " ".join(shown.split())
    for plugin in plugins():
        assert f"{plugin.kind}={plugin.name}" in words
        assert " ".join(plugin.summary.split()) in words
        for name, kind, _ in plugin.fields():
            assert f"{name} {kind} " in words
    assert {plugin.kind for plugin in plugins()} == set(KINDS)


def test_list_of_one_kind_or_one_plugin_shows_no_other(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert "field=" not in listed(["boundary"], monkeypatch, capsys)
    shown = listed(["boundary=skybox"], monkeypatch, capsys)
    assert "boundary=skybox" in shown
    assert "boundary=constant" not in shown
    assert "width" in shown
    assert "128" in shown


@pytest.mark.parametrize(
    ("argument", "message"),
    [
        ("colour", "'colour' is not a plugin type; choose one of model, camera, medium"),
        ("field=x", "no field is called 'x'; known: "),
    ],
)
def test_list_of_nothing_known_is_refused(
    argument: str, message: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["nerfro.plugins", argument])
    with pytest.raises(SystemExit) as caught:
        nerfro.plugins.main()
    assert caught.value.code == 1
    assert message in capsys.readouterr().err


# Installed packages.

PYPROJECT = """
[build-system]
requires = ["hatchling"]
build-backend = "hatchling.build"
[project]
name = "nerfro-grey"
version = "1.0"
[project.entry-points."nerfro.plugins"]
grey = "nerfro_grey.boundary"
[tool.hatch.build.targets.wheel]
packages = ["nerfro_grey"]
"""

# The commands' own mains, in one process: to begin one takes most of the time.
USE_IT = """
import sys
import nerfro.plugins, nerfro.train
from nerfro.registry import find
from nerfro.testing import check
sys.argv = ["nerfro.plugins", "boundary=installed_grey"]
nerfro.plugins.main()
check(find("boundary", "installed_grey"))
print("kept its contract")
sys.argv = "nerfro.train boundary=installed_grey boundary.grey=0.25 --cfg job -p boundary".split()
nerfro.train.main()
"""


@pytest.mark.slow
def test_installed_package_is_found_listed_and_checked(tmp_path: Path) -> None:
    project, site = tmp_path / "project", tmp_path / "site"
    (project / "nerfro_grey").mkdir(parents=True)
    (project / "pyproject.toml").write_text(PYPROJECT)
    (project / "nerfro_grey" / "__init__.py").touch()
    (project / "nerfro_grey" / "boundary.py").write_text(BOUNDARY.format(name="installed_grey"))
    install(project, site)
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(site), os.environ.get("PYTHONPATH", "")])}

    def python(*arguments: str) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, *arguments]
        return subprocess.run(command, env=environment, cwd=tmp_path, capture_output=True, text=True, timeout=120)

    used = python("-c", USE_IT)
    assert used.returncode == 0, used.stderr
    listed, kept, job = used.stdout.partition("kept its contract\n")
    assert "The same grey in every direction." in listed
    assert kept
    assert "grey: 0.25" in job
    # One that cannot be imported stops the run and is named.
    (site / "nerfro_grey" / "boundary.py").write_text("import no_such_package\n")
    broken = python("-m", "nerfro.plugins")
    assert broken.returncode == 1
    assert broken.stderr.strip() == (
        "nerfro: error: plugin 'grey' of an installed package (nerfro_grey.boundary) cannot be imported: "
        "ModuleNotFoundError: No module named 'no_such_package'"
    )


def install(project: Path, site: Path) -> None:
    """`pip install` a project offline into a folder; skips where hatchling is not installed."""
    pytest.importorskip("hatchling")
    if shutil.which("pip") is None and subprocess.run([sys.executable, "-m", "pip", "--version"]).returncode:
        pytest.skip("pip is not installed")
    options = ["--no-deps", "--no-build-isolation", "--no-index", "--quiet", "--target", str(site)]
    command = [sys.executable, "-m", "pip", "install", *options, str(project)]
    subprocess.run(command, check=True, timeout=120)

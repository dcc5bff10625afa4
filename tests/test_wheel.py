"""The wheel contains conf/, plugins/ and the embedded scene, and works from any folder."""

import functools
import zipfile
from pathlib import Path

import pytest

from nerfro.core.paths import PACKAGE_DIR
from tests.processes import printed_by

PROJECT = PACKAGE_DIR.parent


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    builders = pytest.importorskip("hatchling.builders.wheel")
    pytest.importorskip("hatch_vcs")
    if not (PROJECT / "pyproject.toml").is_file():
        pytest.skip("there is no checkout to build a wheel of")
    built = builders.WheelBuilder(str(PROJECT)).build(
        directory=str(tmp_path_factory.mktemp("wheel")), versions=["standard"]
    )
    return Path(next(iter(built)))


@pytest.mark.slow
def test_wheel_contains_every_configuration_plugin_and_asset(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        inside = set(archive.namelist())
    for folder in ("conf", "plugins"):
        files = [p for p in (PROJECT / folder).rglob("*") if p.suffix in (".yaml", ".py", ".jinja")]
        assert files
        assert {f"nerfro/_project/{p.relative_to(PROJECT).as_posix()}" for p in files} <= inside
    assets = [p for p in (PACKAGE_DIR / "assets").rglob("*") if p.is_file()]
    assert {"nerfro/py.typed", "nerfro/__init__.pyi", *(p.relative_to(PROJECT).as_posix() for p in assets)} <= inside
    assert not [name for name in inside if name.startswith(("tests/", "outputs/")) or "__pycache__" in name]


@pytest.mark.slow
def test_installed_wheel_composes_and_lists_its_plugins_from_a_foreign_folder(wheel: Path, tmp_path: Path) -> None:
    site, elsewhere = tmp_path / "site", tmp_path / "elsewhere"
    elsewhere.mkdir()
    # A pure-Python wheel is installed by unpacking it.
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(site)

    python = functools.partial(printed_by, folder=elsewhere, PYTHONPATH=str(site), COLUMNS="200")
    assert python("-c", "import nerfro; print(nerfro.__file__)").strip().startswith(str(site))
    listed = python("-m", "nerfro.plugins")
    assert "background=skybox" in listed
    assert "background=gradient_sky" in listed, "plugins/ travels with it"
    job = python("-m", "nerfro.train", "+experiment=paper_refractive", "--cfg", "job")
    assert "name: paper_refractive" in job
    source = "from nerfro.data.formats.transforms import BlenderData as B; print(len(B().load('val')), B().root)"
    number, root = python("-c", source).split()
    assert int(number) > 0
    assert root.startswith(str(site))

"""The Python code of README, guides and notebooks runs, and the plugins that the guides define train."""

import ast
import json
import linecache
import pkgutil
import re
import runpy
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import nerfro
from nerfro.__main__ import commands
from nerfro.core.paths import PACKAGE_DIR
from nerfro.media.material import MATERIALS, find_material
from nerfro.registry.registration import discover, find
from nerfro.testing import check
from nerfro.viewing.exports import EXPORTS, ExportConfig, find_export
from tests.ball_photographs import RECONSTRUCTION_TRAINING, save_with_masks
from tests.conftest import Runner

CHECKOUT = PACKAGE_DIR.parent
pytestmark = pytest.mark.skipif(not (CHECKOUT / "docs").is_dir(), reason="there is no checkout with docs")


def test_documentation_clones_from_the_address_of_the_package() -> None:
    (address,) = re.findall(r'^Repository = "(.*)"', (CHECKOUT / "pyproject.toml").read_text(), re.MULTILINE)
    for page in ("README.md", "docs/index.md", "docs/tutorials/first_run.md"):
        assert re.findall(r"git clone (\S+)", (CHECKOUT / page).read_text()) == [address], page


def python_blocks(page: str) -> list[str]:
    return re.findall(r"^```python\n(.*?)^```", (CHECKOUT / page).read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE)


@pytest.fixture
def guide_plugins(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, restored_registry: None) -> list[str]:
    """Register the plugins of the guide and return the rest of its code."""
    rest = []
    for block in [*python_blocks("docs/guides/plugins.md"), *python_blocks("docs/tutorials/first_plugin.md")]:
        file = re.match(r"# plugins/(\w+\.py)\n", block)
        if file is None:
            rest.append(block)
        else:
            (tmp_path / file[1]).write_text(block)
    monkeypatch.setenv("NERFRO_PLUGINS", str(tmp_path))
    monkeypatch.setitem(EXPORTS, "centres", "")  # the export ends with the test
    discover()
    return rest


def test_plugins_of_the_guide_keep_their_contracts(guide_plugins: list[str]) -> None:
    named = ["sampler/points=square_root", "loss=half_transparent", "background=horizon", "metric=worst_pixel"]
    named += ["sampler/points=coarse_to_fine", "sampler/path=mirage", "surface=lens", "phase=mean_colour"]
    for kind, _, name in (text.partition("=") for text in named):
        check(find(kind, name))
    test, check_of_tutorial = guide_plugins
    namespace: dict[str, Any] = {}
    exec(check_of_tutorial, namespace)
    exec(test, namespace)
    namespace["test_square_root_sampler"]()


@pytest.mark.parametrize("path", ["sampler.path.branches=all", "sampler/path=mirage"])
def test_plugins_of_the_guide_train(
    path: str, guide_plugins: list[str], train_here: Runner, tiny_default_run: list[str], tmp_path: Path
) -> None:
    loss = ("+loss.half_transparent.weight=0.1", "+loss.half_transparent.power=2")
    options = ("sampler/points=square_root", *loss, "background=horizon", "+phase.mean_colour={}", path)
    finished = train_here(
        *(option for option in tiny_default_run if not option.startswith(("sampler.points", "background."))), *options,
        "trainer.max_steps=2", f"hydra.run.dir={tmp_path}/run",
    )  # fmt: skip
    assert "2 steps in" in finished.out


def test_export_of_the_guide_writes_its_file(guide_plugins: list[str], trained_run: Path, tmp_path: Path) -> None:
    scene, out = nerfro.load(trained_run), tmp_path / "centres.csv"
    find_export("centres", out).write(scene, out, ExportConfig())
    np.testing.assert_allclose(np.loadtxt(out, delimiter=","), scene.cameras("train").camera_to_world[:, :, 3])


@pytest.mark.parametrize("page", ["README.md", "docs/tutorials/notebook.md"])
def test_code_that_uses_a_run_executes(page: str, trained_run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MPLBACKEND", "agg")
    namespace: dict[str, Any] = {}
    for block in python_blocks(page):
        exec(re.sub(r'"(outputs/refractive/RUN|outputs/first)"', repr(str(trained_run)), block), namespace)
    assert torch.allclose(torch.as_tensor(namespace["bent"].directions).norm(dim=-1), torch.tensor(1.0))


@pytest.mark.slow
def test_code_of_the_chain_executes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, unchecked: None) -> None:
    """On small photographs of a ball with poses, as each command on its own."""
    save_with_masks(tmp_path / "ball")
    monkeypatch.chdir(tmp_path)
    *chain, together = python_blocks("docs/tutorials/python_chain.md")
    small = {
        '"data/glass", data="opencv"': '"ball", data="blender", settings={"near": 0.5}',
        '"medium.ior=1.5"': '"medium.ior=1.45", "medium.resolution=32", "resolution=24"',
        'split="val"': 'split="train"',
        '["trainer.max_time=4m"]': repr([*RECONSTRUCTION_TRAINING, "trainer.max_steps=2", "phase.background.steps=9"]),
    }
    code = "".join(chain)
    for text, other in small.items():
        assert code.count(text) == 1
        code = code.replace(text, other)
    namespace: dict[str, Any] = {}
    exec(code, namespace)
    assert namespace["scene"].bodies["object"].ior == 1.45
    assert namespace["run"].scores.steps == 2
    assert namespace["scores"].result.views == namespace["run"].scores.result.views
    assert all(file.stat().st_size > 0 for file in [*namespace["frames"], namespace["page"]])
    record = json.loads(Path("outputs/glass/run/run.json").read_text())
    assert " -m nerfro.train " in record["command"]
    assert "hydra.run.dir=outputs/glass/run" in record["command"]
    ast.parse(together)


def test_reference_explains_every_option() -> None:
    pages = runpy.run_path(str(CHECKOUT / "docs" / "reference_pages.py"))["pages"]()
    assert all(f"## {name}\n" in pages["commands.md"] for name in commands())
    unexplained = [row for page in pages.values() for row in page.split("\n") if row.startswith("|") and "|  |" in row]
    assert unexplained == []


def test_links_point_to_existing_files() -> None:
    generated = {CHECKOUT / "docs" / "reference" / name for name in ("commands.md", "configuration.md", "plugins.md")}
    for source in [*CHECKOUT.glob("*.md"), *CHECKOUT.glob("docs/**/*.md")]:
        text = re.sub(r"^```.*?^```", "", source.read_text(encoding="utf-8"), flags=re.DOTALL | re.MULTILINE)
        links = [link for link in re.findall(r"\]\(([^)#\s]+)", text) if "://" not in link]
        missing = [link for link in links if not (source.parent / link).exists()]
        assert [link for link in missing if (source.parent / link).resolve() not in generated] == [], source


def test_named_files_and_objects_exist() -> None:
    """In all pages but the records of earlier versions, and tutorials, whose reader writes files."""
    files = {str(file.relative_to(CHECKOUT)) for file in CHECKOUT.rglob("*.py")}
    folders = "nerfro|tests|plugins|conf|docs|benchmarks"
    pages = [page for page in CHECKOUT.glob("docs/**/*.md") if not {"lab", "tutorials"} & {*page.parts}]
    for page in [*pages, CHECKOUT / "README.md", CHECKOUT / "CONTRIBUTING.md"]:
        text = re.sub(r"^```.*?^```", "", page.read_text(encoding="utf-8"), flags=re.DOTALL | re.MULTILINE)
        paths = [path for path in re.findall(rf"`((?:{folders})/[\w./-]+)`", text) if not (CHECKOUT / path).exists()]
        modules = re.findall(r"`([\w./-]+\.py)`", text)
        modules = [path for path in modules if not any(f"/{file}".endswith(f"/{path}") for file in files)]
        assert (paths, modules) == ([], []), page
        for name in re.findall(r"`(nerfro\.[\w.]+\w)`", text):
            pkgutil.resolve_name(name)


def test_code_of_the_library_page_executes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    blocks = python_blocks("docs/guides/library.md")
    build, experiment, finder, paths = namespaces = [{} for _ in blocks]
    for block, namespace in zip(blocks, namespaces, strict=True):
        exec(block, namespace)
    assert build["image"].shape == (16, 16, 3)
    assert experiment["scene"].renderer.state_dict().keys() == experiment["again"].renderer.state_dict().keys()
    for name, weights in experiment["module"].renderer.state_dict().items():
        assert torch.equal(experiment["again"].renderer.state_dict()[name], weights)
    assert finder["finder"].suggestion() == finder["module"].learning_rate
    assert paths["path"].shape[1] == 3
    assert max(len(repr(value)) for value in (build["model"].scene, build["components"].medium)) < 250


def test_example_of_several_bodies_matches_closed_form(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(MATERIALS, "silicone", MATERIALS["water"])  # the material ends with the test
    plugin, example = python_blocks("docs/guides/several_bodies.md")
    exec(plugin, {})
    assert find_material("silicone").ior == pytest.approx(1.4316, abs=1e-4)
    exec(example, {})
    for line in capsys.readouterr().out.splitlines():
        traced, exact = map(float, line.split())
        assert traced == pytest.approx(exact, abs=1e-4)


NOTEBOOKS = [
    pytest.param(path, id=path.stem, marks=pytest.mark.slow if path.stem == "deformed_lens" else ())
    for path in sorted((PACKAGE_DIR.parent / "docs" / "notebooks").glob("*.ipynb"))
]


@pytest.mark.skipif(not NOTEBOOKS, reason="there is no checkout with docs")
@pytest.mark.parametrize("notebook", NOTEBOOKS)
def test_notebook_runs(notebook: Path, trained_run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import matplotlib.pyplot as plt

    monkeypatch.setenv("NERFRO_RUN", str(trained_run))
    monkeypatch.setenv("MPLBACKEND", "agg")
    monkeypatch.chdir(tmp_path)
    plt.switch_backend("agg")
    document = json.loads(notebook.read_text(encoding="utf-8"))
    assert document["nbformat"] == 4
    cells = ["".join(cell["source"]) for cell in document["cells"] if cell["cell_type"] == "code"]
    assert len(cells) > 2
    namespace: dict[str, Any] = {"__name__": "__main__"}
    for number, source in enumerate(cells):
        name = f"{notebook.name}, cell {number}"
        linecache.cache[name] = len(source), None, source.splitlines(keepends=True), name  # for tracebacks
        exec(compile(source, name, "exec"), namespace)
    assert len(plt.get_fignums()) >= 3, "it draws pictures"
    plt.close("all")

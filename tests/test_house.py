"""Every import points down: from the commands through the packages to the core, types included."""

import ast
import inspect
import math
import re
import sys
from collections import ChainMap
from collections.abc import Iterator
from dataclasses import FrozenInstanceError, fields
from itertools import pairwise
from pathlib import Path

import pytest

from nerfro.core.paths import PACKAGE_DIR, PLUGINS_DIR
from nerfro.core.provenance import AlgorithmSettings
from nerfro.registry.registration import discover
from tests.size import count_by_component, count_code_lines

# From above to below: a package imports what follows it, and itself.
ORDER = (
    "commands", "parts", "testing", "pipeline", "report", "training", "optimizers", "paper", "exports", "masks",
    "synthetic", "poses", "viewing", "evaluation", "capture", "models", "losses", "rendering", "camera", "silhouettes",
    "backgrounds", "samplers", "fields", "media", "data", "geometry", "kernels", "files", "cli", "registry", "core",
)  # fmt: skip
FILES = {
    ".".join(("nerfro", *file.relative_to(PACKAGE_DIR).with_suffix("").parts)).removesuffix(".__init__"): file
    for file in PACKAGE_DIR.rglob("*.py")
    if "_project" not in file.parts  # of a wheel
}


def imported(file: Path) -> Iterator[str]:
    """Modules of nerfro that a file imports anywhere: at its top, in functions, for type checkers."""
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names if alias.name in FILES)
        elif isinstance(node, ast.ImportFrom) and node.module in FILES:
            yield from {
                name if (name := f"{node.module}.{alias.name}") in FILES else node.module for alias in node.names
            }
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{file}: name the module from the root"


IMPORTS = {module: set(imported(file)) - {module} for module, file in FILES.items()}


def is_command(module: str) -> bool:
    return module.count(".") == 1 and 'if __name__ == "__main__"' in FILES[module].read_text(encoding="utf-8")


def room(module: str) -> str:
    """The package of a module. Top-level modules are commands, or `parts`, the front for authors of plugins.

    `nerfro` itself stands with the commands: it hands on what is for everybody, imported when it is asked for.
    """
    name = module.split(".")[1] if "." in module else "commands"
    return name if (PACKAGE_DIR / name).is_dir() or name == "parts" else "commands"


def test_top_level_has_only_commands_and_the_fronts() -> None:
    modules = {
        module for module in FILES if module.count(".") == 1 and not (PACKAGE_DIR / module.split(".")[1]).is_dir()
    }
    assert {module for module in modules if not is_command(module)} == {"nerfro.parts"}


@pytest.mark.parametrize("module", sorted(FILES))
def test_packages_import_only_lower_packages(module: str) -> None:
    below = ORDER[ORDER.index(room(module)) :]
    assert {other for other in IMPORTS[module] if room(other) not in below} == set()


def reachable(arrows: set[tuple[str, str]], start: str) -> set[str]:
    found, new = set(), {start}
    while new:
        new = {below for above, below in arrows if above in new} - found
        found |= new
    return found


def test_graph_of_the_documentation_shows_the_imports() -> None:
    page = PACKAGE_DIR.parent / "docs" / "reference" / "architecture.md"
    if not page.is_file():
        pytest.skip("there is no checkout with the documentation")
    graph = re.search(r"```mermaid\n(.*?)```", page.read_text(encoding="utf-8"), re.S)[1]
    shown = {pair for line in graph.splitlines()[1:] for pair in pairwise(line.split(" --> "))}
    shown = {(above.strip(), below.strip()) for above, below in shown}
    imports = {(room(module), room(other)) for module, others in IMPORTS.items() for other in others}
    imports = {(above, below) for above, below in imports if above != below}
    assert shown <= imports
    assert {each: reachable(shown, each) for each in ORDER} == {each: reachable(imports, each) for each in ORDER}


def test_modules_have_no_circular_imports() -> None:
    left = dict(IMPORTS)
    while free := [module for module, others in left.items() if not others & left.keys()]:
        left = {module: others for module, others in left.items() if module not in free}
    assert sorted(left) == []


def test_only_training_imports_lightning() -> None:
    users = {
        module
        for module, file in FILES.items()
        if re.search(r"^\s*(import|from) lightning", file.read_text("utf-8"), re.M)
    }
    assert {room(module) for module in users} == {"training"}


PLUGINS = {str(file.relative_to(PLUGINS_DIR)): file for file in PLUGINS_DIR.rglob("*.py")}
# Requirement that provides an imported package with another name.
PROVIDED_BY = {
    "PIL": "pillow", "annotated_types": "annotated-types",
    "flip_evaluator": "flip-evaluator", "OpenImageIO": "openimageio", "hydra": "hydra-core", "markupsafe": "jinja2",
    "omegaconf": "hydra-core", "skimage": "scikit-image", "yaml": "hydra-core",
}  # fmt: skip


def test_package_imports_only_required_dependencies() -> None:
    """Packages of extras are imported by `optional`, where they are used."""
    project = PACKAGE_DIR.parent / "pyproject.toml"
    if not project.is_file():
        pytest.skip("there is no checkout with pyproject.toml")
    block = re.search(r"^dependencies = \[\n(.*?)^\]", project.read_text(encoding="utf-8"), re.M | re.S)[1]
    required = {*re.findall(r'^  "([\w-]+)', block, re.M)}
    assert {"torch", "hydra-core"} <= required
    found = {}
    for module, file in FILES.items():
        names = set()
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Import):
                names |= {alias.name.partition(".")[0] for alias in node.names}
            elif isinstance(node, ast.ImportFrom):
                names.add(node.module.partition(".")[0])
        names -= {"nerfro", *sys.stdlib_module_names}
        found[module] = {name for name in names if PROVIDED_BY.get(name, name) not in required}
    assert {module: names for module, names in found.items() if names} == {}


def test_no_module_is_imported_by_a_string() -> None:
    """Except by the discovery of plugins, by `optional`, and by the public front."""
    users = {
        module
        for module, file in FILES.items()
        if re.search(r"\b(import_module|__import__)\(", file.read_text("utf-8"))
    }
    assert users == {"nerfro.registry.registration", "nerfro.core.errors", "nerfro.cli.entry"}


@pytest.mark.parametrize("file", sorted(PLUGINS_DIR.rglob("example_*.py")), ids=lambda file: file.stem)
def test_templates_need_one_import_of_nerfro(file: Path) -> None:
    imports = re.findall(r"^(?:from|import) nerfro[\w.]*", file.read_text(encoding="utf-8"), re.M)
    assert imports == ["from nerfro.parts"]


@pytest.mark.parametrize("module", sorted(filter(is_command, FILES)))
def test_commands_compose_call_and_print(module: str) -> None:
    assert count_code_lines(FILES[module].read_text(encoding="utf-8")) < 90
    assert {other for other in IMPORTS[module] if room(other) == "commands"} == set(), "commands share what lies below"


def test_packages_have_a_bounded_size() -> None:
    sizes = count_by_component(PACKAGE_DIR)
    assert {name: lines for name, lines in sizes.items() if lines > 3000 and name != "(top level)"} == {}


FUNCTIONS = [
    (module, node)
    for module, file in (FILES | PLUGINS).items()
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8")))
    if isinstance(node, ast.FunctionDef)
]
MAX_LINES, MAX_ARGUMENTS = 60, 8
# Objects of other libraries, which have no methods of ours.
FOREIGN = {
    "bar", "callback", "ctx", "dispatcher", "extraction", "flags", "hydra_config", "log_gain", "logger", "main",
    "mapping", "matching", "numba", "optimizer", "pairing", "parameter", "parent", "parser", "pycolmap", "reader",
    "sampled", "session", "spec", "sys", "tensor", "trained", "trainer", "hydra", "BoundedFiles",
}  # fmt: skip


def num_arguments(names: list[str]) -> int:
    """Number of arguments of a compiled function; three coordinates in a row count as one."""
    text = " ".join(names)
    vectors = re.sub(r"\b(\w*)[xi0] \1[yj1] \1[zk2]\b", "vector", text)
    return len(vectors.split())


def test_functions_fit_on_a_screen() -> None:
    """Without signature and docstring."""
    lines = {f"{module}.{node.name}": node.end_lineno - node.body[0].end_lineno for module, node in FUNCTIONS}
    assert {name: count for name, count in lines.items() if count > MAX_LINES} == {}


def test_compiled_functions_have_few_arguments() -> None:
    compiled = [
        (f"{module}.{node.name}", num_arguments([argument.arg for argument in node.args.args]))
        for module, node in FUNCTIONS
        if any(ast.unparse(mark).startswith(("compiled", "inlined")) for mark in node.decorator_list)
    ]
    assert len(compiled) > 50
    assert {name: count for name, count in compiled if count > MAX_ARGUMENTS} == {}


def written(tree: ast.AST) -> Iterator[ast.Attribute]:
    """Attributes that are assigned to."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Store):
            yield node


def outside_writes(tree: ast.AST) -> list[str]:
    """Attributes that are written by another class than their own, or by a function."""
    own = {
        (made.targets[0].id, attribute)
        for node in ast.walk(tree)
        if isinstance(node, ast.ClassDef)
        for made in ast.walk(node)
        if isinstance(made, ast.Assign) and isinstance(made.targets[0], ast.Name)
        and re.match(r"copy\.copy\(self\)|\w+\.__new__\(\w+\)", ast.unparse(made.value))
        for attribute in written(node)
    }  # fmt: skip
    return [
        ast.unparse(attribute)
        for attribute in written(tree)
        if not (isinstance(attribute.value, ast.Name) and attribute.value.id in ("self", "cls"))
        and (getattr(attribute.value, "id", None), attribute) not in own
        and not FOREIGN & set(ast.unparse(attribute).split("."))
    ]


def test_only_its_class_writes_an_attribute() -> None:
    """A class also writes attributes of copies, and of objects that it makes without their constructor."""
    files = FILES | PLUGINS
    found = {module: outside_writes(ast.parse(file.read_text(encoding="utf-8"))) for module, file in files.items()}
    assert {module: writes for module, writes in found.items() if writes} == {}
    assert outside_writes(ast.parse("def f(body):\n    body.surface = None")) == ["body.surface"]


def test_settings_of_algorithms_are_frozen_and_documented() -> None:
    import nerfro.plugins  # noqa: F401 - imports the algorithms

    discover()
    assert "HullSettings" in AlgorithmSettings.classes
    modules = [vars(sys.modules[settings.__module__]) for settings in AlgorithmSettings.classes.values()]
    names_of_settings = dict(ChainMap(*modules), inf=math.inf)
    for settings in AlgorithmSettings.classes.values():
        names = re.findall(r"^    (\w[\w, ]*):", inspect.getdoc(settings), re.M)
        assert {field.name for field in fields(settings)} == {*", ".join(names).split(", ")}, settings
        with pytest.raises(FrozenInstanceError):
            setattr(settings(), names[0].split(", ")[0], None)
        assert eval(repr(settings()), names_of_settings) == settings()

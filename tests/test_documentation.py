"""The Python code of README and guides runs, their commands have valid options, and their plugins train."""

from __future__ import annotations

import copy
import functools
import re
import shlex
from collections.abc import Callable, Iterator
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest
import torch
from hydra import compose, initialize_config_dir
from hydra.core.config_store import ConfigStore
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import DictConfig, OmegaConf

from nerfro.allowed import check_names, check_settings
from nerfro.cli import _quoted, renamed_override
from nerfro.paths import CONF_DIR, PACKAGE_DIR
from nerfro.registry import KINDS, discover, find, plugins
from nerfro.testing import check

CHECKOUT = PACKAGE_DIR.parent
PAGES = [
    str(path.relative_to(CHECKOUT))
    for path in (CHECKOUT / "README.md", *sorted((CHECKOUT / "docs").rglob("*.md")))
    if "lab" not in path.parts  # lab notes record commands of their time
]
pytestmark = pytest.mark.skipif(not (CHECKOUT / "docs").is_dir(), reason="there is no checkout with docs")


def python_blocks(page: str) -> list[str]:
    return re.findall(r"^```python\n(.*?)^```", (CHECKOUT / page).read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE)


@pytest.fixture
def guide_plugins(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, restored_registry: None) -> list[str]:
    """Register the plugins of the guide and return the rest of its code."""
    rest = []
    for block in python_blocks("docs/plugins.md"):
        file = re.match(r"# plugins/(\w+\.py)\n", block)
        if file is None:
            rest.append(block)
        else:
            (tmp_path / file[1]).write_text(block)
    monkeypatch.setenv("NERFRO_PLUGINS", str(tmp_path))
    discover()
    return rest


def test_plugins_of_the_guide_keep_their_contracts(guide_plugins: list[str]) -> None:
    for kind, name in (("sampler/points", "square_root"), ("loss", "half_transparent"), ("boundary", "horizon")):
        check(find(kind, name))
    (test,) = guide_plugins
    namespace: dict[str, Any] = {}
    exec(test, namespace)
    namespace["test_square_root_sampler"]()


def test_plugins_of_the_guide_train_where_rays_split(
    guide_plugins: list[str], train_here: Callable[..., Any], tiny_default_run: list[str], tmp_path: Path
) -> None:
    options = ("sampler/points=square_root", "+loss.half_transparent.weight=0.1", "boundary=horizon")
    finished = train_here(
        *(option for option in tiny_default_run if not option.startswith(("sampler.points", "boundary."))), *options,
        "sampler.path.branches=all", "trainer.max_steps=2", f"hydra.run.dir={tmp_path}/run",
    )  # fmt: skip
    assert finished.code == 0, finished.err
    assert "2 steps in" in finished.out


@pytest.mark.parametrize("page", ["README.md", "docs/guides/export_and_share.md"])
def test_code_that_uses_a_run_executes(
    page: str, train_here: Callable[..., Any], tiny_default_run: list[str], tmp_path: Path
) -> None:
    run = tmp_path / "run"
    assert train_here(*tiny_default_run, "trainer.max_steps=2", f"hydra.run.dir={run}").code == 0
    blocks = [block for block in python_blocks(page) if "import nerfro\n" in block]
    assert blocks
    for block in blocks:
        namespace: dict[str, Any] = {"origins": [[-2.0, 0.0, 0.0]], "directions": [[1.0, 0.0, 0.0]]}
        source = re.sub(r'"(outputs/refractive/)?RUN"', repr(str(run)), block)
        source = source.replace('"mesh.ply"', '"embedded:torus/mesh.ply"').replace(', sky="dawn.hdr"', "")
        exec(source, namespace)
        assert torch.as_tensor(namespace["bent"].directions).norm(dim=-1) == pytest.approx(1)


# The schema of each command, and options whose values are texts.
ENTRY_POINT = re.compile(r'^@entry_point\("(\w+)", (\w+).*?(?:verbatim=\((.*)\))?\)', re.MULTILINE)
COMMAND = re.compile(r"python (?:-m nerfro\.(\w+)|benchmarks/processor_time\.py)(?= |$)(.*)", re.MULTILINE)
FLAG = re.compile(r" (?:--cfg \w+|-p \S+|-m|\.\.\.)(?= |$)", re.MULTILINE)


@functools.cache
def entry_points() -> dict[str, tuple[type, tuple[str, ...]]]:
    found = {}
    for file in PACKAGE_DIR.glob("*.py"):
        for command, schema, verbatim in ENTRY_POINT.findall(file.read_text(encoding="utf-8")):
            cls = getattr(import_module(f"nerfro.{file.stem}"), schema)
            found[command] = cls, tuple(re.findall(r"\w+", verbatim))
    return found


def commands(page: str) -> Iterator[tuple[str, list[str]]]:
    """Yield the commands in the blocks of a page with their options."""
    text = (CHECKOUT / page).read_text(encoding="utf-8").replace("\\\n", " ")
    for block in re.findall(r"^```\w*\n(.*?)^```", text, re.DOTALL | re.MULTILINE):
        for command, options in COMMAND.findall(block):
            words = shlex.split(FLAG.sub("", options), comments=True)
            if command != "plugins":
                yield command or "train", words


@functools.cache
def composed(command: str, schema: type, options: tuple[str, ...]) -> DictConfig:
    """Compose the configuration of a command with options that choose members of groups."""
    ConfigStore.instance().store(name=f"{command}_schema", node=schema, provider="nerfro")
    folder = CONF_DIR if (CONF_DIR / f"{command}.yaml").is_file() else CONF_DIR / command
    with initialize_config_dir(str(folder), version_base="1.3"):
        return compose(command, list(options))


def require_valid(command: str, options: list[str]) -> None:
    """Raise an error unless a command accepts the options. Hydra composes only the choices of groups, to save time."""
    schema, verbatim = entry_points()[command]
    assert [renamed_override(option) for option in options] == options, "an old name"
    # Of a sweep the first value; no patterns, and no launchers, which may not be installed.
    options = [re.sub(r"^([^=]+=[^,[{]+),[^]}]*$", r"\1", option) for option in options if "(" not in option]
    options = [_quoted(option, verbatim) for option in options if not re.match("hydra[/.]launcher", option)]
    choices, settings = [], []
    for override in OverridesParser.create().parse_overrides(options):
        key = override.key_or_group
        is_choice = key in KINDS or (CONF_DIR / key).is_dir() or override.package or key.startswith("hydra.")
        (choices if is_choice else settings).append(override)
    config = copy.deepcopy(composed(command, schema, tuple(choice.input_line for choice in choices)))
    for setting in settings:
        OmegaConf.update(config, setting.key_or_group, setting.value(), force_add=setting.is_add())
    check_names(config)
    check_settings(config, schema)


@pytest.mark.parametrize("page", PAGES)
def test_commands_have_valid_options(page: str, guide_plugins: list[str]) -> None:
    for command, options in commands(page):
        try:
            require_valid(command, options)
        except Exception as error:
            raise AssertionError(f"{page}: python -m nerfro.{command} {shlex.join(options)}") from error


def nested_names(config: DictConfig, prefix: str = "") -> Iterator[str]:
    for key in config:
        yield f"{prefix}{key}"
        if not OmegaConf.is_missing(config, key) and isinstance(config[key], DictConfig):
            yield from nested_names(config[key], f"{prefix}{key}.")


def test_settings_in_the_text_exist() -> None:
    discover()
    known = {name for schema, _ in entry_points().values() for name in nested_names(OmegaConf.structured(schema))}
    for plugin in plugins():
        group = plugin.kind.replace("/", ".")
        known |= {f"{node}.{name}" for name, *_ in plugin.fields() for node in (group, f"{group}.{plugin.name}")}
    for page in PAGES:
        text = re.sub(r"^```.*?^```", "", (CHECKOUT / page).read_text(encoding="utf-8"), flags=re.DOTALL | re.MULTILINE)
        used = set(re.findall(r"`\+?((?!hydra|methods|scenes)[a-z_]+(?:\.[a-z0-9_]+)+)=[^`]*`", text))
        assert used - known == set(), page

"""The commands and settings in README and documentation exist."""

import contextlib
import copy
import functools
import re
import shlex
import subprocess
from collections.abc import Iterator
from dataclasses import is_dataclass
from importlib import import_module
from pathlib import Path
from typing import get_type_hints

import pytest
from hydra import compose, initialize_config_dir
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import DictConfig, OmegaConf

from nerfro.cli.calls import values_of
from nerfro.cli.composition import added, quoted
from nerfro.cli.options import Described, describe, has_groups, store_schema, usage
from nerfro.cli.overrides import full_key, is_scene_file
from nerfro.core.errors import NerfroError
from nerfro.core.paths import CONF_DIR, PACKAGE_DIR
from nerfro.registry.allowed import MissingSettingError, plain, untyped, validate
from nerfro.registry.registration import KINDS, discover, plugins
from nerfro.synthetic.scenes import SCENES
from nerfro.training.effects import settings_without_effect
from nerfro.viewing.exports import EXPORTS, find_export

CHECKOUT = PACKAGE_DIR.parent
PAGES = {
    str(file.relative_to(CHECKOUT)): file.read_text(encoding="utf-8")
    for file in (CHECKOUT / "README.md", *sorted((CHECKOUT / "docs").rglob("*.md")))
    if file.is_file() and file.parent.name != "lab"  # lab notes record the commands of their time
}
pytestmark = pytest.mark.skipif(len(PAGES) < 2, reason="there is no checkout with docs")

discover()

BLOCK = re.compile(r"^```\w*\n(.*?)^```", re.DOTALL | re.MULTILINE)
PLUGIN = re.compile(r"^```python\n# plugins/(\w+\.py)\n(.*?)^```", re.DOTALL | re.MULTILINE)
COMMAND = re.compile(
    r"(?:python |torchrun .*? |=\")(?:-m nerfro\.([a-z]+)|benchmarks/processor_time\.py)(?= |$)(.*)", re.MULTILINE
)
JOB_FILE = re.compile(r"^```bash\n(.*?)^```", re.DOTALL | re.MULTILINE)
FLAG = re.compile(r" (?:--cfg \w+|-p \S+|-m|\.\.\.)(?= |$)", re.MULTILINE)
ENTRY_POINT = re.compile(r'^@entry_point\("(\w+)", (\w+)', re.MULTILINE)


@functools.cache
def entry_points() -> dict[str, tuple[type, tuple[str, ...]]]:
    """The schema of each command, and its options that are texts: the options of stages."""
    found = {}
    for file in PACKAGE_DIR.glob("*.py"):
        for command, schema in ENTRY_POINT.findall(file.read_text(encoding="utf-8")):
            module = import_module(f"nerfro.{file.stem}")
            found[command] = getattr(module, schema), tuple(getattr(module, "STAGES", ()))
    return found


def commands(page: str) -> Iterator[tuple[str, list[str]]]:
    """Yield the commands in the blocks of a page with their options."""
    for block in BLOCK.findall(PAGES[page].replace("\\\n", " ")):
        for command, options in COMMAND.findall(block):
            options = options.rstrip('"') if options.count('"') % 2 else options
            if command not in ("check", "plugins"):
                yield command or "train", shlex.split(FLAG.sub("", options), comments=True)


@functools.cache
def described(command: str, num_plugins: int) -> Described:
    """Describe the options of a command; with another number of plugins, again."""
    return describe(command, entry_points()[command][0])


@functools.cache
def composed(command: str, choices: tuple[str, ...]) -> DictConfig:
    """Compose the configuration of a command with options that choose members of groups."""
    store_schema(command, entry_points()[command][0])
    with initialize_config_dir(str(CONF_DIR), version_base="1.3"):
        return compose(command, list(choices))


def require_valid(command: str, options: list[str]) -> None:
    """Raise an error unless a command accepts the options. Hydra composes only the choices of groups, to save time."""
    schema, verbatim = entry_points()[command]
    options = [option for option in options if not is_scene_file(option)]
    options = [full_key(option) for option in options]
    # Of a sweep the first value; no patterns, and no options of Hydra, whose launchers may not be installed.
    options = [re.sub(r"^([^=]+=[^,[{]+),[^]}]*$", r"\1", option) for option in options if "(" not in option]
    options = [quoted(option, verbatim) for option in options if not option.lstrip("+").startswith("hydra")]
    described(command, len(plugins())).require_known(options)
    if not has_groups(command):
        with contextlib.suppress(MissingSettingError):
            parsed = validate(schema, values_of(options))
            if command == "export":
                find_export(parsed.what, Path(parsed.out))
        return
    options = list(map(added, options)) if command == "train" else options
    choices, settings = [], []
    for override in OverridesParser.create().parse_overrides(options):
        key = override.key_or_group
        is_choice = key in KINDS or (CONF_DIR / key).is_dir() or override.package
        (choices if is_choice else settings).append(override)
    config = copy.deepcopy(composed(command, tuple(str(choice.input_line) for choice in choices)))
    for setting in settings:
        OmegaConf.update(config, setting.key_or_group, setting.value(), force_add=setting.is_add())
    with contextlib.suppress(MissingSettingError):
        validate(schema, plain(config))
    if command == "train":
        assert settings_without_effect(config, options) == []


@pytest.fixture
def documented_plugins(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, restored_registry: None) -> None:
    """Register the plugins that the pages define."""
    for text in PAGES.values():
        for name, source in PLUGIN.findall(text):
            (tmp_path / name).write_text(source)
    monkeypatch.setenv("NERFRO_PLUGINS", str(tmp_path))
    discover()


@pytest.mark.usefixtures("documented_plugins")
def test_commands_have_valid_options() -> None:
    for page in PAGES:
        for command, options in commands(page):
            try:
                require_valid(command, options)
            except Exception as error:
                raise AssertionError(f"{page}: python -m nerfro.{command} {shlex.join(options)}") from error


def test_job_files_are_scripts() -> None:
    files = [file for text in PAGES.values() for file in JOB_FILE.findall(text)]
    assert files
    for file in files:
        checked = subprocess.run(["bash", "-n"], input=file, capture_output=True, text=True)
        assert checked.stderr == "", file


def test_help_lists_plugins() -> None:
    names: dict[str, list[str]] = {"export": list(EXPORTS), "synthesize": list(SCENES)}
    names["train"] = [plugin.name for plugin in plugins()]
    names["trace"] = [plugin.name for kind in ("medium", "surface", "sampler/path") for plugin in plugins(kind)]
    for command, plugin_names in names.items():
        page = described(command, len(plugins()))
        assert set(plugin_names) <= set(re.findall(r"\w+", page.help)), command
    with pytest.raises(NerfroError, match=r"write \+loss\.opaque\.weight=0\.1"):
        described("train", len(plugins())).require_known(["loss=opaque"])


@pytest.mark.parametrize("command", sorted(entry_points()))
def test_help_has_two_valid_examples_and_explains_every_option(command: str) -> None:
    examples = re.findall(rf"^    nerfro {command}\b(.*)$", usage(command), re.MULTILINE)
    assert len(examples) == 2
    for options in examples:
        require_valid(command, shlex.split(options))
    page, schema = described(command, len(plugins())), entry_points()[command][0]
    settings = re.findall(r"^  ([\w.]+)=.*(?:\n {4}\S.*)*\n( {6}\S)?", page.help, re.MULTILINE)
    assert [name for name, explanation in settings if not explanation and name not in page.choices] == []
    leaves = {name for name, hint in get_type_hints(schema).items() if not is_dataclass(hint)}
    assert leaves <= {name.split(".")[0] for name, _ in settings}


def nested_names(config: DictConfig, prefix: str = "") -> Iterator[str]:
    for key in config:
        yield f"{prefix}{key}"
        if not OmegaConf.is_missing(config, key) and isinstance(config[key], DictConfig):
            yield from nested_names(config[key], f"{prefix}{key}.")


@pytest.mark.usefixtures("documented_plugins")
def test_settings_in_the_text_exist() -> None:
    known = {
        name for schema, _ in entry_points().values() for name in nested_names(OmegaConf.structured(untyped(schema())))
    }
    for plugin in plugins():
        group = plugin.kind.replace("/", ".")
        known |= {f"{node}.{name}" for name, *_ in plugin.fields() for node in (group, f"{group}.{plugin.name}")}
    for page, text in PAGES.items():
        # The keys of `methods` and `scenes` are the user's.
        used = set(re.findall(r"`\+?((?!hydra|methods|scenes)[a-z_]+(?:\.[a-z0-9_]+)+)=[^`]*`", BLOCK.sub("", text)))
        assert used - known == set(), page

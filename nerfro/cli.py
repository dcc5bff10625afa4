"""Functions that all commands share: composition of the configuration, and errors in one line."""

from __future__ import annotations

import contextlib
import copy
import dataclasses
import errno
import functools
import importlib
import io
import os
import re
import shlex
import sys
import tempfile
import traceback
from collections.abc import Callable, Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NoReturn, cast

import hydra
import hydra._internal.hydra
import yaml
from hydra._internal.core_plugins.file_config_source import FileConfigSource
from hydra._internal.sources_registry import SourcesRegistry
from hydra._internal.utils import get_args_parser
from hydra.core.config_search_path import ConfigSearchPath
from hydra.core.config_store import ConfigStore
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException, OverrideParseException
from hydra.plugins.config_source import ConfigResult
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf, flag_override
from omegaconf.errors import ConfigAttributeError, ConfigKeyError, MissingMandatoryValue, OmegaConfBaseException

from nerfro.allowed import check_names, check_settings
from nerfro.errors import NerfroError, nearest_of
from nerfro.options import ADDED_GROUPS, Described, describe_command, recall, remember, usage
from nerfro.overrides import is_scene_file
from nerfro.paths import CONF_DIR, refuse_root, user_path
from nerfro.registry import MOVED_CLASSES, SEVERAL, discover, plugins
from nerfro.trust import MAX_YAML_CHARACTERS, GuardedConfigLoader, leave_current_directory, require_bounded_yaml

_HELP = {"-h", "--help"}
_NO_MEMORY = re.compile("allocate memory|out of memory")  # messages of torch on a CPU and on a GPU
_LONGEST_LINE = 1000  # characters of an error; the middle of longer ones is left out
# Options of Hydra that the extras of nerfro install.
_EXTRAS = {
    "hydra/launcher/joblib": "launchers",
    "hydra/launcher/submitit": "launchers",  # submitit_local and submitit_slurm
    "hydra/launcher/ray": "ray",
    "hydra/sweeper/optuna": "optuna",
}
EXIT_INTERRUPTED = 130
EXIT_BROKEN_PIPE = 141  # exit status of a program that SIGPIPE has ended, in a shell

# Old spellings of configuration keys and of options, which work for one release with a warning. Add one line for each
# name that you change; command lines, YAML files of users, run folders and checkpoints then follow. Three forms:
#   "batches.hold_back": "batches.num_validation_views"   a setting or a node with all settings below it
#   "loss=nearby": "near_camera"                          an option of a group (`experiment=NAME` is one, too)
#   "medium.learn_surface": None                          a removed setting: refused on the command line and in
#                                                         YAML files, dropped from the configurations of old runs
#   "medium[SdfGrid].smoothing_size": None                the same in old runs for one class, where others keep it
RENAMED: dict[str, str | None] = {
    "camera.hold_world": "camera.fix_gauge",
    "loss=nearby": "near_camera",
    "loss.nearby": "loss.near_camera",
    "batches.hold_back": "batches.num_validation_views",
    "batches.object": "batches.object_fraction",
    "camera.start": "phase.cameras.start",
    "camera.every": "phase.cameras.every",
    "camera.num_pixels": "phase.cameras.num_pixels",
    "optimizer.boundary_first": "phase.background.steps",
    "optimizer.boundary_steps": "phase.background.steps",
    "optimizer.tint_learning_rate": "optimizer.groups[bodies.*.material.absorption].learning_rate",
    "optimizer.absorption_learning_rate": "optimizer.groups[bodies.*.material.absorption].learning_rate",
    "optimizer.boundary_learning_rate": "optimizer.groups[background.*].learning_rate",
    "optimizer.boundary_start": "optimizer.groups[background.*].start",
    "optimizer.exposure_learning_rate": "optimizer.groups[cameras.exposure].learning_rate",
    "optimizer.medium_learning_rate": "optimizer.groups[bodies.*.material.ior].learning_rate",
    "optimizer.medium_start": "optimizer.groups[bodies.*.material.ior].start",
    "medium.learn_surface": None,
    "optimizer.surface_learning_rate": None,
    "optimizer.surface_start": None,
    "search": None,
    "labels": None,  # of render
    "lpips_backbone": None,  # of evaluate
    "lpips_vgg_backbone": None,
    "evaluation.lpips_backbone": None,
    "evaluation.lpips_vgg_backbone": None,
    "batches.supersample": "batches.subdivision.side",
    "batches.divergence": "batches.subdivision.divergence",
    "batches.contrast": "batches.subdivision.contrast",
    "batches.contrast_start": "batches.subdivision.contrast_start",
    "evaluation.supersample": "evaluation.subdivision.side",
    "evaluation.divergence": "evaluation.subdivision.divergence",
    "evaluation.contrast": "evaluation.subdivision.contrast",
    "supersample": "subdivision.side",  # of evaluate and render
    "divergence": "subdivision.divergence",
    "contrast": "subdivision.contrast",
    "sampler.points.every": "sampler.points.update_every",
    "sampler.points.looks": "sampler.points.update_fraction",
    "sampler.points.trust": "sampler.points.max_bin_alpha",
    "sampler.points.num_shown": "sampler.points.num_samples_evaluation",
    "boundary.direction_degree": None,
    "content.box_file": None,
    "field.base_resolution": None,
    "field.direction_degree": None,
    "field.normalise": None,
    "loss.boundary.threshold": None,
    "loss.total_variation.num_directions": None,
    "medium.crease_degrees": None,
    "medium.grid": None,
    "medium.half_width": None,
    "medium.subsamples": None,
    "medium[SdfGrid].smoothing_sigma": None,
    "medium[SdfGrid].smoothing_size": None,
}
_STAGES: dict[str, Callable[[], None]] = {}  # start of each imported command as a part of another command
# Short names of settings, on the command line and in YAML files.
SHORT_NAMES = {"bodies": "medium.bodies"}


def entry_point(
    config_name: str,
    schema: type,
    config_dir: Path = CONF_DIR,
    verbatim: tuple[str, ...] = (),
    check: Callable[[DictConfig], None] | None = None,
    expand: Callable[[list[str], list[str]], list[str]] | None = None,
) -> Callable[[Callable[[DictConfig], float | None]], Callable[[], None]]:
    """Decorate the main function of a command, which receives a checked configuration.

    The defaults list of the YAML file must begin with `<config_name>_schema`. Otherwise Hydra does not refuse misspelt
    keys of the root.

    Args:
        config_name: name of the YAML file in `config_dir`, without extension.
        schema: dataclass of the root.
        config_dir: conf/, or a folder in it for a command that must not see the groups of conf/.
        verbatim: keys whose values are texts that may contain commas and equals signs, which Hydra would parse.
        check: further check of the configuration.
        expand: function that replaces arguments that stand for several settings; it also receives the names of the
            settings of the root.
    """

    def decorate(task: Callable[[DictConfig], float | None]) -> Callable[[], None]:
        def check_all(config: DictConfig) -> None:
            with _missing_with_example(config_name):
                check_configuration(config, schema, config_dir)
                if check is not None:
                    check(config)

        def start() -> None:
            failures: list[Exception] = []

            @functools.wraps(task)
            def job(config: DictConfig) -> float | None:
                if HydraConfig.get().mode != RunMode.MULTIRUN:
                    try:
                        with _missing_with_example(config_name):
                            return task(config)
                    except Exception as error:  # raised later, because Hydra prints an additional line for it
                        failures.append(error)
                        return None
                return _job_of_sweep(task, config)

            # Otherwise Hydra prints its own report and exits.
            os.environ["HYDRA_FULL_ERROR"] = "1"
            with _composed_with(check_all):
                if _HELP & set(sys.argv) and "hydra" in sys.argv:
                    sys.argv[1:] = ["--hydra-help"]
                sys.argv[1:] = _flags_first(sys.argv[1:])
                ConfigStore.instance().store(name=f"{config_name}_schema", node=schema, provider="nerfro")
                SourcesRegistry.instance().types["file"] = _RenamingFiles
                leave_current_directory()
                discover()
                if _HELP & set(sys.argv) or (program() == config_name and recall(config_name) is None):
                    described = describe_command(config_name, schema, config_dir)
                    remember(config_name, described)
                    answer(described, sys.argv[1:])
                sys.argv[1:] = [_quoted(renamed_override(argument), verbatim) for argument in sys.argv[1:]]
                if expand is not None:
                    sys.argv[1:] = expand(sys.argv[1:], [field.name for field in dataclasses.fields(schema)])
                if config_name == "train":
                    sys.argv[1:] = map(_added, sys.argv[1:])
                with _run_folder():
                    hydra.main(version_base="1.3", config_path=str(config_dir), config_name=config_name)(job)()
            if failures:
                raise failures[0]

        @functools.wraps(task)
        def run() -> None:
            with errors_in_one_line():
                start()

        _STAGES[config_name] = start
        return run

    return decorate


def call(command: str, arguments: list[str]) -> None:
    """Run a command as a part of this program. Meanwhile it is the main program for records and for Lightning.

    Args:
        command: name of the command.
        arguments: its command line.

    Raises:
        Exception: any error of the command.
    """
    importlib.import_module(f"nerfro.{command}")
    program, main, composed = sys.argv, sys.modules["__main__"], GlobalHydra.instance()
    spec, outer = main.__spec__, composed.hydra
    sys.argv, main.__spec__, composed.hydra = [command, *arguments], find_spec(f"nerfro.{command}"), None
    try:
        _STAGES[command]()
    finally:
        sys.argv, main.__spec__, composed.hydra = program, spec, outer


def _job_of_sweep(task: Callable[[DictConfig], float | None], config: DictConfig) -> float | None:
    discover()  # the process may be a launcher's worker
    try:
        return task(config)
    except Exception as error:  # Hydra's sweepers continue with the other jobs
        if os.environ.get("NERFRO_DEBUG"):
            raise
        line = f"{Path(HydraConfig.get().runtime.output_dir).name}: {in_one_line(error)}"
        print(f"nerfro: error: {line}", file=sys.stderr, flush=True)
        raise NerfroError(line) from None


@contextlib.contextmanager
def _run_folder() -> Iterator[None]:
    """Convert errors of Hydra, which creates the run folder, to one line."""
    try:
        yield
    except OSError as error:
        if isinstance(error, (HydraException, BrokenPipeError)):
            raise
        reason = f"{error.filename or 'the folder'} cannot be used: {error.strerror}"
        raise NerfroError(f"{reason}; choose another hydra.run.dir, or hydra.sweep.dir") from error
    except ValueError as error:
        if "null byte" not in str(error):
            raise
        raise NerfroError("the name of a folder contains a null byte; choose another hydra.run.dir") from error


@contextlib.contextmanager
def _missing_with_example(command: str) -> Iterator[None]:
    """Show an example of the command if a required option is missing."""
    try:
        yield
    except MissingMandatoryValue as error:
        example = usage(command).partition("Examples:\n")[2].partition("\n")[0].strip()
        raise NerfroError(f"{error.full_key}=... is missing; for example: {example}") from error


def print_version() -> None:
    """Print the version of nerfro."""
    print(f"nerfro {importlib.import_module('nerfro').__version__}")


def program() -> str | None:
    """Return the name of the command of this process, such as `train`; None for other programs."""
    spec = getattr(sys.modules["__main__"], "__spec__", None)
    package, _, name = ("" if spec is None else spec.name).partition(".")
    return name if package == "nerfro" else None


def check_configuration(config: DictConfig, schema: type, config_dir: Path) -> None:
    """Refuse names and values of settings that are invalid for the dataclass of a command.

    Raises:
        NerfroError: a setting is not allowed.
    """
    check_names(config, groups=[path.name for path in config_dir.iterdir() if path.is_dir()])
    check_settings(config, schema)


def _flags_first(arguments: list[str]) -> list[str]:
    """Move Hydra's flags before the overrides, because its parser accepts no overrides after a flag among them."""
    parser = get_args_parser()
    parser.error = _refuse_flag  # type: ignore[method-assign]  # argparse prints its usage before the message
    known, others = parser.parse_known_args(arguments)
    flag = next((text for text in others if text.startswith("-")), None)
    if flag is not None:
        raise NerfroError(f"{flag} is not an option; write key=value, or see --help")
    if (known.resolve or known.package) and not known.cfg:
        raise NerfroError("--resolve and --package need --cfg; write --cfg job --resolve to print the resolved values")
    if known.experimental_rerun is not None:
        raise NerfroError("--experimental-rerun executes code of the file that it reads; use config.yaml of the run")
    overrides = [*known.overrides, *others]
    return [text for text in arguments if text not in overrides] + overrides


def answer(described: Described, arguments: list[str]) -> None:
    """Print the help on request, or refuse misspelt names.

    Raises:
        NerfroError: a setting or an option does not exist.
    """
    if _HELP & set(arguments) and "hydra" not in arguments:
        print(described.help)
        sys.exit()
    unknown = any(argument.startswith(("--config", "-c", "hydra.searchpath")) for argument in arguments)
    if not unknown:  # other folders of configurations may have other groups
        current = [text for text in arguments if not any(f"{text.lstrip('+~')}.".startswith(old) for old in RENAMED)]
        if {"data", "medium"} & {*described.names[""]}:
            current = [text for text in current if not is_scene_file(text)]
        described.require_known([_full_key(text) for text in current])


def _refuse_flag(message: str) -> NoReturn:
    raise NerfroError(f"{message}; --help hydra lists the flags")


@contextlib.contextmanager
def errors_in_one_line() -> Iterator[None]:
    """Print any error in one line and exit with status 1. With NERFRO_DEBUG=1 the error is raised instead."""
    _accept_all_text()
    try:
        yield
        sys.stdout.flush()
    except BrokenPipeError:  # the reader has closed the pipe, as in `| head`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # for the flush at exit
        sys.exit(EXIT_BROKEN_PIPE)
    except KeyboardInterrupt as interruption:
        print(f"nerfro: interrupted{f'; {interruption}' if str(interruption) else ''}", file=sys.stderr)
        sys.exit(EXIT_INTERRUPTED)
    except Exception as error:
        if os.environ.get("NERFRO_DEBUG"):
            raise
        print(f"nerfro: error: {in_one_line(error)}", file=sys.stderr)
        sys.exit(1)


def _accept_all_text() -> None:
    """Replace characters that the encoding of the terminal lacks, and discard text for closed streams (`>&-`)."""
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        if stream is None:
            setattr(sys, name, open(os.devnull, "w"))  # noqa: SIM115 - open until the process ends
        elif isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")


def in_one_line(error: Exception) -> str:
    """Describe an error for the user: a mistake in the input, a missing resource, or a bug of nerfro."""
    return _in_one_line(_description(error))


def _in_one_line(text: str) -> str:
    """Escape control characters, which names of files may contain, and shorten a line with long values of a file."""
    line = re.sub(r"[\x00-\x1f\x7f]", lambda character: repr(character[0])[1:-1], text)
    return line if len(line) <= _LONGEST_LINE else f"{line[: _LONGEST_LINE // 2]} ... {line[-_LONGEST_LINE // 4 :]}"


def _description(error: Exception) -> str:
    if isinstance(error, NerfroError):
        return str(error)
    if isinstance(error, OverrideParseException):
        return _not_parsed(error.override)
    if isinstance(error, yaml.YAMLError):
        return " ".join(str(error).split())
    if isinstance(error, MemoryError) or (isinstance(error, RuntimeError) and _NO_MEMORY.search(str(error))):
        reason = " ".join(str(error).split("\n")[0].split())
        return f"not enough memory{reason and f' ({reason})'}; take smaller sizes, such as batches.size"
    setting = re.search(r"full_key: (\S+)", str(error)) if isinstance(error, OverflowError) else None
    if setting is not None:  # OmegaConf, about an integer of hundreds of digits
        return f"{setting[1]} is too large; take a number that a float can hold"
    if isinstance(error, (HydraException, OmegaConfBaseException)):
        message = " ".join(_messages(error))
        extras = [extra for option, extra in _EXTRAS.items() if f"Could not find '{option}" in message]
        return f"{message}; pip install 'nerfro[{extras[0]}]' adds it" if extras else message
    # Hydra refuses a group without an option (field=null), and flags together, by a ValueError.
    if isinstance(error, ValueError) and any(place[0].startswith("hydra.") for place in _places(error)[-1:]):
        return f"{error}; give the name of an option, as in field=nerf, and see --help for the flags"
    if type(error).__module__.partition(".")[0] in ("joblib", "ray", "submitit"):  # for example if a worker was killed
        reason = str(error).strip().split("\n")[0].rstrip(".")
        return f"{reason} ({type(error).__name__}); repeat the command to continue the sweep"
    if isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT):
        return f"no space is left for {error.filename or 'a file'}; free some, or write to another folder"
    if isinstance(error, OSError) and error.errno is not None:
        return f"{error.strerror or error}{f': {error.filename}' if error.filename else ''}"
    return _unforeseen(error)


def _places(error: Exception) -> list[tuple[str, str, int]]:
    """Return module, file and line of each frame of a traceback."""
    frames = traceback.walk_tb(error.__traceback__)
    return [(frame.f_globals.get("__name__", ""), frame.f_code.co_filename, line) for frame, line in frames]


def _unforeseen(error: Exception) -> str:
    """Write the traceback of a bug to a file and return a message with the name of the file."""
    what = f"{type(error).__name__}: {error}".splitlines()[0]
    foreign = {plugin.cls.__module__ for plugin in plugins()}
    place = next((place for place in reversed(_places(error)) if place[0] in foreign), None)
    if place is not None and not place[0].startswith("nerfro."):
        return f"{what}; raised in the plugin {place[1]}, line {place[2]} (NERFRO_DEBUG=1 shows the traceback)"
    try:
        with tempfile.NamedTemporaryFile("w", prefix="nerfro_", suffix=".txt", delete=False) as file:
            print(shlex.join(sys.argv), file=file)
            traceback.print_exception(error, file=file)
        where = f"please report it with {file.name}, which has the traceback"
    except OSError:
        where = "please report it with its traceback"
    return f"{what}; this is a bug of nerfro: {where} (NERFRO_DEBUG=1 shows it)"


def _quoted(argument: str, keys: tuple[str, ...]) -> str:
    """Quote the value of an override if its key is one of `keys`."""
    key, _, value = argument.partition("=")
    if key not in keys or not set(",=") & set(value) or value[0] in "\"'":
        return argument
    return f"{key}='{value}'"


def _added(argument: str) -> str:
    """Add the plus sign with which Hydra selects an option of a group without a default, as in `experiment=glass`."""
    return f"+{argument}" if argument.partition("=")[0] in ADDED_GROUPS else argument


def _not_parsed(override: str) -> str:
    """Describe an override that Hydra cannot parse."""
    key, equals, value = override.partition("=")
    if not equals or not key:
        return f"{override} is not an option; write key=value"
    quoted = value if value[:1] in "\"'" else '"' + value.replace('"', '\\"') + '"'
    return f"{override} cannot be read; quote the value for Hydra and for the shell: {shlex.quote(f'{key}={quoted}')}"


def _messages(error: BaseException) -> list[str]:
    """Return the lines of an error and of its cause, because Hydra names the wrong key only in the cause."""
    lines = [line.strip() for line in str(error).partition("Config search path")[0].splitlines() if line.strip()]
    cause = error.__cause__ or error.__context__ or error
    if not isinstance(cause, OmegaConfBaseException):
        return lines
    schema = cause.object_type
    names = schema.__dataclass_fields__ if dataclasses.is_dataclass(schema) else cause.parent_node
    if isinstance(cause, (ConfigKeyError, ConfigAttributeError)) and names is not None:
        where = [f"{lines[0].partition(':')[0]}:"] if lines[0].startswith("In '") else []
        key, nearest = str(cause.full_key), nearest_of(str(cause.key), list(map(str, names)))
        return [*where, _unselected(key) or f"{key} is not a setting; {nearest}"]
    return lines + [line.strip() for line in str(cause).splitlines() if line.strip() and line.strip() not in lines]


def _unselected(key: str) -> str | None:
    """Explain how to add a missing loss or callback to the experiment; None for other settings."""
    kind, name, option = [*key.split("."), "", ""][:3]
    plugin = next((plugin for plugin in plugins() if (plugin.kind, plugin.name) == (kind, name)), None)
    if plugin is None or kind not in SEVERAL or (option and option not in plugin.setting_names):
        return None
    if kind != "callbacks":
        setting = option or {"loss": "weight"}.get(kind, "SETTING")
        return f"the experiment does not set {key}; write +{kind}.{name}.{setting}=..., with a plus sign"
    return f"callbacks.{name} is not selected; add +callbacks={name}"


def renamed_override(override: str) -> str:
    """Replace old names in a command-line override, with a warning for each.

    Raises:
        NerfroError: the setting is gone.
    """
    prefix, key, equals, value = cast(
        re.Match, re.fullmatch(r"(~|\+*)([^=]*)(=?)(.*)", _full_key(override), re.DOTALL)
    ).groups()
    group, at, package = key.partition("@")
    new_value = re.sub(r"\w+", lambda name: _renamed_option(group, name[0]), value)
    new_package = _renamed_key(package if at else key)
    if new_package is None:
        raise NerfroError(_gone(key))
    renamed = f"{prefix}{group + at if at else ''}{new_package}{equals}{new_value}"
    # Hydra reads names with dots only inside of a mapping and without quotes, and adds them only with a plus sign.
    renamed = re.sub(r"(optimizer\.groups)\[(.+)\]\.(\w+)=(.*)", r"\1={\2: {\3: \4}}", renamed)
    return f"+{renamed}".replace('"', "") if renamed.startswith("optimizer.groups=") else renamed


def renamed_config(config: DictConfig, origin: Path) -> DictConfig:
    """Replace old names in the configuration of an old run, with one warning, and drop removed settings."""
    found = [f"{old} is called {new}" for old, new in RENAMED.items() if _move(config, old, new) and new]
    for name in ("data", "field", "model"):
        node = OmegaConf.select(config, name)
        if isinstance(node, DictConfig) and str(node.get("_target_")) in MOVED_CLASSES:
            node._target_ = MOVED_CLASSES[node._target_]
    if found:
        warn(f"{origin} has old names of settings, which can be read for one more release: {', '.join(found)}")
    return config


@contextlib.contextmanager
def _composed_with(check: Callable[[DictConfig], None]) -> Iterator[None]:
    """Let Hydra compose configurations with the checks of a command."""
    before = hydra._internal.hydra.ConfigLoaderImpl
    hydra._internal.hydra.ConfigLoaderImpl = functools.partial(_ConfigLoader, check)  # type: ignore[misc, assignment]
    try:
        yield
    finally:
        hydra._internal.hydra.ConfigLoaderImpl = before  # type: ignore[misc]


class _ConfigLoader(GuardedConfigLoader):
    """Composition of a configuration, also of each job of a sweep, with the checks of the command.

    Launchers hand the object to their workers.
    """

    def __init__(self, check_job: Callable[[DictConfig], None], config_search_path: ConfigSearchPath) -> None:
        super().__init__(config_search_path)
        self._check_job = check_job

    def load_configuration(
        self, config_name: str | None, overrides: list[str], run_mode: RunMode, *others: Any, **options: Any
    ) -> DictConfig:
        config = super().load_configuration(config_name, overrides, run_mode, *others, **options)
        folder = config.hydra.sweep._get_node("dir")._value()  # not resolved, as in ${now:%Y}
        if run_mode == RunMode.MULTIRUN and isinstance(folder, str):
            refuse_root(user_path(folder), "hydra.sweep.dir")
        return config

    def check(self, config: DictConfig) -> None:
        discover()  # the process may be a launcher's worker
        # Hydra adds the group `env`, and the options of plugins of other packages are theirs to check.
        check_names(config.hydra, "hydra.", also=["env", "sweeper", "launcher"])
        job, hydra_config = copy.deepcopy(config), HydraConfig.instance()
        before = hydra_config.cfg
        try:
            hydra_config.set_config(job)  # for interpolations such as ${hydra:runtime.cwd}
            with flag_override(job.hydra, "readonly", False):
                # Stands for the folder of the job, which Hydra chooses later.
                job.hydra.runtime.output_dir = job.hydra.run.dir
            with flag_override(job, ["struct", "readonly"], False):
                del job["hydra"]
            self._check_job(job)
        finally:
            hydra_config.cfg = before

    def load_sweep_config(self, master_config: DictConfig, sweep_overrides: list[str]) -> DictConfig:
        """Compose the configuration of a job; its `hydra.job.override_dirname` names what differs between jobs."""
        overrides = [renamed_override(override) for override in sweep_overrides]
        config = super().load_sweep_config(master_config, overrides)
        excluded = config.hydra.job.config.override_dirname.exclude_keys
        task = cast(list[str], OmegaConf.to_container(master_config.hydra.overrides.task, resolve=False))
        given = OverridesParser.create().parse_overrides(task)
        # As sweepers write them: `debug=true` becomes `debug=True`.
        common = {f"{o.get_key_element()}={o.get_value_element_as_str()}" for o in given if not o.is_sweep_override()}
        swept = (override.partition("=") for override in overrides if override not in common)
        parts = [f"-{key.lstrip('+').rpartition('.')[2]}={value}" for key, _, value in swept if key not in excluded]
        config.hydra.job.override_dirname = re.sub(r"[^\w.=+-]+", "_", "".join(parts)).rstrip("_")
        return config


class _RenamingFiles(FileConfigSource):
    """Hydra's source of YAML files, with old names replaced."""

    def load_config(self, config_path: str) -> ConfigResult:
        file = Path(self.path, self._normalize_file_name(config_path))
        if file.is_file() and not file.is_relative_to(CONF_DIR):
            try:
                with file.open(encoding="utf-8") as stream:
                    require_bounded_yaml(stream.read(MAX_YAML_CHARACTERS + 1), file)
            except UnicodeDecodeError as error:
                raise NerfroError(f"{file} is not a text in UTF-8; save it again with this encoding") from error
        result = super().load_config(config_path)
        group = config_path.rpartition("/")[0]
        package = result.header.get("package") or group.replace("/", ".")
        config = cast(DictConfig, result.config)
        inside = "" if package == "_global_" else f"{package}."
        for old, new in RENAMED.items():
            is_here = old.startswith(inside) and (new is None or new.startswith(inside))
            if is_here and _move(config, old.removeprefix(inside), new and new.removeprefix(inside)):
                if new is None:
                    raise NerfroError(f"{config_path}.yaml: {_gone(old)}")
                warn(f"{config_path}.yaml: {_since(old, new)}")
        for short, full in SHORT_NAMES.items():
            if package in ("", "_global_"):
                _move(config, short, full)
        if "defaults" in config:
            config.defaults = [_renamed_default(group, entry) for entry in config.defaults]
        return result


_RenamingFiles.__name__ = FileConfigSource.__name__  # Hydra allows one class for each scheme, and compares their names


def _renamed_default(group: str, entry: object) -> object:
    """Replace old names in one entry of a defaults list."""
    if isinstance(entry, str):
        return _renamed_option(group, entry)
    if not isinstance(entry, DictConfig):
        return entry
    ((key, option),) = entry.items()
    *_, place = str(key).split()  # after `override` and `optional`
    name, at, package = place.removeprefix("/").partition("@")
    new_place = f"{place[: len(place) - len(package)]}{_renamed_key(package)}" if at else place
    new_option = _renamed_option(name, option) if isinstance(option, str) else option
    return {f"{str(key).removesuffix(place)}{new_place}": new_option}


def _renamed_option(group: str, name: str) -> str:
    new = RENAMED.get(f"{group}={name}")
    if new is None:
        return name
    warn(_since(f"{group}={name}", f"{group}={new}"))
    return new


def _renamed_key(key: str) -> str | None:
    for old, new in RENAMED.items():
        if key == old or key.startswith(f"{old}."):
            if new is not None:
                warn(_since(old, new))
            return new and new + key.removeprefix(old)
    return key


def _move(config: DictConfig, old: str, new: str | None) -> bool:
    """Move a node of a configuration to its new place, or drop it; returns whether the node exists."""
    parent, _, name = old.rpartition(".")
    parent, _, owner = parent.rstrip("]").partition("[")
    node = OmegaConf.select(config, parent) if parent else config
    if not isinstance(node, DictConfig) or name not in node or not str(node.get("_target_", "")).endswith(owner):
        return False
    value = node._get_node(name)
    del node[name]
    if new is not None:
        OmegaConf.update(config, new, value, force_add=True)
    return True


def _full_key(override: str) -> str:
    """Replace the short name of a setting by the full one."""
    return re.sub(r"^([+~]*)(\w+)(?=[.=])", lambda key: key[1] + SHORT_NAMES.get(key[2], key[2]), override)


def _since(old: str, new: str) -> str:
    return f"{old} is called {new} since this release; the old name works until the next one"


def _gone(old: str) -> str:
    return f"{old} was removed in this release; leave it out (CHANGELOG.md says what to use instead)"


def warn(message: str) -> None:
    """Print a warning about an allowed but suspicious input or result."""
    print(f"nerfro: warning: {_in_one_line(message)}")

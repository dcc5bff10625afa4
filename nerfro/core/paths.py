"""Paths of configuration, local plugins and embedded data, in a checkout and in an installed wheel."""

import os
from pathlib import Path

from nerfro.core.errors import NerfroError

PACKAGE_DIR = Path(__file__).resolve().parent.parent
ASSETS_DIR = PACKAGE_DIR / "assets"

# A wheel contains conf/ and plugins/ inside the package (see pyproject.toml), a checkout beside the package.
_PROJECT_DIR = PACKAGE_DIR / "_project" if (PACKAGE_DIR / "_project").is_dir() else PACKAGE_DIR.parent
CONF_DIR = _PROJECT_DIR / "conf"
PLUGINS_DIR = CONF_DIR.parent / "plugins"
PLUGINS_PACKAGE = "nerfro_plugins"  # Python package with the modules of this folder

EMBEDDED_PREFIX = "embedded:"


def resolve_path(location: str | Path) -> Path:
    """Convert a location to a path; `embedded:torus/mesh.ply` is a file in the data that nerfro includes."""
    location = str(location)
    if not location.startswith(EMBEDDED_PREFIX):
        return user_path(location)
    name = location.removeprefix(EMBEDDED_PREFIX)
    scenes = sorted(path.name for path in ASSETS_DIR.iterdir() if path.is_dir() and not path.name.startswith("_"))
    if not set(Path(name).parts[:1]) & set(scenes):
        raise NerfroError(
            f"'{location}' is not embedded; embedded scenes: {', '.join(scenes)}; give a folder of your own instead"
        )
    return ASSETS_DIR / name


def refuse_root(path: Path, option: str) -> None:
    """Refuse the root of a file system, which no command searches or writes to; `option` names the path."""
    real = os.path.realpath(path)  # Path.resolve raises an error for links in a circle
    if os.path.dirname(real) == real:
        raise NerfroError(f"{option}={path} is a whole file system; give a folder below it")


def relative_path(file: Path, folder: Path) -> str:
    """Return the path of a file relative to a folder; links inside the folder are kept, since masks lie beside them."""
    file, folder = Path(os.path.abspath(file)), Path(os.path.abspath(folder))
    if not file.is_relative_to(folder):
        file, folder = file.resolve(), folder.resolve()
    return Path(os.path.relpath(file, folder)).as_posix()


def scene_name(root: str | Path) -> str:
    """Return the name of the scene in a data folder: the last component of its path."""
    return Path(str(root).removeprefix(EMBEDDED_PREFIX)).name


def cache_dir() -> Path:
    """Return the folder of the cache: the environment variable `NERFRO_CACHE`, or ~/.cache/nerfro."""
    return Path(os.environ.get("NERFRO_CACHE") or "~/.cache/nerfro").expanduser()


def user_path(location: str | Path) -> Path:
    """Convert a location from a user to a path, and expand `~` and `~name`."""
    try:
        if "\0" in str(location):
            raise NerfroError(f"{str(location)!r} contains a zero byte, which is not allowed in a path; give another")
        return Path(location).expanduser()
    except RuntimeError as error:
        raise NerfroError(f"{location}: the home folder is unknown; give the full path") from error


def shown(folder: Path) -> str:
    """Format a folder relative to the current folder, if it lies below this."""
    return str(folder.relative_to(Path.cwd())) if folder.is_relative_to(Path.cwd()) else str(folder)

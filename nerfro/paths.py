"""Where the configuration, the local plugins and the embedded data lie, in a checkout and in an installed wheel."""

from pathlib import Path

from nerfro.errors import NerfroError

PACKAGE_DIR = Path(__file__).resolve().parent
ASSETS_DIR = PACKAGE_DIR / "assets"

# The wheel carries conf/ and plugins/ inside the package (see pyproject.toml); a checkout has them beside it.
_PROJECT_DIR = PACKAGE_DIR / "_project" if (PACKAGE_DIR / "_project").is_dir() else PACKAGE_DIR.parent
CONF_DIR = _PROJECT_DIR / "conf"
PLUGINS_DIR = CONF_DIR.parent / "plugins"

EMBEDDED_PREFIX = "embedded:"


def resolve_path(location: str | Path) -> Path:
    """Turn a configured location into a path; `embedded:torus/mesh.ply` names data that ships with nerfro."""
    location = str(location)
    if not location.startswith(EMBEDDED_PREFIX):
        return user_path(location)
    name = location.removeprefix(EMBEDDED_PREFIX)
    known = sorted(path.name for path in ASSETS_DIR.iterdir() if path.is_dir() and not path.name.startswith("_"))
    if not set(Path(name).parts[:1]) & set(known):
        raise NerfroError(
            f"'{location}' is not embedded; embedded scenes: {', '.join(known)}; give a folder of your own instead"
        )
    return ASSETS_DIR / name


def user_path(location: str | Path) -> Path:
    """A path that a user gave, `~` and `~name` written out."""
    try:
        if "\0" in str(location):
            raise NerfroError(f"{str(location)!r} holds a zero byte, which no path can; give another")
        return Path(location).expanduser()
    except RuntimeError as error:
        raise NerfroError(f"{location}: no home folder is known for it; write the path out") from error

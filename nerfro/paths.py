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
    """Turn a configured location into a path; `embedded:torus/mesh.ply` names data that ships with nerfro.

    Raises:
        NerfroError: the embedded scene does not exist.
    """
    location = str(location)
    if not location.startswith(EMBEDDED_PREFIX):
        return Path(location).expanduser()
    name = location.removeprefix(EMBEDDED_PREFIX)
    if not (ASSETS_DIR / Path(name).parts[0]).is_dir():
        known = ", ".join(sorted(p.name for p in ASSETS_DIR.iterdir() if p.is_dir() and not p.name.startswith("_")))
        raise NerfroError(f"'{location}' is not embedded; embedded scenes: {known}; give a folder of your own instead")
    return ASSETS_DIR / name

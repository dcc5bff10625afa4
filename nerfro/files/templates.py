"""HTML pages from templates."""

from __future__ import annotations

from pathlib import Path


def fill_template(file: Path, **values: object) -> str:
    """Fill a Jinja template, which may include other files of its folder; values are escaped and required."""
    import jinja2  # takes a quarter of a second

    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(file.parent),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return environment.get_template(file.name).render(values)

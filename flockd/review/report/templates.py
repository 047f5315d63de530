"""Templates of pages: those of this folder, and of others whose pages look alike."""

from __future__ import annotations

from pathlib import Path

import jinja2


def page_template(path: Path) -> jinja2.Template:
    """The page at a path, which may include `page.css`. What is filled in is escaped, and nothing may be missing."""
    loader = jinja2.FileSystemLoader([path.parent, Path(__file__).parent])
    environment = jinja2.Environment(
        loader=loader, autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    return environment.get_template(path.name)

"""The pages of the documentation: their links, commands, keys and pictures are ones that exist."""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml

from flockd.cli import _parser
from flockd.core.config import DroneConfig
from tools.docs import docs_reference, rooms

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
PAGES = sorted([*DOCS.rglob("*.md"), ROOT / "README.md", ROOT / "CHANGELOG.md", ROOT / "CONTRIBUTING.md"])
SNIPPET = re.compile(r'^--8<-- "(.+)"$', re.MULTILINE)

by_name = pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))


def text_of(page: Path) -> str:
    """With the files that it includes."""
    return SNIPPET.sub(lambda found: (ROOT / found[1]).read_text(encoding="utf-8"), page.read_text(encoding="utf-8"))


def prose_of(page: Path) -> str:
    """Without blocks of code."""
    return re.sub(r"^```.*?^```$", "", text_of(page), flags=re.DOTALL | re.MULTILINE)


def anchors_of(page: Path) -> set[str]:
    """As both MkDocs and GitHub make them."""
    headings = re.findall(r"^#+ (.+)$", prose_of(page), re.MULTILINE)
    places = re.findall(r'<a id="([\w-]+)"></a>', prose_of(page))
    return {*places, *(re.sub(r"[-\s]+", "-", re.sub(r"[^\w\s-]", "", line).strip().lower()) for line in headings)}


@by_name
def test_links_and_pictures_lead_somewhere(page: Path) -> None:
    for target in re.findall(r"\]\(([^)\s]+)\)", prose_of(page)):
        if re.match("https?://", target):
            continue
        name, _, anchor = target.partition("#")
        file = (page.parent / name).resolve() if name else page
        assert file.is_file(), target
        assert page.parent == ROOT or DOCS in file.parents, f"{target}: the site does not hold it"
        assert not anchor or anchor in anchors_of(file), target


@by_name
def test_nothing_is_loaded_from_elsewhere(page: Path) -> None:
    assert re.findall(r"!\[[^\]]*\]\(\s*(?:https?:)?//", text_of(page)) == []
    assert re.findall(r"<(?:img|script|link|iframe)\b", prose_of(page)) == []


def test_the_site_brings_its_fonts_and_styles_along() -> None:
    site = yaml.safe_load((ROOT / "mkdocs.yml").read_text(encoding="utf-8"))
    assert site["theme"]["font"] is False
    assert "extra_javascript" not in site
    for style in site["extra_css"]:
        assert re.findall(r"//\w|@import", (DOCS / style).read_text(encoding="utf-8")) == []


def test_every_page_is_in_the_navigation() -> None:
    def leaves(entry: Any) -> Iterator[str]:
        if isinstance(entry, str):
            yield entry
        else:
            for inner in entry.values() if isinstance(entry, dict) else entry:
                yield from leaves(inner)

    site = yaml.safe_load((ROOT / "mkdocs.yml").read_text(encoding="utf-8"))
    assert sorted(leaves(site["nav"])) == sorted(str(page.relative_to(DOCS)) for page in DOCS.rglob("*.md"))


def test_the_reference_is_up_to_date() -> None:
    for name, text in docs_reference.pages().items():
        written = (DOCS / "reference" / name).read_text(encoding="utf-8")
        assert written == text, f"docs/reference/{name}: run python -m tools.docs.docs_reference"


def test_the_picture_of_the_rooms_is_up_to_date() -> None:
    drawn = rooms.PICTURE.read_text(encoding="utf-8")
    assert drawn == rooms.picture(), "docs/pictures/rooms.svg: run python -m tools.docs.docs_reference"
    dots = drawn.partition("flockd/flight/<")[0].count('class="o"')
    assert 20 < dots <= 9 * 8 / 2  # a pair of rooms has at most one


def shell_lines(page: Path) -> Iterator[str]:
    """The commands of a page's `sh` blocks, continued lines joined, without comments and redirections."""
    for block in re.findall(r"^```sh\n(.*?)^```$", text_of(page), re.DOTALL | re.MULTILINE):
        for line in block.replace("\\\n", " ").splitlines():
            yield line.partition(" > ")[0].strip()


@by_name
def test_commands_parse(page: Path) -> None:
    for line in shell_lines(page):
        words = shlex.split(line, comments=True)
        if words and words[0].rpartition("/")[2] == "flockd" and "--help" not in words:
            try:
                _parser().parse_args(words[1:])
            except SystemExit:
                pytest.fail(line)


@by_name
def test_tools_exist_and_take_the_options_that_are_shown(page: Path) -> None:
    if page.name.lower() == "changelog.md":  # it tells of what was, under the names of then
        return
    for name, words in re.findall(r"python3? -m (tools(?:\.[a-z]\w*)+)([^`\n]*)", text_of(page)):
        source = (ROOT / f"{name.replace('.', '/')}.py").read_text(encoding="utf-8")
        for option in re.findall(r"--[a-z-]+", words):
            assert f'"{option}"' in source, f"{name} {option}"
    for name in re.findall(r"`((?:tools|config|systemd|models|flockd|tests)/[\w/]+\.\w+)`", prose_of(page)):
        assert (ROOT / name).is_file(), name


def has_key(schema: dict[str, Any], path: list[str]) -> bool:
    here: dict[str, Any] | None = schema
    for key in path:
        if here is None or key not in here.get("properties", {}):
            return False
        here = docs_reference._inner(schema, here["properties"][key])[0]  # type: ignore[assignment]
    return True


@by_name
def test_configuration_keys_exist(page: Path) -> None:
    drone = DroneConfig.model_json_schema()
    sections = {key for key, value in drone["properties"].items() if docs_reference._inner(drone, value)[0]}
    for name in re.findall(r"`([a-z_]+(?:\.[a-z_0-9]+)+)\b(?!\.\w)[^`]*`", prose_of(page)):
        path = name.split(".")
        if path[0] in sections and path[-1] not in ("py", "mcap"):
            assert has_key(drone, path), name


def test_the_readme_is_short_and_shows_the_flock() -> None:
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    assert len(readme.splitlines()) <= 120
    assert len((ROOT / "CHANGELOG.md").read_text(encoding="utf-8").splitlines()) < 150, "git has what is older"
    assert "docs/pictures/by_sight.webp" in readme
    assert "make demo" in readme


def test_the_site_is_short() -> None:
    pages = {page: len(page.read_text(encoding="utf-8").splitlines()) for page in DOCS.rglob("*.md")}
    assert sum(page.parent.name != "reference" for page in pages) <= 25, "what could another page say?"
    assert sum(pages.values()) <= 4_000, "what is said twice, or by --help?"


def test_pictures_are_small() -> None:
    sizes = {path.name: path.stat().st_size for path in (DOCS / "pictures").iterdir()}
    assert sizes["by_sight.webp"] < 3e5
    assert sum(sizes.values()) < 3e6

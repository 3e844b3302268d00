"""Puts the files that the pages link to, such as examples, into the site: a hook of mkdocs.

On a code host the links lead into the project; in the site they lead to copies below ``files/``. A link to a
missing file is not changed, and fails the build.
"""

from __future__ import annotations

import os
import re
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING

from mkdocs.structure.files import File

if TYPE_CHECKING:
    from mkdocs.config.defaults import MkDocsConfig
    from mkdocs.structure.files import Files
    from mkdocs.structure.pages import Page

ROOT = Path(__file__).resolve().parent.parent
FOLDER = "files"
_PAGES = "docs"
_LINK = re.compile(r"\]\((?!\w+:)([^)#\s]+)([^)]*)\)")


def on_files(files: Files, config: MkDocsConfig) -> None:
    """Add the files that the pages link to outside of their folder, and those that these link to."""
    pages = list(files.documentation_pages())
    for page in pages:
        for found in _LINK.finditer(page.content_string):
            place = in_site(page.src_uri, found[1])
            if place.startswith(f"{FOLDER}/") and files.get_file_from_path(place) is None:
                content = (ROOT / place.removeprefix(f"{FOLDER}/")).read_bytes()
                files.append(File.generated(config, place, content=content))
                if place.endswith(".md"):
                    pages.append(files.src_uris[place])


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:  # noqa: ARG001
    """Point the links to where the files are in the site."""
    source = page.file.src_uri

    def to_site(found: re.Match[str]) -> str:
        place = in_site(source, found[1])
        if not place:
            return found[0]
        return f"]({os.path.relpath(place, PurePosixPath(source).parent)}{found[2]})"

    return _LINK.sub(to_site, markdown)


def in_site(source: str, link: str) -> str:
    """Return the path in the site of what a page links to.

    Args:
        source: The page's path in the site.
        link: The target of its link, relative to the page's place in the project.

    Returns:
        Empty if the link is between two pages of the documentation, or the file is not in the project.
    """
    is_copy = source.startswith(f"{FOLDER}/")
    page = PurePosixPath(source.removeprefix(f"{FOLDER}/")) if is_copy else PurePosixPath(_PAGES, source)
    place = os.path.normpath(page.parent / link)
    is_page = place.startswith(f"{_PAGES}/")
    if place.startswith("..") or not (ROOT / place).is_file() or (is_page and not is_copy):
        return ""
    return place.removeprefix(f"{_PAGES}/") if is_page else f"{FOLDER}/{place}"

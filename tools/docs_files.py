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
_LINK = re.compile(r"\]\((\.\./[^)#\s]+)([^)]*)\)")


def on_files(files: Files, config: MkDocsConfig) -> None:
    """Add the files that the pages link to outside of their folder."""
    for page in list(files.documentation_pages()):
        for found in _LINK.finditer(page.content_string):
            place = outside(page.src_uri, found[1])
            if place and files.get_file_from_path(f"{FOLDER}/{place}") is None:
                files.append(File.generated(config, f"{FOLDER}/{place}", content=(ROOT / place).read_bytes()))


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:  # noqa: ARG001
    """Point the links to the copies."""
    source = page.file.src_uri

    def to_copy(found: re.Match[str]) -> str:
        place = outside(source, found[1])
        if not place:
            return found[0]
        target = os.path.relpath(f"{FOLDER}/{place}", PurePosixPath(source).parent)
        return f"]({target}{found[2]})"

    return _LINK.sub(to_copy, markdown)


def outside(source: str, link: str) -> str:
    """Return the path in the project of a file outside of the documentation that a page links to.

    Args:
        source: The page, as seen from the documentation's folder.
        link: The target of its link.

    Returns:
        Empty if the link stays in the documentation, or the file is not in the project.
    """
    place = os.path.normpath(PurePosixPath("docs", source).parent / link)
    return "" if place.startswith(("docs/", "..")) or not (ROOT / place).is_file() else place

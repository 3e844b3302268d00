"""Writes the docstrings' references (``:meth:`publish```) as links of the reference pages, for mkdocstrings.

A reference to an object that a page shows becomes a link, which fails the build if it is broken; any other is
shown as a name. The shown objects are read from the pages, so no second list is needed.
"""

from __future__ import annotations

import re
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import griffe

if TYPE_CHECKING:
    from collections.abc import Iterator

PAGES = Path(__file__).resolve().parent.parent / "docs" / "reference"
_SHOWN = re.compile(r"^::: ([\w.]+)$", re.MULTILINE)
_ROLE = re.compile(r":(?:attr|class|exc|func|meth|mod):`~?([\w.]+)`")
_LITERAL = re.compile(r"^(.*?) *::$(?=\n\n )", re.MULTILINE)


class Roles(griffe.Extension):
    """Rewrites all docstrings of a package once it is loaded."""

    def on_package(self, *, pkg: griffe.Module, **_: object) -> None:
        """Rewrite the docstrings of a package."""
        places = _places(pkg)
        for item in _objects(pkg):
            if item.docstring is not None:
                text = _ROLE.sub(partial(_link, places, item), item.docstring.value)
                item.docstring.value = _LITERAL.sub(_end_of_literal, text)


def _places(package: griffe.Module) -> dict[str, str]:
    """Return the anchors of the shown objects, by their own paths and their aliases."""
    shown = {name for page in PAGES.glob("*.md") for name in _SHOWN.findall(page.read_text())}
    places: dict[str, str] = {}
    for name in sorted(shown):
        if name.partition(".")[0] == package.path:
            item = package[name.partition(".")[2]]
            item = item.final_target if isinstance(item, griffe.Alias) else item
            places |= {name: name, item.path: name}
            for member in item.all_members.values():
                if isinstance(member, griffe.Alias) and not member.inherited:
                    continue  # it is only imported there
                if not member.has_docstring:
                    continue  # not shown
                anchor = f"{name}.{member.name}"
                places |= {anchor: anchor, f"{item.path}.{member.name}": anchor}
                places.setdefault(member.canonical_path, anchor)
    return places


def _link(places: dict[str, str], item: griffe.Object, found: re.Match[str]) -> str:
    target = _path(item, found[1])
    anchor = places.get(target, "")
    words = (anchor or target).split(".")
    first = next((n for n, word in enumerate(words) if word[:1].isupper()), len(words) - 1)
    name = f"`{'.'.join(words[first:])}`"
    return f"[{name}][{anchor}]" if anchor else name


def _objects(item: griffe.Object) -> Iterator[griffe.Object]:
    yield item
    for member in item.members.values():
        if isinstance(member, griffe.Object):
            yield from _objects(member)


def _path(item: griffe.Object, name: str) -> str:
    """Return the full path of a name in a docstring of ``item``."""
    first, _, rest = name.partition(".")
    scope: griffe.Object | griffe.Alias | None = item
    while scope is not None:
        if first in (scope.all_members if scope.is_class else scope.members):
            return ".".join(filter(None, (scope.path, first, rest)))
        scope = scope.parent
    try:
        return ".".join(filter(None, (item.resolve(first), rest)))
    except griffe.NameResolutionError:
        return name


def _end_of_literal(found: re.Match[str]) -> str:
    return f"{found[1]}:" if found[1] else ""

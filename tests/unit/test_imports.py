"""Imports keep to the table of ``docs/architecture.md``."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest
from support.sources import PACKAGES, ROOT, files, statements

_ROW = re.compile(r"^\| `(rce[\w.]*)` \|.*\| ([^|]*) \|$", re.MULTILINE)


def table() -> dict[str, tuple[str, ...]]:
    """Package to what it may import."""
    text = (ROOT / "docs" / "architecture.md").read_text()
    section = text[text.index("## Packages") :].partition("\n## ")[0]
    return {name: tuple(re.findall(r"`([\w.]+)`", allowed)) for name, allowed in _ROW.findall(section)}


def is_in(module: str, package: str) -> bool:
    return module == package or module.startswith(f"{package}.")


@cache
def imports(file: Path) -> list[tuple[int, str]]:
    """Lines and modules of the project that a file imports, also inside of functions and for types only."""
    found = []
    for node in statements(file):
        match node:
            case ast.Import():
                names = [alias.name for alias in node.names]
            case ast.ImportFrom(module=str(module), level=0):
                inner = [f"{module}.{alias.name}" for alias in node.names]
                names = [name if is_module(name) else module for name in inner]
            case _:
                continue
        found += [(node.lineno, name) for name in names if name.partition(".")[0] in PACKAGES]
    return found


def is_module(name: str) -> bool:
    path = ROOT / name.replace(".", "/")
    return path.is_dir() or path.with_suffix(".py").is_file()


def modules() -> Iterator[tuple[Path, str]]:
    for package in PACKAGES:
        for file in files(package):
            name = ".".join(file.relative_to(ROOT).with_suffix("").parts)
            yield file, name.removesuffix(".__init__")


def owner_of(module: str, rows: dict[str, tuple[str, ...]]) -> str | None:
    return max((row for row in rows if is_in(module, row)), key=len, default=None)


def test_every_module_has_a_row() -> None:
    rows = table()
    without = {name for _, name in modules() if owner_of(name, rows) is None}
    assert without == {"rce", "rce_fleet"}


def test_every_row_has_a_module() -> None:
    assert [name for name in table() if not is_module(name)] == []


@pytest.mark.slow
def test_no_import_leaves_the_table() -> None:
    rows = table()
    wrong = [
        f"{file.relative_to(ROOT)}:{line}: {owner} may not import {imported}"
        for file, module in modules()
        for line, imported in imports(file)
        if (owner := owner_of(module, rows)) is not None
        and imported != owner.partition(".")[0]  # the version and the folder of the package itself
        and not any(is_in(imported, allowed) for allowed in (owner, *rows[owner]))
    ]
    assert wrong == []


@pytest.mark.slow
def test_no_row_allows_more_than_is_used() -> None:
    """Rows of the lower packages name what they need, and no more."""
    rows = {name: allowed for name, allowed in table().items() if name.startswith(("rce.", "rce_fleet."))}
    used: dict[str, set[str]] = {name: set() for name in rows}
    for file, module in modules():
        owner = owner_of(module, rows)
        if owner is not None:
            used[owner].update(imported for _, imported in imports(file))
    idle = [
        f"{name}: {allowed}"
        for name, row in rows.items()
        for allowed in row
        if not any(is_in(imported, allowed) for imported in used[name])
    ]
    assert idle == []

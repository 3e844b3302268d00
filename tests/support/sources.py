"""The project's source files, for tests of conventions.

Reading all files takes a tenth of a second, parsing them a second, and looking at each part of each
expression several. So tests leave out files whose text cannot hold what they look for, and look at statements
only where that is enough.
"""

from __future__ import annotations

import ast
from collections.abc import Iterator
from functools import cache
from pathlib import Path

ROOT = Path(__file__).parents[2]
PACKAGES = ("rce", "rce_client", "rce_container", "rce_fleet", "rce_master", "rce_robot")
_INNER = ("body", "orelse", "finalbody", "handlers", "cases")


@cache
def files(tree: str) -> tuple[Path, ...]:
    """Return the Python files of a package or folder of the project."""
    return tuple(sorted((ROOT / tree).rglob("*.py")))


@cache
def text_of(file: Path) -> str:
    return file.read_text(encoding="utf-8")


def statements(file: Path) -> Iterator[ast.AST]:
    """Yield all statements of a file, also inner ones, and handlers of exceptions and cases of matches."""
    waiting: list[ast.AST] = [ast.parse(text_of(file))]
    for node in waiting:
        yield node
        for name in _INNER:
            waiting += getattr(node, name, ())

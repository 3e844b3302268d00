"""Conventions that no linter checks: how exceptions, loggers and sections are named."""

from __future__ import annotations

import ast
import builtins
import re
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[2]
PACKAGES = ("rce", "rce_client", "rce_container", "rce_fleet", "rce_master", "rce_robot")
_BUILT_IN = frozenset(
    name
    for name, value in vars(builtins).items()
    if isinstance(value, type) and issubclass(value, BaseException)
)
_RULER = re.compile(r"^\s*#\s*[-=~]{2,}|^\s*#.*[-=~]{4,}\s*$", re.MULTILINE)


def files() -> Iterator[Path]:
    for package in PACKAGES:
        yield from (ROOT / package).rglob("*.py")


def classes() -> Iterator[tuple[str, set[str]]]:
    """Names of all classes, with the names of their bases."""
    for file in files():
        for node in ast.walk(ast.parse(file.read_text())):
            if isinstance(node, ast.ClassDef):
                yield node.name, {ast.unparse(base).rpartition(".")[2] for base in node.bases}


def exceptions() -> set[str]:
    """Names of all classes that derive from an exception, also by others of them."""
    known, found = list(classes()), set(_BUILT_IN)
    while more := {name for name, bases in known if bases & found} - found:
        found |= more
    return found - _BUILT_IN


def test_exceptions_end_in_error() -> None:
    found = exceptions()
    assert {"RosError", "NotFoundError", "TransitionError"} <= found
    assert sorted(name for name in found if not name.endswith("Error")) == []


def test_a_module_has_one_logger_of_one_name() -> None:
    wrong = [
        f"{file.relative_to(ROOT)}: {line}"
        for file in files()
        for line in file.read_text().splitlines()
        if re.search(r"^\w+ = logging.getLogger\(__name__\)", line) and not line.startswith("_log = ")
    ]
    assert wrong == []


def test_sections_have_plain_headings() -> None:
    ruled = [str(file.relative_to(ROOT)) for file in files() if _RULER.search(file.read_text())]
    assert ruled == []

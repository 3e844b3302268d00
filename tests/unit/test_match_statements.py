"""A ``match`` over events, messages or states handles each of them; mypy finds the one that is left out."""

from __future__ import annotations

import ast
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from collections.abc import Iterator

ROOT = Path(__file__).parents[2]
PACKAGES = ("rce", "rce_client", "rce_container", "rce_fleet", "rce_master", "rce_robot")
OPEN = {
    "rce/ros/launch/expressions.py": "parts of Python's grammar; those not listed are refused",
    "rce/ros/multimaster/relay/frames.py": "numbers from the wire; what is left is JSON",
    "rce/ros/tools/plain.py": "values of any type",
    "rce_master/http/server.py": "exceptions, of which there may be more",
}
"""Files whose ``match`` is over something that has no fixed set of cases."""


def _matches(file: Path) -> Iterator[ast.Match]:
    return (node for node in ast.walk(ast.parse(file.read_text())) if isinstance(node, ast.Match))


def _is_over_names(match: ast.Match) -> bool:
    """Return whether it tells classes or members of enums apart; builtin types are values, not events."""
    for node in (inner for case in match.cases for inner in ast.walk(case.pattern)):
        if isinstance(node, ast.MatchClass):
            name = node.cls.attr if isinstance(node.cls, ast.Attribute) else getattr(node.cls, "id", "")
            if name[:1].isupper():
                return True
        if isinstance(node, ast.MatchValue) and isinstance(node.value, ast.Attribute):
            return True
    return False


def _is_closed(match: ast.Match) -> bool:
    """Return whether the last case refuses what none of the others takes."""
    last = match.cases[-1]
    if (
        not isinstance(last.pattern, ast.MatchAs)
        or last.pattern.pattern is not None
        or last.guard is not None
    ):
        return False
    statement = last.body[0]
    if isinstance(statement, ast.Raise):
        return True
    call = statement.value if isinstance(statement, ast.Expr) else None
    return isinstance(call, ast.Call) and getattr(call.func, "id", "") == "assert_never"


FILES = [
    str(file.relative_to(ROOT))
    for package in PACKAGES
    for file in sorted((ROOT / package).rglob("*.py"))
    if any(map(_is_over_names, _matches(file)))
]


@pytest.mark.parametrize("file", FILES)
def test_a_match_over_events_ends_with_assert_never(file: str) -> None:
    open_ones = [
        f"{file}:{match.lineno}"
        for match in _matches(ROOT / file)
        if _is_over_names(match) and not _is_closed(match)
    ]
    assert bool(open_ones) == (file in OPEN), open_ones


def test_the_list_of_open_ones_names_files() -> None:
    assert set(OPEN) <= set(FILES)

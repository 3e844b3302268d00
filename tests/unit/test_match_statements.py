"""A ``match`` over events, messages or states handles each of them; mypy finds the one that is left out."""

from __future__ import annotations

import ast
from functools import cache
from pathlib import Path

import pytest
from support.sources import PACKAGES, ROOT, files, statements, text_of

OPEN = {
    "rce/cli/summaries.py": "parts of Python's grammar; those not listed have no summary",
    "rce/ros/launch/expressions.py": "parts of Python's grammar; those not listed are refused",
    "rce/ros/multimaster/relay/frames.py": "numbers from the wire; what is left is JSON",
    "rce/ros/tools/plain.py": "values of any type",
    "rce_master/http/server.py": "exceptions, of which there may be more",
}
"""Files whose ``match`` is over something that has no fixed set of cases."""


@cache
def matches_of(file: Path) -> list[ast.Match]:
    """Return the ``match`` statements of a file that tell classes or members of enums apart."""
    if "match " not in text_of(file):
        return []
    return [node for node in statements(file) if isinstance(node, ast.Match) and _is_over_names(node)]


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


@pytest.mark.slow
def test_match_over_events_ends_with_assert_never() -> None:
    checked = 0
    wrong = []
    for file in (file for package in PACKAGES for file in files(package)):
        place = file.relative_to(ROOT).as_posix()
        checked += len(matches_of(file))
        wrong += [
            f"{place}:{each.lineno}"
            for each in matches_of(file)
            if place not in OPEN and not _is_closed(each)
        ]
    assert checked > 30
    assert wrong == []


def test_files_with_open_matches_have_some() -> None:
    """A file that has none any more is removed from the list."""
    idle = [place for place in OPEN if all(_is_closed(each) for each in matches_of(ROOT / place))]
    assert idle == []

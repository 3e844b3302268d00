"""Conventions that no linter checks: how exceptions, loggers and sections are named."""

from __future__ import annotations

import ast
import builtins
import re
from collections.abc import Iterator
from pathlib import Path

import pytest
from support.sources import PACKAGES, ROOT, files, statements, text_of

_BUILT_IN = frozenset(
    name
    for name, value in vars(builtins).items()
    if isinstance(value, type) and issubclass(value, BaseException)
)
MIN_LINES = 40
BASE = "the lowest module of its package: merged into one of its users, it would make a circle of imports"
TYPER = "loads typer, which a program that gets its settings from another one does without"
TINY = {
    "rce/packages/limits.py": BASE,
    "rce/protocol/limits.py": BASE,
    "rce/printable.py": "below five packages, which have nothing else in common",
    "rce/ros/actions/topics.py": BASE,
    "rce/ros/tf/frames.py": BASE,
    "rce_container/command.py": TYPER,
    "rce_fleet/experiments/catalogue.py": "the one place where an experiment is added",
    "rce_fleet/experiments/systems/registry.py": BASE,
    "rce_fleet/experiments/workloads/echo.py": "a program of its own, for a machine of its own",
    "rce_container/environment/exceptions.py": BASE,
    "rce_container/runtimes/process.py": "one runtime a file",
    "rce_fleet/limits.py": BASE,
    "rce_fleet/mapping/mapper.py": "what two algorithms, in packages of their own, have in common",
    "rce_fleet/offline/inputs.py": "chooses between two readers, one of which needs rosbags",
    "rce_master/cli/exceptions.py": BASE,
    "rce_master/command.py": TYPER,
    "rce_master/http/leader_check.py": "common to archives and the audit log, which do not load each other",
    "rce_master/http/model.py": BASE,
    "rce_master/http/origin_guard.py": "common to two servers, neither of which loads the other",
    "rce_robot/command.py": TYPER,
}
"""Modules under 40 lines, and why they are not merged with another one."""
_RULER = re.compile(r"^\s*#\s*[-=~]{2,}|^\s*#.*[-=~]{4,}\s*$", re.MULTILINE)


def modules() -> Iterator[Path]:
    for package in PACKAGES:
        yield from files(package)


def classes() -> Iterator[tuple[str, set[str]]]:
    """Names of all classes, with the names of their bases."""
    for file in modules():
        for node in statements(file):
            if isinstance(node, ast.ClassDef):
                yield node.name, {ast.unparse(base).rpartition(".")[2] for base in node.bases}


def exceptions() -> set[str]:
    """Names of all classes that derive from an exception, also by others of them."""
    known, found = list(classes()), set(_BUILT_IN)
    while more := {name for name, bases in known if bases & found} - found:
        found |= more
    return found - _BUILT_IN


@pytest.mark.slow
def test_exceptions_end_in_error() -> None:
    found = exceptions()
    assert {"RosError", "NotFoundError", "TransitionError"} <= found
    assert sorted(name for name in found if not name.endswith("Error")) == []


def test_a_module_has_one_logger_of_one_name() -> None:
    wrong = [
        f"{file.relative_to(ROOT)}: {line}"
        for file in modules()
        for line in text_of(file).splitlines()
        if re.search(r"^\w+ = logging.getLogger\(__name__\)", line) and not line.startswith("_log = ")
    ]
    assert wrong == []


def test_sections_have_plain_headings() -> None:
    ruled = [str(file.relative_to(ROOT)) for file in modules() if _RULER.search(text_of(file))]
    assert ruled == []


def test_a_tiny_module_has_a_reason() -> None:
    """Two files that are one thought are one file; the others are listed in ``TINY``."""
    tiny = {
        file.relative_to(ROOT).as_posix()
        for file in modules()
        if not file.name.startswith("__") and len(text_of(file).splitlines()) < MIN_LINES
    }
    assert sorted(tiny ^ TINY.keys()) == []

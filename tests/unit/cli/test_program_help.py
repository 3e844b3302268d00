"""The help of the engine's programs."""

from __future__ import annotations

import re
from collections.abc import Iterator
from importlib import import_module
from importlib.metadata import entry_points
from typing import Any

import pytest
import typer
from typer.testing import CliRunner

from rce.cli.main import GROUP, build_app


@pytest.mark.parametrize("package", ["rce_master", "rce_robot", "rce_container"])
def test_help_names_the_options(package: str) -> None:
    """Words in brackets in a description must not be read as markup."""
    app = import_module(f"{package}.command").app
    result = CliRunner().invoke(app, ["--help"], env={"COLUMNS": "200"}, catch_exceptions=False)
    assert result.exit_code == 0
    assert "--machine" in result.output


def parameters(name: str, command: Any) -> Iterator[tuple[str, str]]:
    """Yield each parameter of a command and of those below it, with its description."""
    for parameter in command.params:
        yield f"{name} {parameter.name}", getattr(parameter, "help", "") or ""
    for inner, below in getattr(command, "commands", {}).items():
        yield from parameters(f"{name} {inner}", below)


def test_no_description_has_brackets() -> None:
    """They are read as markup, and what is in them is not shown."""
    app = build_app(sorted(entry_points(group=GROUP)))
    found = dict(parameters("rce", typer.main.get_command(app)))
    assert len(found) > 300
    assert [name for name, text in found.items() if re.search(r"\[[a-z#/@]", text)] == []

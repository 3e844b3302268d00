"""The help of the engine's programs."""

from __future__ import annotations

from importlib import import_module

import pytest
from typer.testing import CliRunner


@pytest.mark.parametrize("package", ["rce_master", "rce_robot", "rce_container"])
def test_help_names_the_options(package: str) -> None:
    """Words in brackets in a description must not be read as markup."""
    app = import_module(f"{package}.command").app
    result = CliRunner().invoke(app, ["--help"], env={"COLUMNS": "200"}, catch_exceptions=False)
    assert result.exit_code == 0
    assert "--machine" in result.output

"""Commands that cannot be done say why in a line, without a traceback."""

from __future__ import annotations

from pathlib import Path

import pytest
import typer
from typer.testing import CliRunner

from rce_master.cli import cluster, credentials, states, users


def refusal(app: typer.Typer, *words: str) -> str:
    result = CliRunner().invoke(app, words, env={"COLUMNS": "200"})
    assert isinstance(result.exception, SystemExit), result.exception
    assert result.exit_code != 0
    assert "Traceback" not in result.output
    return result.output


@pytest.mark.parametrize("node", ["C", "C/", "/n", "C/n/more"])
def test_a_state_without_its_node(node: str) -> None:
    assert "names no node: write CONTAINER/NODE" in refusal(states.app, "remove", node, "--yes")


@pytest.mark.parametrize(
    "words",
    [
        ("show", "anna"),
        ("limit", "anna", "--slots", "3"),
        ("list",),
        ("remove", "anna"),
        ("role", "anna", "viewer"),
    ],
    ids=lambda words: words[0],
)
def test_a_login_that_cannot_be_read(
    words: tuple[str, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "login.json").write_text("{")
    monkeypatch.setenv(credentials.FILE_VARIABLE, str(tmp_path / "login.json"))
    assert "cannot read the login" in refusal(users.app, *words)


def test_members_that_are_not_addresses(tmp_path: Path) -> None:
    folder = ("--foreground", "--no-tls", "--state-dir", str(tmp_path))
    text = refusal(cluster.app, "join", "host:port", "--address", "10.0.0.1", *folder)
    assert "must name members of etcd as HOST:PORT" in text

"""Tables of the commands show what users and nodes wrote, brackets and all."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any, Self

import pytest
import typer
from rich.console import Console, RenderableType
from typer.testing import CliRunner

from rce_master.cli import credentials, machines, packages, show, signing_key, tokens, top, volumes
from rce_master.cli.client import ApiClient

DETAIL = "no transform to [/map] from [base_link] :robot:"


def printed(renderable: RenderableType) -> str:
    console = Console(file=io.StringIO(), width=300, force_terminal=True, color_system=None)
    console.print(renderable)
    assert isinstance(console.file, io.StringIO)
    return console.file.getvalue()


def overview(detail: str) -> str:
    node = {"user": "anna", "container": "c", "tag": "n", "pkg": "Test", "exe": "x.py", "state": "failed"}
    container = {"user": "anna", "tag": "c", "id": "anna/c", "state": "running", "machine": "m"}
    container |= {"task_set": "m", "moving_to": ""}
    found: show.Everything = {
        "robots": [],
        "connections": [{"tag_a": "a", "tag_b": "b", "established": True}],
        "machines": [],
        "containers": [{**container, "detail": detail}],
        "nodes": [{**node, "detail": detail}],
    }
    return printed(show._overview(found))


def test_details_are_not_markup() -> None:
    """A detail is the last message of a node, which any user writes."""
    assert overview(DETAIL).count(DETAIL) == 2


def test_a_detail_does_not_control_the_terminal() -> None:
    text = overview("\x1b]0;mine\x07 done")
    assert "\x1b]" not in text
    assert "]0;mine" in text


def test_lines_of_a_cell_stay_in_its_column() -> None:
    lines = overview("first\nrobot  connected").splitlines()
    column = next(line for line in lines if "first" in line).index("first")
    assert [line.index("robot  connected") for line in lines if "robot  connected" in line] == [column] * 2


def test_advice_is_not_markup() -> None:
    advice = {"about": "memory", "text": DETAIL, "command": "rce resize c"}
    assert DETAIL in printed(top._advice([{"id": "anna/c", "advice": [advice]}], "id")[0])


def test_labels_of_machines_are_not_markup() -> None:
    machine: dict[str, Any] = {"kind": "container", "machine": "m", "process": "m", "connected": True}
    machine |= {"draining": False, "endpoints": 0, "promised_slots": 0, "slots": 0, "promised_cores": 0.0}
    machine |= {
        "cores": 4,
        "promised_memory": 0,
        "memory": 0,
        "limits": "",
        "runtime": "",
        "labels": ["[/gpu]"],
    }
    assert "[/gpu]" in printed(machines.overview([machine]))


class Master:
    """Answers with one item of each list."""

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *_: object) -> None: ...

    async def items(self, path: str, *_: object, **__: object) -> list[dict[str, Any]]:
        volume = {"user": "anna", "name": "map", "used": None, "size": 0, "machine": "", "container": ""}
        package = {"user": "anna", "name": "drive", "version": "1.0", "newest": True, "requirements": False}
        package |= {"executables": [], "files": 1, "size": 1, "packed": 1, "sha256": "0", "created": 0.0}
        key = {"id": "1", "key": "k", "created": 0.0}
        token = {"id": "1", "scope": "", "current": True, "created": 0.0, "expires": 0.0, "used": 0.0}
        found: dict[str, list[dict[str, Any]]] = {
            "/volumes": [{**volume, "path": "", "snapshot": None, "fault": "[/f]"}],
            "/packages": [{**package, "key": "", "nodes": [], "node_count": 0, "description": "[/f]"}],
            "/package-keys": [{**key, "label": "[/f]"}],
            "/tokens": [{**token, "label": "[/f]"}],
        }
        return found[path]


@pytest.mark.parametrize(
    ("app", "words"),
    [
        (volumes.app, ["list"]),
        (packages.app, ["show", "drive"]),
        (packages.app, ["key"]),
        (tokens.tokens, ["list"]),
    ],
    ids=["volume list", "package show", "package key", "token list"],
)
def test_lists_show_brackets(
    app: typer.Typer, words: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(signing_key.FILE_VARIABLE, str(tmp_path / "key.pem"))
    login = credentials.Credentials(url="http://m/", user="anna", token="", expires=0.0)
    monkeypatch.setattr(credentials, "load", lambda: login)
    monkeypatch.setattr(ApiClient, "of", lambda _: Master())
    result = CliRunner().invoke(app, words, env={"COLUMNS": "200"}, catch_exceptions=False)
    assert "[/f]" in result.output

"""Names are resolved before connecting, everywhere: uvloop reports a cancelled lookup's failure otherwise."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import rce

ROOT = Path(rce.__file__).parents[1]
CALLS = ("create_connection", "open_connection", "connect")


def connecting_calls() -> Iterator[tuple[str, ast.Call]]:
    """Yield all calls in the packages that connect by TCP, with where they are."""
    for package in ("rce", "rce_master", "rce_robot", "rce_container", "rce_client"):
        for file in sorted((ROOT / package).rglob("*.py")):
            tree = ast.parse(file.read_text())
            takes_sockets = "from websockets" in file.read_text()
            for node in ast.walk(tree):
                if not isinstance(node, ast.Call):
                    continue
                called = (
                    node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", "")
                )
                is_websocket = called == "connect" and isinstance(node.func, ast.Name) and takes_sockets
                if called in CALLS[:2] or is_websocket:
                    yield f"{file.relative_to(ROOT)}:{node.lineno}", node


def test_every_connecting_call_is_given_a_socket() -> None:
    found = dict(connecting_calls())
    assert len(found) >= 8
    without = [
        where for where, call in found.items() if not any(keyword.arg == "sock" for keyword in call.keywords)
    ]
    assert without == [], "resolve the name first: rce.dialing.open_socket, then sock=..."

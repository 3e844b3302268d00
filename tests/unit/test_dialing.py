"""Names are resolved before connecting, everywhere: uvloop reports a cancelled lookup's failure otherwise."""

from __future__ import annotations

import ast
from collections.abc import Iterator

import pytest
from support.sources import ROOT, files, text_of

from rce.dialing import open_socket

CALLS = ("create_connection", "open_connection", "connect")


def connecting_calls() -> Iterator[tuple[str, ast.Call]]:
    """Yield all calls in the packages that connect by TCP, with where they are."""
    for package in ("rce", "rce_master", "rce_robot", "rce_container", "rce_client"):
        for file in files(package):
            text = text_of(file)
            if not any(f"{call}(" in text for call in CALLS):
                continue
            takes_sockets = "from websockets" in text
            for node in ast.walk(ast.parse(text)):
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


async def test_port_that_cannot_be_is_an_os_error() -> None:
    """Ports come from other programs: who dials expects an ``OSError``."""
    with pytest.raises(OSError, match="70000"):
        await open_socket("127.0.0.1", 70_000)

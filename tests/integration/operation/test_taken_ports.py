"""Programs whose port is taken, or whose address is not one, say which, and what to do."""

from __future__ import annotations

import asyncio
import os
import socket
import sys
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from pathlib import Path

HOST = "127.0.0.1"


async def start(folder: Path, *words: str) -> str:
    """Run a program that cannot start; return its output."""
    kept = {key: value for key, value in os.environ.items() if not key.startswith(("RCE_", "XDG_"))}
    process = await asyncio.create_subprocess_exec(
        *(sys.executable, "-m", *words),
        cwd=folder,
        env=kept | {"HOME": str(folder), "RCE_SECRET": "a secret for the tests"},
        stdout=asyncio.subprocess.PIPE,
        stderr=asyncio.subprocess.STDOUT,
    )
    output, _ = await process.communicate()
    assert process.returncode == 1
    return output.decode()


@pytest.mark.parametrize(
    ("words", "option"),
    [
        (("rce_master", "--control-port", "0"), "--http-port"),
        (("rce_master", "--http-port", "0"), "--control-port"),
        (("rce_robot", HOST), "--ws-port"),
        (("rce_robot", HOST, "--ws-port", "0"), "--link-port"),
        (("rce_container", HOST, "--runtime", "process"), "--link-port"),
    ],
)
async def test_port_that_is_taken(tmp_path: Path, words: tuple[str, ...], option: str) -> None:
    with socket.create_server((HOST, 0)) as taken:
        port = taken.getsockname()[1]
        bind = ("--bind", HOST)
        output = await start(tmp_path, *words, *bind, option, str(port))
    assert f"cannot listen on {HOST}, port {port}: Address already in use" in output
    assert option in output
    assert "Traceback" not in output


async def test_address_that_is_not_of_this_machine(tmp_path: Path) -> None:
    output = await start(tmp_path, "rce_master", "--bind", "192.0.2.99", "--http-port", "0")
    assert "cannot listen on 192.0.2.99, port 8080: Cannot assign requested address" in output
    assert "--bind" in output

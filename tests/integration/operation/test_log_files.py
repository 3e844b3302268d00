"""``--log-dir``: logs in files that are rotated."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import aiohttp
import pytest
from support.engine import Program, until
from support.ports import free_ports

pytestmark = pytest.mark.timeout(200)
BIN = Path(sys.executable).parent


async def test_logs_are_rotated_and_bounded(tmp_path: Path) -> None:
    (port,) = free_ports(1)
    logs = tmp_path / "logs"
    argv = [
        *(str(BIN / "rce-master"), "--dev", "--http-port", str(port), "--control-port", "0"),
        *("--state-dir", str(tmp_path / "state"), "--log-level", "debug"),
        *("--log-dir", str(logs), "--log-size", "2K", "--log-count", "2"),
    ]
    env = {**os.environ, "XDG_RUNTIME_DIR": str(tmp_path), "RCE_SECRET": "a secret for the tests"}
    program = Program("master", argv, env, tmp_path)
    await program.start(timeout=90)
    try:
        async with aiohttp.ClientSession() as session:

            async def rotated() -> bool:
                body = {"userID": "testUser", "password": "testUser"}
                async with session.post(f"http://127.0.0.1:{port}/api/v1/login", json=body) as reply:
                    headers = {"Authorization": f"Bearer {(await reply.json())['token']}"}
                for method, path in (("PUT", "users/anna"), ("DELETE", "users/anna")):
                    data = {"password": "x y z w", "name": "anna"}
                    url = f"http://127.0.0.1:{port}/api/v1/{path}"
                    async with session.request(method, url, json=data, headers=headers):
                        pass
                return (logs / "rce-master.log.2").exists()

            await until(rotated, timeout=90, what="the log was put aside twice")
    finally:
        await program.stop()
    assert {path.name for path in logs.iterdir()} <= {f"rce-master.log{end}" for end in ("", ".1", ".2")}
    assert all(path.stat().st_size <= 2 << 10 for path in logs.iterdir())
    assert " INFO " not in program.output()


async def test_log_that_cannot_be_written_is_told(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    argv = [str(BIN / "rce-robot"), "127.0.0.1", "--dev", "--log-dir", str(tmp_path / "file" / "logs")]
    program = Program("robot", argv, dict(os.environ), tmp_path)
    with pytest.raises(AssertionError, match="cannot write the log"):
        await program.start(timeout=60)

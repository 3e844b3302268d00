"""``rce-master`` and the ``rce`` commands for it as real processes."""

from __future__ import annotations

import asyncio
import os
import signal
import sys
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING

from support.forked_commands import run_command
from support.processes import finish

if TYPE_CHECKING:
    from pathlib import Path


def environment(folder: Path) -> dict[str, str]:
    return {
        **{key: value for key, value in os.environ.items() if not key.startswith("RCE_")},
        "RCE_SECRET": "a secret for the tests",
        "RCE_LOGIN_FILE": str(folder / "login.json"),
        "XDG_STATE_HOME": str(folder / "home"),
    }


async def rce(folder: Path, command: str, *args: str, text: str = "", code: int = 0) -> str:
    """Run a command of the ``rce`` program; returns what it printed."""
    ended, output = await run_command((command, *args), env=environment(folder), folder=folder, typed=text)
    assert ended == code, output
    return output


@asynccontextmanager
async def master(folder: Path, *args: str, end: signal.Signals = signal.SIGTERM) -> AsyncIterator[str]:
    """Run ``rce-master`` and give its address."""
    with (folder / "master.log").open("ab") as log:
        process = await asyncio.create_subprocess_exec(
            sys.executable,
            *(
                "-m",
                "rce_master",
                "--http-port",
                "0",
                "--control-port",
                "0",
                "--state-dir",
                str(folder / "state"),
            ),
            *args,
            stdout=asyncio.subprocess.PIPE,
            stderr=log,
            env=environment(folder),
        )
    try:
        assert process.stdout is not None
        line = (await asyncio.wait_for(process.stdout.readline(), 120)).decode()
        assert line.startswith("rce-master ready: http://127.0.0.1:"), line
        yield line.split()[-1]
    finally:
        await finish(process, end)
    assert process.returncode == (0 if end != signal.SIGKILL else -signal.SIGKILL)

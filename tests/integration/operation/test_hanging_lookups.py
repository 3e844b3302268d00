"""Programs end at once while a name server does not answer."""

from __future__ import annotations

import asyncio
import json
import signal
import sys
from pathlib import Path

import pytest
from support.resolvers import silent_resolver

pytestmark = pytest.mark.needs("netns")

HOST = "engine.example"
TIMEOUT_S = 60.0
"""Also on a busy machine; the name server answers none of its questions in twice this time."""

OWN_PORTS = ("--dev", "--ws-port", "0", "--link-port", "0", HOST)
PROGRAMS = {
    "rce-robot": ("rce-robot", *OWN_PORTS),
    "rce-container": (
        *("rce-container", "--dev", "--link-port", "0", "--runtime", "process", "--state-dir", "{folder}"),
        HOST,
    ),
    "rce-ros": ("rce-ros", "{folder}/robot.config"),
    "sync": ("rce", "sync"),
    "login": ("rce", "login", "--user", "me", "--password-stdin", f"http://{HOST}:9000/"),
}


@pytest.mark.parametrize("name", PROGRAMS)
async def test_program_ends_while_a_name_is_looked_up(name: str, tmp_path: Path) -> None:
    tmp_path.joinpath("robot.config").write_text(
        json.dumps({"url": f"http://{HOST}:9000/", "userID": "me", "password": "me", "robotID": "R1"})
    )
    argv = [word.format(folder=tmp_path) for word in PROGRAMS[name]]
    env = {
        "PATH": "/usr/sbin:/usr/bin:/sbin:/bin",
        "HOME": str(tmp_path),
        "XDG_RUNTIME_DIR": str(tmp_path),
        "ROS_MASTER_URI": f"http://{HOST}:11311/",
    }
    async with silent_resolver(tmp_path) as (resolver, asking):
        process = await asyncio.create_subprocess_exec(
            *asking,
            *(str(Path(sys.executable).parent / argv[0]), *argv[1:]),
            env=env,
            stdin=asyncio.subprocess.PIPE,
            stdout=asyncio.subprocess.PIPE,
            stderr=asyncio.subprocess.STDOUT,
        )
        assert process.stdin is not None
        process.stdin.write(b"secret\n")
        talk = asyncio.create_task(process.communicate())
        try:
            async with asyncio.timeout(TIMEOUT_S):
                await resolver.asked.wait()
                process.send_signal(signal.SIGINT)
                output, _ = await asyncio.shield(talk)
            assert resolver.questions, "it was answered"
            assert b"Traceback" not in output
        finally:
            if process.returncode is None:
                process.kill()
                await talk

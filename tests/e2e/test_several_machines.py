"""The how-to for several machines, run as it is written, on machines that are network namespaces."""

from __future__ import annotations

import asyncio
import os
import re
import shutil
import stat
import subprocess
import sys
from contextlib import AsyncExitStack
from pathlib import Path

import pytest
from support.engine import Program, until
from support.networks import NetworkMachine, network

pytestmark = [pytest.mark.e2e, pytest.mark.needs("root", "netns"), pytest.mark.timeout(300)]

PAGE = Path(__file__).parents[2] / "docs/how-to/several-machines.md"
ASK = Path(__file__).parents[1] / "support" / "ask.py"
MACHINES = ("master", "robots", "containers", "robot")
TIMEOUT_S = 120.0
PASSWORD = "a password of alice"


class Machine:
    """A machine of the page: a network namespace, a host name and a home of its own."""

    def __init__(self, name: str, place: NetworkMachine, folder: Path) -> None:
        self.name = name
        self.prefix = [*place.prefix, "unshare", "--uts", "sh", "-c", f'hostname {name}; exec "$@"', "sh"]
        self.home = folder / name
        self.home.mkdir()
        kept = {
            key: value for key, value in os.environ.items() if not key.startswith(("RCE_", "ROS_", "XDG_"))
        }
        self.env = kept | {
            "HOME": str(self.home),
            "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}",
            "PYTHONUNBUFFERED": "1",
            "XDG_RUNTIME_DIR": str(self.home),
        }

    async def run(self, script: str) -> str:
        """Run lines of the page, and return what they print."""
        process = await asyncio.create_subprocess_exec(
            *(*self.prefix, "bash", "-euc", script),
            env=self.env,
            cwd=self.home,
            stdout=asyncio.subprocess.PIPE,
            stderr=asyncio.subprocess.STDOUT,
        )
        output, _ = await process.communicate()
        assert process.returncode == 0, output.decode()
        return output.decode()

    async def serve(self, stack: AsyncExitStack, command: str, ready: str) -> Program:
        """Start a program of the page; it runs until the test ends."""
        argv = [*self.prefix, "bash", "-euc", f"cd; exec {command}"]
        program = Program(f"{self.name}-{command.split(maxsplit=1)[0]}", argv, self.env, self.home)
        stack.push_async_callback(_end, program)
        await program.start(ready=ready, timeout=TIMEOUT_S)
        return program


def blocks() -> dict[str, list[str]]:
    """The page's blocks by the machine, or file, that they are for."""
    found: dict[str, list[str]] = {}
    for machine, text in re.findall(
        r"^```(?:sh|yaml) (\S+)\n(.*?)^```", PAGE.read_text(), re.MULTILINE | re.DOTALL
    ):
        found.setdefault(machine, []).append(text.replace("10.0.0.", "10.77.0."))
    return found


async def _end(program: Program) -> None:
    if program.running:
        await program.stop()


async def test_how_to_for_several_machines(folder: Path) -> None:
    """A robot's message goes through endpoint and container on two other machines and back."""
    page = blocks()
    make_secret, run_master, log_in = page["master"]
    add_user, serve_master = run_master.strip().splitlines()
    with network(len(MACHINES)) as places:
        machines = [Machine(name, place, folder) for name, place in zip(MACHINES, places, strict=True)]
        master, robots, containers, robot = machines
        async with AsyncExitStack() as stack:
            await master.run(make_secret)
            secret = master.home / ".config/rce/secret"
            assert stat.S_IMODE(secret.stat().st_mode) == 0o600
            for other in (robots, containers):  # what scp does on the page
                (other.home / ".config/rce").mkdir(parents=True, mode=0o700)
                shutil.copy2(secret, other.home / ".config/rce/secret")
            (master.home / "password").write_text(f"{PASSWORD}\n")
            await master.run(add_user)
            await master.serve(stack, serve_master, "rce-master ready: ")
            await robots.serve(stack, page["robots"][0].strip(), "rce-robot ready: ")
            await containers.serve(stack, page["containers"][0].strip(), "rce-container ready: ")
            await master.run(log_in)

            async def both_there() -> bool:
                listing = await master.run("COLUMNS=200 rce machines")
                return "robots" in listing and "containers" in listing

            await until(both_there, timeout=TIMEOUT_S, what="both machines are listed")
            config = page["robot.config"][0].replace("PASSWORD", PASSWORD)
            (robot.home / "robot.config").write_text(config)
            await robot.serve(stack, "rce core", "ready:")
            await robot.serve(stack, page["robot"][0].strip(), "rce-ros ready: ")
            assert "answer: hello" in await robot.run(f"timeout 180 python -P {ASK} /request /answer")
            sockets = subprocess.run(
                [*places[1].prefix, "ss", "-tnH", "state", "established"],
                capture_output=True,
                text=True,
                check=True,
            ).stdout
            assert "10.77.0.3" in sockets, "endpoint and container are linked over the network"

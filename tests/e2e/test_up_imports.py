"""What the processes of ``rce up`` load, as the interpreter itself tells."""

from __future__ import annotations

import os
import re
import sys
from collections import defaultdict
from pathlib import Path

import pytest
from support.engine import Program
from support.ports import free_ports

pytestmark = [pytest.mark.e2e]

PORT_OPTIONS = ("--http-port", "--control-port", "--ws-port", "--robot-link-port", "--container-link-port")
IMPORT = re.compile(r"^(?:\[(\w+)\] )?import time: +(?:\d+|self \[us\]) \| +(?:\d+|cumulative) \| +(\S.*)$")
HEADER = "imported package"
"""First line that an interpreter writes of its imports; also after it was replaced by ``exec``."""

NOT_LOADED = {
    "up": (
        "pydantic",
        "typer",
        "yaml",
        "psutil",
        "aiohttp",
        "cryptography",
        "rce_master",
        "rce_robot",
        "rce_container",
    ),
    "master": (
        "aiohttp",
        "attr",
        "h11",
        "tarfile",
        "typer",
        "yaml",
        "cryptography",
        "prometheus_client",
        "PIL",
        "numpy",
        "rich",
        "psutil",
        "pydantic",
        "logging.handlers",
    ),
    "robot": (
        "typer",
        "yaml",
        "cryptography",
        "pydantic",
        "aiohttp",
        "h11",
        "PIL",
        "numpy",
        "rich",
        "psutil",
        "logging.handlers",
    ),
    "container": (
        "typer",
        "yaml",
        "cryptography",
        "pydantic",
        "aiohttp",
        "h11",
        "tarfile",
        "PIL",
        "numpy",
        "rich",
        "psutil",
        "logging.handlers",
    ),
}
LOADED = {
    "up": "uvloop",
    "master": "rce_master.program",
    "robot": "rce_robot.program",
    "container": "rce_container.program",
}
SHARED = ("msgspec", "asyncio", "uvloop", "websockets.asyncio.client", "rce.link.hub", "rce.control.messages")
"""Loaded once, by ``rce up``, of which the other programs are forks."""


def imports_of(output: str) -> dict[str, set[str]]:
    """Return the modules that each program loaded since it is what it is."""
    found: dict[str, set[str]] = defaultdict(set)
    for line in output.splitlines():
        if match := IMPORT.match(line):
            program, module = match[1] or "up", match[2].strip()
            if module == HEADER:
                found[program].clear()
            found[program].add(module)
    return found


async def test_programs_do_not_load_what_they_do_not_use(folder: Path) -> None:
    env = {key: value for key, value in os.environ.items() if not key.startswith(("RCE_", "ROS_"))}
    env |= {"XDG_RUNTIME_DIR": str(folder), "PYTHONPROFILEIMPORTTIME": "1"}
    ports = map(str, free_ports(len(PORT_OPTIONS)))
    options = [text for pair in zip(PORT_OPTIONS, ports, strict=True) for text in pair]
    argv = [str(Path(sys.executable).parent / "rce"), "up", "--dev", "--state-dir", str(folder / "state")]
    up = Program("up", [*argv, "--runtime", "process", *options], env, folder)
    await up.start(ready="RCE ready:")
    assert await up.stop() == 0
    found = imports_of(up.output())
    for program, modules in NOT_LOADED.items():
        assert LOADED[program] in found[program], program
        loaded = found["up"] | found[program]
        wrong = {name for name in loaded for module in modules if f"{name}.".startswith(f"{module}.")}
        assert not wrong, program
        assert found[program].isdisjoint(SHARED) == (program != "up"), program
    assert found["up"].issuperset(SHARED)

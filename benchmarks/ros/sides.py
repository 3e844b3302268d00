"""The libraries that are measured: how their programs are started."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

PROGRAMS = Path(__file__).parent / "programs"
SYSTEM_PYTHON = "/usr/bin/python3"
END_TIMEOUT_S = 10.0


@dataclass(frozen=True)
class Side:
    """One library, in one way of using it."""

    name: str
    argv: tuple[str, ...]
    env: dict[str, str] = field(default_factory=dict)
    words: frozenset[str] = frozenset()
    """Its commands beyond echo and idle."""

    def start(self, uri: str, *words: str) -> subprocess.Popen[str]:
        """Start its program at a master."""
        kept = {k: v for k, v in os.environ.items() if not k.startswith(("PYTHON", "VIRTUAL_ENV", "ROS_"))}
        env = kept | self.env | {"ROS_MASTER_URI": uri, "ROS_IP": "127.0.0.1"}
        return subprocess.Popen(
            [*self.argv, *words], env=env, stdout=subprocess.PIPE, text=True, start_new_session=True
        )

    @contextlib.contextmanager
    def running(self, uri: str, *words: str) -> Iterator[subprocess.Popen[str]]:
        """Run its program until the block ends, once it is ready."""
        process = self.start(uri, *words)
        assert process.stdout is not None
        try:
            while "ready" not in (line := process.stdout.readline()):
                if not line:
                    raise RuntimeError(f"{self.name} {words} ended")
            yield process
        finally:
            end(process)

    def result(self, uri: str, *words: str) -> Any:
        """Run its program until it prints a result."""
        process = self.start(uri, *words)
        try:
            found = result_of(process)
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(END_TIMEOUT_S)
        finally:
            end(process)
        return found


def result_of(process: subprocess.Popen[str]) -> Any:
    """The JSON object that a program prints; what else it prints is skipped."""
    assert process.stdout is not None
    for line in process.stdout:
        if line.startswith("{"):
            return json.loads(line)
    raise RuntimeError(f"{process.args!r} printed no result")


def end(process: subprocess.Popen[str]) -> None:
    """Interrupt a program; kill it if that does not help."""
    if process.poll() is None:
        process.send_signal(signal.SIGINT)
    try:
        process.wait(END_TIMEOUT_S)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
    if process.stdout is not None:
        process.stdout.close()


def sides(scratch: Path) -> list[Side]:
    """All libraries that can be measured on this machine."""
    root = str(Path(__file__).parents[2])
    every = frozenset({"talk", "listen", "serve", "call", "beat"})
    found = [Side("ours", (sys.executable, str(PROGRAMS / "ours.py")), {"PYTHONPATH": root}, every)]
    probe = [SYSTEM_PYTHON, "-c", "import rospy, std_msgs, std_srvs"]
    if (
        Path(SYSTEM_PYTHON).exists()
        and subprocess.run(probe, capture_output=True, check=False).returncode == 0
    ):
        argv = (SYSTEM_PYTHON, str(PROGRAMS / "rospy_side.py"))
        found.append(Side("rospy", argv, {}, every))
        found.append(Side("rospy blocking", argv, {"QUEUE": "0"}, frozenset({"talk", "listen"})))
    compiled = _compile(scratch)
    if compiled is not None:
        found.append(Side("roscpp", (str(compiled),)))
    return found


def _compile(scratch: Path) -> Path | None:
    if shutil.which("g++") is None or shutil.which("pkg-config") is None:
        return None
    flags = subprocess.run(
        ["pkg-config", "--cflags", "--libs", "roscpp"], capture_output=True, text=True, check=False
    )
    if flags.returncode:
        return None
    target = scratch / "roscpp_side"
    source = PROGRAMS / "roscpp_side.cpp"
    subprocess.run(["g++", "-O2", "-o", str(target), str(source), *flags.stdout.split()], check=True)
    return target

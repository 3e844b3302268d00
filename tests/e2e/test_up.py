"""``rce up``: a whole engine in one terminal."""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import sys
from collections.abc import AsyncIterator
from functools import partial
from pathlib import Path

import psutil
import pytest
from support.engine import Program, command_line, engine_processes, until
from support.ports import free_ports
from support.stranger import check_echo, stranger, wire_echo

pytestmark = [pytest.mark.e2e]

PORT_OPTIONS = ("--http-port", "--control-port", "--ws-port", "--robot-link-port", "--container-link-port")


@contextlib.asynccontextmanager
async def rce_up(folder: Path, ports: list[int], *arguments: str) -> AsyncIterator[Program]:
    env = {key: value for key, value in os.environ.items() if not key.startswith(("RCE_", "ROS_"))}
    options = [text for pair in zip(PORT_OPTIONS, map(str, ports), strict=True) for text in pair]
    argv = [str(Path(sys.executable).parent / "rce"), "up", "--dev", "--state-dir", str(folder / "state")]
    up = Program("up", [*argv, *options, *arguments], env | {"XDG_RUNTIME_DIR": str(folder)}, folder)
    try:
        yield up
    finally:
        if up.running:
            await up.stop()


def pid_of(folder: Path, module: str) -> int | None:
    for process in engine_processes(folder):
        with contextlib.suppress(psutil.NoSuchProcess, psutil.ZombieProcess):
            if command_line(process)[1:4] == ["-P", "-m", module]:
                return process.pid
    return None


def _has_another(folder: Path, module: str, old: int) -> bool:
    """Whether a program runs again with another pid."""
    return pid_of(folder, module) not in (None, old)


async def test_serves_robots_and_stops_on_ctrl_c(folder: Path) -> None:
    ports = free_ports(5)
    async with rce_up(folder, ports, "--runtime", "process") as up:
        await up.start(ready=f"RCE ready: http://127.0.0.1:{ports[0]}/")
        async with stranger(f"http://127.0.0.1:{ports[0]}/") as client:
            await wire_echo(client)
            await check_echo(client, "hello")
            assert up.process is not None
            os.kill(up.pid, signal.SIGINT)
            await up.process.wait()
        assert up.process.returncode == 0, up.output()


async def test_restarts_a_task_set_that_died(folder: Path) -> None:
    ports = free_ports(5)
    url = f"http://127.0.0.1:{ports[0]}/"
    async with rce_up(folder, ports, "--runtime", "process") as up:
        await up.start(ready="RCE ready:")
        manager = pid_of(folder, "rce_container")
        assert manager is not None
        os.kill(manager, signal.SIGUSR1)
        await until(lambda: up.output().count("rce-container ready") > 1, what="the manager is there anew")
        assert pid_of(folder, "rce_container") == manager
        for module in ("rce_master", "rce_robot", "rce_container"):
            old = pid_of(folder, module)
            assert old is not None
            os.kill(old, signal.SIGKILL)
            await until(partial(_has_another, folder, module, old), what=f"{module} is started again")
        await until(lambda: up.output().count("rce-robot ready") > 1, what="the robot task set is ready")
        async with stranger(url) as client:
            await wire_echo(client)
            await check_echo(client, "hello")
        assert await up.stop() == 0


async def test_a_port_that_is_taken_is_a_clear_error(folder: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        async with rce_up(folder, [port, *free_ports(4)]) as up:
            with pytest.raises(AssertionError, match="ended with 1"):
                await up.start(ready="RCE ready:")
    assert str(port) in up.output()


async def test_a_bad_settings_file_lists_its_faults(folder: Path) -> None:
    settings = folder / "engine.yaml"
    settings.write_text("master:\n  http_port: many\nrobot:\n  cuont: 2\n")
    async with rce_up(folder, free_ports(5), str(settings)) as up:
        with pytest.raises(AssertionError, match="ended with 2"):
            await up.start(ready="RCE ready:")
    assert "master.http_port" in up.output()
    assert "robot.cuont" in up.output()


async def test_programs_load_nothing_from_the_working_folder(folder: Path) -> None:
    """``rce up`` starts in whatever folder its user is in; its files are not modules."""
    (folder / "json.py").write_text("raise SystemExit('loaded from the working folder')\n")
    (folder / "uvloop.py").write_text("raise SystemExit('loaded from the working folder')\n")
    with contextlib.chdir(folder):
        async with rce_up(folder, free_ports(5), "--runtime", "process") as up:
            await up.start(ready="RCE ready:")
            assert await up.stop() == 0
    assert "loaded from" not in up.output()

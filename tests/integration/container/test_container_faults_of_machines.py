"""Machines that lack something, or have what the dead left: ``rce-container`` says what to do, or does it."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from support.engine import Program, until

from rce_container.environment import proc
from tools.leaks import Traces, sweep_cgroups

BIN = Path(sys.executable).parent
WITHOUT_USER_NAMESPACES = (
    "bwrap",
    "--unshare-user",
    "--uid",
    "1000",
    "--disable-userns",
    "--dev-bind",
    "/",
    "/",
)


@pytest.fixture
def container(folder: Path) -> Iterator[Program]:
    """``rce-container`` without a master."""
    env = {key: value for key, value in os.environ.items() if not key.startswith(("RCE_", "ROS_"))}
    argv = [str(BIN / "rce-container"), "127.0.0.1", "--control-port", "1", "--link-port", "0"]
    argv += ["--state-dir", str(folder / "state"), "--dev"]
    yield Program("rce-container", argv, {**env, "XDG_RUNTIME_DIR": str(folder)}, folder)
    sweep_cgroups(folder)


async def refuses(container: Program) -> str:
    """Start it, which does not work; returns what it says."""
    with pytest.raises(AssertionError, match="ended with 1"):
        await container.start()
    (text,) = [line for line in container.output().splitlines() if line.startswith("rce-container: ")]
    return text


async def test_bubblewrap_is_missing(container: Program) -> None:
    container.env["PATH"] = str(BIN)
    words = "bwrap is not installed (Debian, Ubuntu: apt install bubblewrap)"
    await container.start(ready="runtime=process")
    assert words in container.output()
    assert "containers are NOT isolated" in container.output()
    assert await container.stop() == 0
    container.argv += ["--runtime", "namespace"]
    assert words in await refuses(container)


@pytest.mark.needs("bwrap")
async def test_user_namespaces_are_forbidden(container: Program, folder: Path) -> None:
    container.argv = [*WITHOUT_USER_NAMESPACES, *container.argv]
    await container.start(ready="runtime=process")
    words = "a normal user needs user namespaces for that; see the sysctls user.max_user_namespaces"
    assert words in container.output(), container.output()
    assert "containers are NOT isolated" in container.output()
    (inner,) = [one for one in Traces(folder).look() if one.parent == container.pid]
    os.kill(inner.pid, signal.SIGTERM)
    assert container.process is not None
    assert await container.process.wait() == 0
    container.argv += ["--runtime", "namespace"]
    assert words in await refuses(container)


async def test_the_link_port_is_taken(container: Program) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        container.argv += ["--link-port", str(port), "--runtime", "process"]
        assert str(port) in (text := await refuses(container)), text
        assert "in use" in text


@pytest.mark.needs("root")
async def test_the_disk_is_full_from_the_start(container: Program, folder: Path) -> None:
    disk = folder / "disk"
    disk.mkdir()
    subprocess.run(["mount", "-t", "tmpfs", "-o", "size=4k", "tmpfs", str(disk)], check=True)
    try:
        (disk / "ballast").write_bytes(b"x" * 4096)
        container.argv += ["--state-dir", str(disk / "state"), "--runtime", "process"]
        text = await refuses(container)
        assert str(disk) in text
        assert "No space left" in text
    finally:
        subprocess.run(["umount", "--lazy", str(disk)], check=True)


async def test_what_a_crash_left_is_removed_and_nobody_else_is_harmed(
    container: Program, folder: Path
) -> None:
    container.argv += ["--runtime", "process"]
    await container.start()
    await container.kill()
    state, token = folder / "state", (folder / "state" / "run").read_text()
    run = next(path for path in folder.rglob(f"c-{token}"))
    me = proc.read(os.getpid())
    assert me is not None
    one, other, third = (number * 12 for number in "012")
    reused = {"id": "u/b", "mark": other, "runtime": "process", "pid": me.pid, "start": 1}
    gone = {"id": "u/b", "mark": third, "runtime": "of old", "pid": 1 << 22, "start": 1}
    records = {one: "", other: json.dumps(reused), third: json.dumps(gone)}
    for incarnation_id, record in records.items():
        for parent in (state / "containers", run):
            (parent / incarnation_id / "home").mkdir(parents=True)
        (state / "containers" / incarnation_id / "record.json").write_text(record)
        with socket.socket(socket.AF_UNIX) as stale:
            stale.bind(str(run / incarnation_id / "control.sock"))
    (state / "containers" / other / "home").chmod(0)
    (state / "cgroups").write_text("/sys/fs/cgroup/nowhere/rce-x\n\n")
    (state / "name").write_text("\x00")
    traces = Traces(folder)
    await container.start()
    await until(lambda: not traces.left({container.pid}), what="all of it is removed")
    assert await container.stop() == 0
    assert not run.exists()
    assert proc.same(me, proc.read(os.getpid()))


def test_a_child_that_ended_at_once_is_identified() -> None:
    """The kernel keeps its entry until it is waited for; a manager takes it for one that ended later."""
    child = subprocess.Popen(["/bin/true"])
    os.waitid(os.P_PID, child.pid, os.WEXITED | os.WNOWAIT)
    assert proc.read(child.pid) is None
    found = proc.read(child.pid, zombies=True)
    assert found is not None
    assert (found.pid, found.parent) == (child.pid, os.getpid())
    assert child.wait() == 0
    assert proc.read(child.pid, zombies=True) is None

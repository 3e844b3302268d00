"""``rce launch`` with real processes: master, parameters, respawn, required nodes, the end of all."""

from __future__ import annotations

import asyncio
import contextlib
import os
import re
import signal
import sys
import xmlrpc.client
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from pathlib import Path

import pytest
from support.ports import free_port

from rce.ros.core import Core
from rce.ros.launch import LaunchPlan
from rce.ros.launch.exceptions import Place
from rce.ros.launch.plan import NodePlan
from rce.ros.launching import Launcher
from rce.ros.launching.graph import LaunchGraph
from rce.ros.node import Node
from rce.ros.packages import PackageIndex

WAIT_S = 90.0
RCE = str(Path(sys.executable).with_name("rce"))


class Running:
    """A running ``rce launch``."""

    def __init__(self, process: asyncio.subprocess.Process, folder: Path, uri: str) -> None:
        self.process = process
        self.folder = folder
        self.uri = uri
        self.lines: list[str] = []
        self._new = asyncio.Condition()

    async def read(self) -> None:
        assert self.process.stdout is not None
        async for line in self.process.stdout:
            async with self._new:
                self.lines.append(line.decode().rstrip())
                self._new.notify_all()
        async with self._new:
            self.lines.append("(end)")
            self._new.notify_all()

    async def until(self, condition: Callable[[list[str]], bool]) -> None:
        """Wait until the lines printed so far fulfil a condition."""
        try:
            async with asyncio.timeout(WAIT_S), self._new:
                await self._new.wait_for(lambda: condition(self.lines))
        except TimeoutError:
            raise AssertionError("\n".join(self.lines)) from None

    async def has(self, text: str, count: int = 1) -> None:
        await self.until(lambda lines: sum(text in line for line in lines) >= count)

    async def code(self) -> int:
        """Wait for its end and its last line; return its exit code."""
        await self.until(lambda lines: lines[-1:] == ["(end)"])
        async with asyncio.timeout(WAIT_S):
            return await self.process.wait()


SCRIPTS = {
    "sleeper": "exec sleep 1000",
    "stubborn": "trap '' INT TERM; echo deaf; while true; do sleep 1; done",
    "parent": "sleep 1000 & echo child $!; exec sleep 1000",
    "short": "echo args $*; exit ${1:-0}",
    "show": 'echo "$ROS_NAMESPACE $WORD $(pwd) $*"',
}


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    package = tmp_path / "tools"
    package.mkdir()
    (package / "package.yaml").write_text("name: tools\n")
    for name, text in SCRIPTS.items():
        (package / name).write_text(f"#!/bin/sh\n{text}\n")
        (package / name).chmod(0o755)
    return tmp_path


@asynccontextmanager
async def launched(folder: Path, text: str, *words: str, uri: str = "") -> AsyncIterator[Running]:
    """``rce launch`` of a file; killed with its nodes at the end if it still runs."""
    uri = uri or f"http://127.0.0.1:{free_port()}/"
    file = folder / "main.launch"
    file.write_text(f"<launch>{text}</launch>")
    env = {**os.environ, "ROS_MASTER_URI": uri, "RCE_PACKAGE_PATH": str(folder), "PYTHONUNBUFFERED": "1"}
    env |= {"ROS_LOG_DIR": str(folder / "log"), "ROS_HOME": str(folder / "home")}
    process = await asyncio.create_subprocess_exec(
        *(RCE, "launch", str(file), *words),
        env=env,
        stdout=asyncio.subprocess.PIPE,
        stderr=asyncio.subprocess.STDOUT,
    )
    running = Running(process, folder, uri)
    reading = asyncio.create_task(running.read())
    try:
        yield running
    finally:
        if process.returncode is None:
            process.terminate()
            await running.code()
        await reading


def is_alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    return state != "Z"


async def gone(pid: int) -> None:
    async with asyncio.timeout(WAIT_S):
        while is_alive(pid):
            await asyncio.sleep(0.05)


def pid_in(lines: list[str], text: str) -> int:
    return int(next(line for line in lines if text in line).split()[-1])


async def test_a_master_is_started_and_everything_ends(folder: Path) -> None:
    text = '<param name="a" value="5"/><node pkg="tools" type="parent" name="p" output="screen"/>'
    async with launched(folder, text) as running:
        await running.has("child")
        assert any(line == f"ROS_MASTER_URI={running.uri} (started here)" for line in running.lines)
        async with Node("judge", argv=[], master_uri=running.uri) as judge:
            assert await judge.get_param("/a") == 5
        pids = [pid_in(running.lines, "started with pid"), pid_in(running.lines, "child")]
        running.process.send_signal(signal.SIGINT)
        assert await running.code() == 0
    assert not any(map(is_alive, pids))


async def test_a_running_master_is_used_and_stays(folder: Path) -> None:
    async with Core(port=0) as core, Node("judge", argv=[], master_uri=core.uri) as judge:
        await judge.set_param("/old", {"a": 1, "b": 2})
        await judge.set_param("/other", 1)
        text = f"""<rosparam command="dump" file="{folder}/dump.yaml" param="other"/>
            <rosparam command="delete" param="other"/><group ns="old" clear_params="true"/>
            <param name="old/c" value="3"/><node pkg="tools" type="short" name="n"/>"""
        async with launched(folder, text, uri=core.uri) as running:
            assert await running.code() == 0
        assert await judge.get_param("/old") == {"c": 3}
        assert not await judge.has_param("/other")
    assert (folder / "dump.yaml").read_text().split() == ["1", "..."]
    assert "all nodes have ended" in running.lines


async def test_names_variables_folder_and_files(folder: Path) -> None:
    text = """<env name="WORD" value="hello"/><group ns="a"><remap from="x" to="y"/>
        <node pkg="tools" type="show" name="n" args="one 'two words'" output="screen"
          launch-prefix="env WORD=hi"/>
        <node pkg="tools" type="show" name="m" cwd="node"/></group>"""
    async with launched(folder, text) as running:
        assert await running.code() == 0
    shown = next(line for line in running.lines if line.startswith("/a "))
    assert shown.startswith(f"/a hi {folder}/home one two words x:=y __name:=n __log:={folder}/log/")
    files = sorted(path.name for path in (folder / "log" / "latest").iterdir())
    assert files == ["a-m-2-stdout.log", "rosout.log"]
    written = (folder / "log" / "latest" / "a-m-2-stdout.log").read_text()
    assert written.startswith(f"/a hello {folder}/tools x:=y __name:=m __log:=")


async def test_a_node_that_ends_is_started_again(folder: Path) -> None:
    text = """<node pkg="tools" type="short" name="a" respawn="true" respawn_delay="0.1"/>
        <node pkg="tools" type="short" name="b"/>"""
    async with launched(folder, text) as running:
        await running.has("/a: started with pid", 3)
        await running.has("/b: ended")
        assert sum("/b: started" in line for line in running.lines) == 1
        running.process.send_signal(signal.SIGINT)
        assert await running.code() == 0


async def test_respawn_makes_a_purged_log_folder_again(folder: Path) -> None:
    text = '<node pkg="tools" type="short" name="a" respawn="true" respawn_delay="0.1"/>'
    async with launched(folder, text) as running:
        await running.has("/a: started with pid")
        (folder / "log").rename(folder / "purged")
        async with asyncio.timeout(WAIT_S):
            while not list((folder / "log").glob("*/a-1-stdout.log")):
                await asyncio.sleep(0.05)


async def test_respawn_tries_again_when_a_start_fails(folder: Path) -> None:
    text = '<node pkg="tools" type="short" name="a" respawn="true" respawn_delay="0.1"/>'
    program = folder / "tools" / "short"
    async with launched(folder, text) as running:
        await running.has("/a: started with pid")
        program.rename(folder / "away")
        await running.has("/a: cannot be started: No such file or directory", 2)
        (folder / "away").rename(program)
        starts = sum("/a: started" in line for line in running.lines)
        await running.has("/a: started with pid", starts + 1)


async def test_stop_while_parameters_are_set_starts_no_node(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    apply = LaunchGraph.apply

    async def stop_meanwhile(graph: LaunchGraph, plan: LaunchPlan) -> None:
        launcher.stop()
        await apply(graph, plan)

    monkeypatch.setattr(LaunchGraph, "apply", stop_meanwhile)
    plan = LaunchPlan([NodePlan("/a", "tools", "sleeper", Place("main.launch", 1))], {"/p": 1})
    lines: list[str] = []
    async with Core(port=0) as core:
        launcher = Launcher(plan, PackageIndex([folder]), core.uri, None, report=lines.append)
        assert await launcher.run() == 0
        assert core.get_param("/p") == 1
    assert lines == [f"ROS_MASTER_URI={core.uri}"]


@pytest.mark.parametrize("code", [0, 3])
async def test_the_end_of_a_required_node_ends_all(folder: Path, code: int) -> None:
    text = f"""<node pkg="tools" type="sleeper" name="s"/>
        <node pkg="tools" type="short" name="r" args="{code}" required="true"/>"""
    async with launched(folder, text) as running:
        assert await running.code() == (1 if code else 0)
    assert any("/r is required and ended" in line for line in running.lines)
    assert not is_alive(pid_in(running.lines, "/s: started"))


async def test_a_deaf_node_is_killed(folder: Path) -> None:
    text = '<node pkg="tools" type="stubborn" name="s" output="screen"/>'
    async with launched(folder, text, "--sigint-timeout", "0.3", "--sigterm-timeout", "0.3") as running:
        await running.until(lambda lines: "deaf" in lines)
        running.process.send_signal(signal.SIGTERM)
        assert await running.code() == 0
    told = [line for line in running.lines if "did not end" in line]
    assert told == ["/s: did not end on SIGINT", "/s: did not end on SIGTERM"]
    assert not is_alive(pid_in(running.lines, "/s: started"))


async def test_a_second_interrupt_does_not_wait(folder: Path) -> None:
    text = '<node pkg="tools" type="stubborn" name="s" output="screen"/>'
    async with launched(folder, text, "--sigint-timeout", "500", "--sigterm-timeout", "500") as running:
        await running.until(lambda lines: "deaf" in lines)
        running.process.send_signal(signal.SIGINT)
        await asyncio.sleep(0.5)
        running.process.send_signal(signal.SIGINT)
        await running.has("did not end on SIGINT")
        running.process.send_signal(signal.SIGINT)
        assert await running.code() == 0


async def test_a_killed_launcher_leaves_no_node(folder: Path) -> None:
    async with launched(folder, '<node pkg="tools" type="sleeper" name="s"/>') as running:
        await running.has("started with pid")
        running.process.kill()
        await running.code()
        await gone(pid_in(running.lines, "started with pid"))


async def test_a_missing_executable_is_reported(folder: Path) -> None:
    text = '<node pkg="tools" type="none" name="a"/>\n<node pkg="nowhere" type="x" name="b"/>'
    async with launched(folder, text + '<node pkg="tools" type="short" name="c"/>') as running:
        assert await running.code() == 1
    assert any(
        "main.launch:1: <node>: /a (tools/none): package tools has no exec" in x for x in running.lines
    )
    assert any("main.launch:2: <node>: /b (nowhere/x): no package 'nowhere'" in x for x in running.lines)
    assert any("/c: started" in line for line in running.lines)


async def test_a_master_elsewhere_is_not_started(folder: Path) -> None:
    async with launched(folder, "", uri="http://192.0.2.1:1/") as running:
        assert await running.code() == 1
    assert "192.0.2.1 is not an address of this machine" in running.lines[-2]


@asynccontextmanager
async def leaving_master(last: bytes) -> AsyncIterator[str]:
    """A master that answers every call with success, until it drops the connection of a method."""

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        with contextlib.suppress(asyncio.IncompleteReadError, ConnectionError):
            while True:
                head = await reader.readuntil(b"\r\n\r\n")
                (size,) = re.findall(rb"(?i)content-length: *(\d+)", head)
                if last in await reader.readexactly(int(size)):
                    break
                body = xmlrpc.client.dumps(((1, "", 1),), methodresponse=True).encode()
                writer.write(b"HTTP/1.1 200 OK\r\nContent-Type: text/xml\r\n")
                writer.write(b"Content-Length: %d\r\n\r\n%b" % (len(body), body))
        writer.close()

    async with await asyncio.start_server(serve, "127.0.0.1") as server:
        yield f"http://127.0.0.1:{server.sockets[0].getsockname()[1]}/"


@pytest.mark.parametrize("method", ["getParam", "setParam", "hasParam"])
async def test_a_master_that_goes_away_is_one_line(folder: Path, method: str) -> None:
    text = '<rosparam command="delete" param="/old"/><param name="x" value="1"/>'
    text += '<node name="a" pkg="tools" type="sleeper"/>'
    async with leaving_master(method.encode()) as uri, launched(folder, text, uri=uri) as run:
        assert await run.code() == 1
        assert not [line for line in run.lines if "Traceback" in line]
        assert [line for line in run.lines if f"{uri} does not answer" in line and method in line]


async def test_launch_waits_for_a_master(folder: Path) -> None:
    port = free_port()
    text = '<node pkg="tools" type="short" name="n"/>'
    async with launched(folder, text, "--wait", uri=f"http://127.0.0.1:{port}/") as running:
        await asyncio.sleep(0.5)
        async with Core(port=port):
            assert await running.code() == 0


async def test_run_starts_one_node(folder: Path) -> None:
    env = {**os.environ, "RCE_PACKAGE_PATH": str(folder)}
    process = await asyncio.create_subprocess_exec(
        *(RCE, "run", "tools", "short", "4", "--flag", "x:=y"),
        env=env,
        stdout=asyncio.subprocess.PIPE,
    )
    output, _ = await process.communicate()
    assert (process.returncode, output.decode().strip()) == (4, "args 4 --flag x:=y")

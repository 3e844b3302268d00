"""``rce exec`` and the tools for a container's ROS graph, as programs, from outside."""

from __future__ import annotations

import array
import asyncio
import contextlib
import fcntl
import json
import os
import signal
import termios
from collections.abc import AsyncIterator, Iterator

import aiohttp
import msgspec
import psutil
import pytest
import pytest_asyncio
from support.engine import Engine, running_engine, until
from support.owner import Owner
from support.stranger import stranger
from websockets.asyncio.client import connect
from websockets.exceptions import ConnectionClosedOK

from rce.control.execution import (
    MAX_DATA,
    MIN_WINDOW,
    NOT_RUN,
    WINDOW,
    Command,
    Frame,
    Part,
    amount_frame,
    decode,
    read_amount,
    read_ended,
)
from rce_master.cli.execute import STUCK_S

RUNTIMES = ["process", pytest.param("namespace", marks=pytest.mark.needs("bwrap"))]
NODE = {"containerTag": "box", "nodeTag": "echo", "pkg": "Test", "exe": "stringEcho.py"}

PIPE = 64 << 10
"""Bytes that a pipe holds."""

IN_PROCESSES = pytest.mark.parametrize("shared_engine", ["process"], indirect=True, scope="module")

pytestmark = [pytest.mark.e2e, pytest.mark.timeout(180), pytest.mark.asyncio(loop_scope="module")]


@pytest_asyncio.fixture(scope="module", loop_scope="module", params=RUNTIMES)
async def shared_engine(request: pytest.FixtureRequest) -> AsyncIterator[Engine]:
    """An engine with a container ``box`` in which a node runs."""
    async with running_engine(runtime=request.param) as engine:
        async with stranger(engine.url, robot="r") as robot:
            await robot.send("CC", {"containerTag": "box"})
            await robot.send("CN", {"addNodes": [NODE]})
            await until(lambda: _runs(engine), timeout=60, what="the node runs")
        yield engine


@pytest_asyncio.fixture(scope="module", loop_scope="module")
async def owner(shared_engine: Engine) -> Owner:
    """The owner of ``box``, logged in."""
    made = Owner(shared_engine, "testUser")
    await made.login()
    return made


def _runs(engine: Engine) -> bool:
    nodes = engine.get("/api/v1/nodes")["nodes"]
    return bool(nodes) and bool(nodes[0]["pid"])


def runs(engine: Engine, command: str) -> bool:
    """Whether a command itself runs; not the tool that has it in its own command line."""
    argv = command.split()
    for process in engine.processes_of(command):
        with contextlib.suppress(psutil.NoSuchProcess):
            if process.cmdline() == argv:
                return True
    return False


async def execute(owner: Owner, *words: str, typed: bytes = b"") -> tuple[int, bytes, bytes]:
    process = await owner.start("exec", *words)
    output, error = await process.communicate(typed)
    assert process.returncode is not None
    return process.returncode, output, error


async def test_commands_run_with_their_streams_and_exit_codes(shared_engine: Engine, owner: Owner) -> None:
    assert await execute(owner, "box", "--", "sh", "-c", "echo out; echo err >&2; exit 7") == (
        7,
        b"out\n",
        b"err\n",
    )
    data = os.urandom(3_000_000)
    assert await execute(owner, "box", "cat", typed=data) == (0, data, b"")
    refused = await owner.run("exec", "box", "nosuch")
    assert refused == (127, "rce: nosuch: No such file or directory\n")
    assert (await owner.run("exec", "box", "sh", "-c", "kill -9 $$"))[0] == 137
    assert await owner.run("exec", "nobox", "ls") == (125, "rce: there is no container 'nobox'\n")
    code, output, _ = await execute(owner, "-t", "box", "sh", "-c", "test -t 0 && stty size")
    assert code == 0
    assert len(output.split()) == 2
    # What a command leaves in the background ends with it.
    await owner.rce("exec", "box", "sh", "-c", "sleep 4321 & sleep 4321 & echo")
    await until(lambda: not runs(shared_engine, "sleep 4321"), what="nothing is left of the command")
    # The pipe is not read: the command waits, and neither it nor the engine keeps much of what it writes.
    stuck = await owner.start("exec", "box", "yes")
    assert stuck.stdout is not None
    await stuck.stdout.read(1)
    stuck.kill()
    await stuck.communicate()
    await until(lambda: not runs(shared_engine, "yes"), what="the command ended with its user")


async def test_a_shell_in_a_terminal(shared_engine: Engine, owner: Owner) -> None:
    ours, theirs = os.openpty()
    shell = await owner.start("exec", "box", stdin=theirs, stdout=theirs, stderr=theirs)
    os.close(theirs)
    loop = asyncio.get_running_loop()
    seen, ended = bytearray(), asyncio.Event()

    def read() -> None:
        try:
            data = os.read(ours, 65536)
        except OSError:  # the last process closed it
            data = b""
        seen.extend(data)
        if not data:
            loop.remove_reader(ours)
            ended.set()

    loop.add_reader(ours, read)
    os.write(ours, b"echo $((6 * 7))x\n")
    await until(lambda: b"42x" in seen, timeout=30, what="an answer")
    os.write(ours, b"sleep 5432\n")
    await until(lambda: runs(shared_engine, "sleep 5432"), what="the shell's command runs")
    os.write(ours, b"\x03")  # Ctrl-C is the command's, not the tool's
    await until(lambda: not runs(shared_engine, "sleep 5432"), what="the shell's command is interrupted")
    os.write(ours, b"exit 3\n")
    assert await asyncio.wait_for(shell.wait(), 60) == 3
    loop.remove_reader(ours)
    os.close(ours)


@IN_PROCESSES
async def test_signals_reach_the_command(shared_engine: Engine, owner: Owner) -> None:
    script = "trap 'echo caught; exit 9' INT; echo ready; while :; do sleep 0.1; done"
    process = await owner.start("exec", "box", "--", "sh", "-c", script)
    assert process.stdout is not None
    assert await process.stdout.readline() == b"ready\n"
    process.send_signal(signal.SIGINT)
    output, _ = await process.communicate()
    assert (process.returncode, output) == (9, b"caught\n")
    killed = await owner.start("exec", "box", "sleep", "6543")
    await until(lambda: runs(shared_engine, "sleep 6543"), what="the command runs")
    killed.kill()
    await killed.communicate()
    await until(lambda: not runs(shared_engine, "sleep 6543"), what="it ended with its user")


@IN_PROCESSES
async def test_signals_pass_input_that_is_not_read(shared_engine: Engine, owner: Owner) -> None:
    process = await owner.start("exec", "box", "sleep", "6544")
    assert process.stdin is not None
    await until(lambda: runs(shared_engine, "sleep 6544"), what="the command runs")
    process.stdin.write(bytes(8_000_000))
    waiting, before = process.stdin.transport.get_write_buffer_size, 0
    while not before or waiting() < before:  # it takes a few hundred thousand bytes
        before = waiting()
        await asyncio.sleep(1.0)
    process.send_signal(signal.SIGINT)
    async with asyncio.timeout(60):
        await process.communicate()
    assert process.returncode == 130


@pytest.fixture
def pipe() -> Iterator[tuple[int, int]]:
    """A pipe for a program's output, which the test reads or leaves unread."""
    ours, theirs = os.pipe()
    fcntl.fcntl(theirs, fcntl.F_SETPIPE_SZ, PIPE)
    yield ours, theirs
    os.close(ours)
    with contextlib.suppress(OSError):  # closed by the test
        os.close(theirs)


def unread(fd: int) -> int:
    """How many bytes wait in a pipe."""
    amount = array.array("i", [0])
    fcntl.ioctl(fd, termios.FIONREAD, amount)
    return amount[0]


@IN_PROCESSES
async def test_a_slow_reader_gets_all_output(
    shared_engine: Engine, owner: Owner, pipe: tuple[int, int]
) -> None:
    """Also what the command wrote before it ended, long ago."""
    ours, theirs = pipe
    # The command can end, and a part of its output waits in the container.
    amount = PIPE + WINDOW - MAX_DATA + PIPE // 2
    process = await owner.start("exec", "box", "head", "-c", str(amount), "/dev/zero", stdout=theirs)
    os.close(theirs)
    await until(lambda: unread(ours) == PIPE, what="the pipe is full")
    ended = lambda: not runs(shared_engine, f"head -c {amount} /dev/zero")  # noqa: E731 - a short condition
    await until(ended, what="the command has ended")
    await asyncio.sleep(8)  # longer than the engine waits for users that take nothing
    with open(ours, "rb", closefd=False) as output:
        assert await asyncio.to_thread(output.read) == bytes(amount)
    assert (await process.communicate())[1] == b""
    assert process.returncode == 0


@IN_PROCESSES
async def test_a_second_signal_ends_a_program_whose_output_is_not_read(
    shared_engine: Engine, owner: Owner, pipe: tuple[int, int]
) -> None:
    for number in (signal.SIGINT, signal.SIGTERM):
        process = await owner.start("exec", "box", "yes", stdout=pipe[1])
        await until(lambda: unread(pipe[0]) == PIPE, what="the pipe is full")
        await asyncio.sleep(STUCK_S)
        process.send_signal(number)
        await until(lambda: not runs(shared_engine, "yes"), what="the command has ended")
        ending = asyncio.create_task(process.wait())
        with pytest.raises(TimeoutError):  # the end waits behind the output
            await asyncio.wait_for(asyncio.shield(ending), STUCK_S)
        process.send_signal(number)
        assert await asyncio.wait_for(ending, 30) == 128 + number
        os.read(pipe[0], PIPE)


@IN_PROCESSES
async def test_output_that_cannot_be_written_is_told(owner: Owner) -> None:
    full = os.open("/dev/full", os.O_WRONLY)
    process = await owner.start("exec", "box", "echo", "x", stdout=full)
    os.close(full)
    _, error = await process.communicate()
    assert process.returncode == NOT_RUN
    assert b"No space left" in error
    assert b"Traceback" not in error


@IN_PROCESSES
async def test_output_before_a_lost_connection_is_written(
    shared_engine: Engine, owner: Owner, pipe: tuple[int, int]
) -> None:
    ours, theirs = pipe
    amount = PIPE + 100_000
    script = f"head -c {amount} /dev/zero; exec sleep 6546"
    process = await owner.start("exec", "box", "--", "sh", "-c", script, stdout=theirs)
    os.close(theirs)
    await until(lambda: unread(ours) == PIPE and runs(shared_engine, "sleep 6546"), what="all is written")
    await asyncio.sleep(2)  # the rest comes to the program, which cannot write it
    await shared_engine.master.kill()
    with open(ours, "rb", closefd=False) as output:
        assert await asyncio.to_thread(output.read) == bytes(amount)
    _, error = await process.communicate()
    assert process.returncode == NOT_RUN
    assert b"the command has been ended" in error
    await shared_engine.master.start()
    await until(lambda: _again(owner), timeout=60, what="commands run again")


@IN_PROCESSES
async def test_connections_of_commands_that_wait_answer_pings(shared_engine: Engine) -> None:
    """With full windows in both directions, by a client of the protocol that is not ours."""
    url = f"{shared_engine.url.replace('http', 'ws')}api/v1/containers/box/exec"
    headers = {"Authorization": f"Bearer {shared_engine.token()}"}
    async with connect(url, additional_headers=headers, proxy=None, compression=None) as socket:
        command = Command(argv=("sh", "-c", "yes & exec sleep 6545"), window=MIN_WINDOW)
        await socket.send(msgspec.json.encode(command).decode())

        async def receive() -> Frame:
            return decode(await asyncio.wait_for(socket.recv(decode=False), 30))

        started = await receive()
        assert started.part is Part.STARTED
        for _ in range(read_amount(started.data) // MAX_DATA):
            await socket.send(Frame(Part.INPUT, bytes(MAX_DATA)).encode())
        got, taken = 0, 0
        with contextlib.suppress(TimeoutError):
            while True:  # the first output may take long to come, what follows does not
                in_time = 30.0 if got < MAX_DATA else 1.0
                frame = decode(await asyncio.wait_for(socket.recv(decode=False), in_time))
                if frame.part is Part.OUTPUT:
                    got += len(frame.data)
                else:
                    assert frame.part is Part.TAKEN
                    taken += read_amount(frame.data)
        assert MAX_DATA <= got <= MIN_WINDOW
        assert taken < read_amount(started.data)
        async with asyncio.timeout(30):
            await (await socket.ping())
        await socket.send(amount_frame(Part.TAKEN, got).encode())
        more = 0
        while more < MAX_DATA:
            more += len((await receive()).data)
        await socket.send(Frame(Part.SIGNAL, bytes([signal.SIGTERM])).encode())
        await socket.send(amount_frame(Part.TAKEN, more).encode())
        while (frame := await receive()).part is not Part.ENDED:
            with contextlib.suppress(ConnectionClosedOK):  # the end waits to be received
                await socket.send(amount_frame(Part.TAKEN, len(frame.data)).encode())
        assert read_ended(frame.data).code == 128 + signal.SIGTERM


async def test_the_graph_of_a_container_is_seen_from_outside(owner: Owner) -> None:
    assert "/stringEchoReq" in await owner.rce("topic", "list", "-c", "box")
    echo = await owner.start("topic", "echo", "/stringEchoResp", "-n", "1", "--json", "-c", "box")
    assert echo.stdout is not None
    published = asyncio.create_task(echo.stdout.readline())
    while not published.done():
        await owner.rce("topic", "pub", "-c", "box", "/stringEchoReq", "std_msgs/String", "hi")
    assert json.loads(await published) == {"data": "hi"}
    await echo.communicate()
    assert "x" in await owner.rce("service", "call", "-c", "box", "/stringEchoService", "{data: x}")
    await owner.rce("param", "set", "-c", "box", "/speed", "1.5")
    assert await owner.rce("param", "get", "-c", "box", "/speed") == "1.5\n"
    assert "-c CONTAINER" in await owner.rce("topic", "hz", "--help")
    assert "no node publishes" in await owner.rce("topic", "echo", "-c", "box", "/x", fails=True)


@IN_PROCESSES
async def test_parts_that_die_end_the_command_and_say_so(shared_engine: Engine, owner: Owner) -> None:
    for victim in (shared_engine.master, shared_engine.container):
        await until(lambda: _again(owner), timeout=60, what="commands run")
        process = await owner.start("exec", "box", "sh", "-c", "echo up; exec sleep 7654")
        assert process.stdout is not None
        assert await process.stdout.readline() == b"up\n"
        await victim.kill()
        _, error = await asyncio.wait_for(process.communicate(), 60)
        assert process.returncode == 125
        assert b"the command has been ended" in error
        await until(lambda: not runs(shared_engine, "sleep 7654"), what="nothing is left of it")
        await victim.start()
    await until(lambda: _again(owner), timeout=60, what="commands run again")


async def _again(owner: Owner) -> bool:
    return await owner.run("exec", "box", "echo", "again") == (0, "again\n")


@IN_PROCESSES
async def test_only_the_owner_and_administrators_run_commands(shared_engine: Engine, owner: Owner) -> None:
    await owner.rce("user", "add", "eve", "--password-stdin", typed="eve\n")
    eve = Owner(shared_engine, "eve")
    await eve.login()
    assert (await eve.run("exec", "box", "id"))[0] == 125
    code, error = await eve.run("exec", "--user", "testUser", "box", "id")
    assert code == 125
    assert "administrator" in error
    await owner.rce("exec", "--user", "testUser", "box", "true")
    for role in ("viewer", "operator"):
        await owner.rce("user", "add", role, "--role", role, "--password-stdin", typed=f"{role}\n")
        looker = Owner(shared_engine, role)
        await looker.login()
        assert (await looker.run("exec", "--user", "testUser", "box", "id"))[0] == 125
    assert "execute" in await owner.rce("audit")
    url = f"{shared_engine.url}api/v1/containers/box/exec"
    async with aiohttp.ClientSession() as session:
        async with session.get(url) as reply:
            assert reply.status == 401
        headers = {"Authorization": f"Bearer {shared_engine.token()}"}
        async with session.get(url, headers=headers) as reply:
            assert reply.status == 422
        for first in ("{", '{"argv": 3}', "[]"):
            async with session.ws_connect(url, headers=headers) as socket:
                await socket.send_str(first)
                answer = await socket.receive_bytes()
                assert answer[:1] == b"x"
                assert msgspec.json.decode(answer[1:])["code"] == 125
        async with session.ws_connect(url, headers=headers) as socket:
            await socket.send_bytes(msgspec.json.encode(Command(argv=("sleep", "8765"), terminal=True)))
            assert b"as JSON text" in await socket.receive_bytes()
    # A login that ends takes its commands with it.
    process = await owner.start("exec", "box", "sleep", "8765")
    await until(lambda: runs(shared_engine, "sleep 8765"), what="the command runs")
    await owner.rce("logout")
    _, told = await process.communicate()
    assert b"your login has ended" in told
    await until(lambda: not runs(shared_engine, "sleep 8765"), what="it ended")
    await owner.login()

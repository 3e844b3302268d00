"""Commands that users run in the container beside its nodes (:mod:`rce.control.execution`)."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import os
import signal
import socket
import sys
from collections.abc import Callable, Mapping
from typing import Self, assert_never

from rce.aio.tasks import BackgroundTasks, cancel_and_wait
from rce.aio.window import Window
from rce.control.execution import (
    MAX_DATA,
    NOT_RUN,
    WINDOW,
    Command,
    Frame,
    Part,
    amount_frame,
    decode,
    ended_frame,
    read_amount,
    read_size,
)
from rce_container.environment.descriptors import read_some, write_all
from rce_container.environment.nodes.launch import NODE_MARK
from rce_container.environment.nodes.reaper import Child, Reaper
from rce_container.environment.process import kill_marked

_log = logging.getLogger(__name__)

MAX_EXECUTIONS = 16
"""How many commands may run at the same time in one container."""
HANGUP_S = 2.0
"""Seconds that a command has to end after SIGHUP, when its user has disconnected."""
REST_S = 1.0
"""Seconds without output after which that of a command that has ended counts as complete."""
PART_S = 5.0
"""Seconds that the user's side may take to read the last output."""
SHELLS = ("/bin/bash", "/bin/sh")
_SIGNALS = frozenset({signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT, signal.SIGKILL})
_NOT_FOUND, _NOT_EXECUTABLE = 127, 126


class Executions:
    """Runs commands; each has a socket to its user, and ends with it.

    Args:
        reaper: Starts processes and waits for them.
        environ: Returns the environment variables of the container's nodes.
        mark: The container's mark; all processes of a command carry a mark derived from it.
        home: Where commands start.
    """

    def __init__(
        self, reaper: Reaper, environ: Callable[[], Mapping[str, str]], mark: str, home: str
    ) -> None:
        self._reaper = reaper
        self._environ = environ
        self._mark = mark
        self._home = home
        self._tasks = BackgroundTasks()
        self._number = 0

    def start(self, command: Command, sock: socket.socket) -> None:
        """Run a command; ``sock`` keeps message boundaries, and this object owns it from now on."""
        self._number += 1
        if self._tasks.closed:  # the container ends
            sock.close()
            return
        self._tasks.spawn(self._run(command, sock, self._number), name=f"command {self._number}")

    async def close(self) -> None:
        """End all commands."""
        await self._tasks.close()

    async def _run(self, command: Command, sock: socket.socket, number: int) -> None:
        sock.setblocking(False)
        loop = asyncio.get_running_loop()
        with sock:
            try:
                if len(self._tasks) > MAX_EXECUTIONS:
                    last = ended_frame(
                        NOT_RUN, f"{MAX_EXECUTIONS} commands run in this container already; end one of them"
                    )
                else:
                    last = await self._execute(command, sock, f"{self._mark}.command.{number}")
                await loop.sock_sendall(sock, last.encode())
                await _part(sock)
            except OSError as error:  # the user has disconnected
                _log.info("command %d: %s", number, error)

    async def _execute(self, command: Command, sock: socket.socket, mark: str) -> Frame:
        argv = list(command.argv) or [next(filter(os.path.exists, SHELLS), SHELLS[-1])]
        if command.tool:
            argv = [sys.executable, "-m", "rce.ros.tools", *argv]
        env = {**self._environ(), **command.variables, NODE_MARK: mark}
        try:
            streams = _Terminal(command.rows, command.columns) if command.terminal else _Pipes()
        except OSError as error:
            what = "a terminal" if command.terminal else "its pipes"
            return ended_frame(NOT_RUN, f"the container's machine cannot make {what}: {error.strerror}")
        with streams:
            try:
                child = self._reaper.spawn_attached(
                    argv, env=env, cwd=self._home, streams=streams.of_child, terminal=command.terminal
                )
            except OSError as error:
                code = _NOT_FOUND if isinstance(error, FileNotFoundError) else _NOT_EXECUTABLE
                return ended_frame(code, f"{argv[0]}: {error.strerror}")
            finally:
                streams.close_childs()
            try:
                started = amount_frame(Part.STARTED, WINDOW) if command.window else Frame(Part.STARTED)
                await asyncio.get_running_loop().sock_sendall(sock, started.encode())
                return await _Conversation(child, streams, sock, command.window).hold(mark)
            finally:
                child.signal_group(signal.SIGKILL)
                await kill_marked(mark, variable=NODE_MARK)


async def _part(sock: socket.socket) -> None:
    """Wait until the user's side has read all output; closing with input unread would discard it."""
    sock.shutdown(socket.SHUT_WR)
    with contextlib.suppress(TimeoutError):
        async with asyncio.timeout(PART_S):
            while await asyncio.get_running_loop().sock_recv(sock, MAX_DATA + 2):
                pass


class _Pipes:
    """Three pipes."""

    def __init__(self) -> None:
        self._open: set[int] = set()
        try:
            pairs = self._make(), self._make(), self._make()
        except OSError:
            self._close(*self._open)
            raise
        self.of_child = (pairs[0][0], pairs[1][1], pairs[2][1])
        self.input = pairs[0][1]
        self.outputs = {Part.OUTPUT: pairs[1][0], Part.ERROR: pairs[2][0]}
        for fd in (self.input, *self.outputs.values()):
            os.set_blocking(fd, False)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._close(*self._open)

    def close_childs(self) -> None:
        """Close the child's ends."""
        self._close(*self.of_child)

    def close_input(self) -> None:
        """Tell the command that no more input comes."""
        self._close(self.input)

    def resize(self, rows: int, columns: int) -> None:
        """Pipes have no size."""

    def _make(self) -> tuple[int, int]:
        pair = os.pipe2(os.O_CLOEXEC)
        self._open.update(pair)
        return pair

    def _close(self, *fds: int) -> None:
        for fd in self._open.intersection(fds):
            os.close(fd)
        self._open.difference_update(fds)


class _Terminal:
    """A pseudo terminal."""

    def __init__(self, rows: int, columns: int) -> None:
        self.input, inner = os.openpty()
        self.outputs = {Part.OUTPUT: self.input}
        self.of_child = (inner, inner, inner)
        self._open = {self.input, inner}
        os.set_blocking(self.input, False)
        self.resize(rows, columns)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._close(*self._open)

    def close_childs(self) -> None:
        """Close the child's end."""
        self._close(self.of_child[0])

    def close_input(self) -> None:
        """A terminal has no end; Ctrl-D is a character."""

    def resize(self, rows: int, columns: int) -> None:
        """Set the size, unless it is impossible; the kernel tells the command."""
        import termios

        with contextlib.suppress(OSError, OverflowError, termios.error):
            termios.tcsetwinsize(self.input, (rows, columns))

    def _close(self, *fds: int) -> None:
        for fd in self._open.intersection(fds):
            os.close(fd)
        self._open.difference_update(fds)


class _Input:
    """The user's input that the command has not read yet; at most :data:`WINDOW` bytes."""

    def __init__(self) -> None:
        self._waiting = bytearray()
        self._ended = False
        self._changed = asyncio.Condition()

    async def put(self, data: bytes) -> None:
        """Add input; wait for room, which there is if the user keeps to the window."""
        async with self._changed:
            await self._changed.wait_for(lambda: len(self._waiting) + len(data) <= WINDOW)
            self._waiting += data
            self._changed.notify_all()

    async def end(self) -> None:
        """No more input comes."""
        async with self._changed:
            self._ended = True
            self._changed.notify_all()

    async def get(self) -> bytes:
        """Wait for input; empty at its end."""
        async with self._changed:
            await self._changed.wait_for(lambda: self._waiting or self._ended)
            data = bytes(self._waiting[:MAX_DATA])
            del self._waiting[:MAX_DATA]
            self._changed.notify_all()
            return data


class _Conversation:
    """Passes a running command's streams between it and its user.

    Args:
        child: The command.
        streams: Its streams.
        sock: The user's side.
        window: How many bytes may be on the way to the user; 0: both sides use no windows.
    """

    def __init__(self, child: Child, streams: _Pipes | _Terminal, sock: socket.socket, window: int) -> None:
        self._child = child
        self._streams = streams
        self._sock = sock
        self._uses_windows = bool(window)
        self._window = Window(window or None)
        self._passed = 0
        """Bytes of output that were sent."""
        self._input = _Input()
        self._loop = asyncio.get_running_loop()
        self._turn = asyncio.Lock()

    async def hold(self, mark: str) -> Frame:
        """Pass data until the command has ended, or its user has disconnected.

        Returns:
            The last frame.
        """
        outputs = [asyncio.create_task(self._read(part, fd)) for part, fd in self._streams.outputs.items()]
        listening = asyncio.create_task(self._listen())
        feeding = asyncio.create_task(self._feed())
        try:
            await asyncio.wait((self._child.ended, listening), return_when=asyncio.FIRST_COMPLETED)
            if not self._child.ended.done():
                await self._hang_up()
            # Processes that the command left in the background would keep its streams open.
            await kill_marked(mark, variable=NODE_MARK)
            await self._pass_the_rest(outputs, listening)
        finally:
            await cancel_and_wait(*outputs, listening, feeding)
        code = self._child.ended.result()
        return ended_frame(code if code >= 0 else 128 - code)

    async def _pass_the_rest(self, outputs: list[asyncio.Task[None]], listening: asyncio.Task[None]) -> None:
        """Pass the last output on, as slowly as the user takes it."""
        waiting = {*outputs}
        while waiting and not listening.done():
            before = self._passed, len(waiting)
            await asyncio.wait({*waiting, listening}, timeout=REST_S, return_when=asyncio.FIRST_COMPLETED)
            waiting = {task for task in waiting if not task.done()}
            if (self._passed, len(waiting)) == before and not self._window.is_closed:
                return  # a stream is still open, and nothing comes from it

    async def _hang_up(self) -> None:
        self._child.signal_group(signal.SIGHUP)
        await asyncio.wait((self._child.ended,), timeout=HANGUP_S)
        self._child.signal_group(signal.SIGKILL)
        await self._child.ended

    async def _read(self, part: Part, fd: int) -> None:
        while True:
            reserved = await self._window.reserve(MAX_DATA)
            data = await read_some(fd, reserved)
            self._window.give_back(reserved - len(data))
            if not data:
                return
            await self._send(Frame(part, data))
            self._passed += len(data)

    async def _send(self, frame: Frame) -> None:
        async with self._turn:
            await self._loop.sock_sendall(self._sock, frame.encode())

    async def _feed(self) -> None:
        """Write the input to the command; drop it if the command does not read, or has closed its input."""
        while data := await self._input.get():
            with contextlib.suppress(OSError):
                await write_all(self._streams.input, data)
            if self._uses_windows:
                with contextlib.suppress(OSError):  # the user has disconnected
                    await self._send(amount_frame(Part.TAKEN, len(data)))
        self._streams.close_input()

    async def _listen(self) -> None:
        """Handle the user's frames; return when the user disconnects or sends an invalid frame."""
        while received := await self._loop.sock_recv(self._sock, MAX_DATA + 2):
            try:
                await self._obey(decode(received))
            except ValueError as error:
                _log.warning("a command is ended: %s", error)
                return

    async def _obey(self, frame: Frame) -> None:
        match frame.part:
            case Part.INPUT:
                await self._input.put(frame.data)
            case Part.END_OF_INPUT:
                await self._input.end()
            case Part.TAKEN:
                self._window.give_back(read_amount(frame.data))
            case Part.SIZE:
                self._streams.resize(*read_size(frame.data))
            case Part.SIGNAL:
                number = signal.Signals(frame.data[0] if frame.data else 0)
                if number not in _SIGNALS:
                    raise ValueError(f"{number.name} cannot be sent to a command")
                self._child.signal_group(number)
            case Part.OUTPUT | Part.ERROR | Part.STARTED | Part.ENDED:
                raise ValueError(f"a user sent {frame.part.name}")
            case _:
                assert_never(frame.part)

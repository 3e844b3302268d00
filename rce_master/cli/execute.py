"""``rce exec``: a command in a container, with this terminal as its own."""

from __future__ import annotations

import asyncio
import contextlib
import os
import shutil
import signal
import sys
from typing import TYPE_CHECKING, Annotated, assert_never

import aiohttp
import msgspec
import typer
from msgspec.structs import replace

from rce.aio.tasks import cancel_and_wait, run_until_first
from rce.aio.window import Window
from rce.cli.main import Plugged
from rce.control.execution import (
    MAX_DATA,
    MAX_SIDE,
    NOT_RUN,
    WINDOW,
    Command,
    Frame,
    Part,
    amount_frame,
    decode,
    read_amount,
    read_ended,
    size_frame,
)
from rce_master.cli import credentials
from rce_master.cli.client import ApiClient
from rce_master.cli.exceptions import CliError
from rce_master.cli.output import OutputWriter
from rce_master.exceptions import MasterError

if TYPE_CHECKING:
    from collections.abc import Iterator

    from aiohttp import ClientWebSocketResponse

_INTERRUPTED = 130
STUCK_S = 0.5
"""Seconds without progress of the output after which a repeated signal ends this program."""
_PASSED_ON = ("TERM", "LANG", "COLORTERM")
"""Variables of this terminal that a command in a terminal gets."""


def _execute(
    container: Annotated[str, typer.Argument(help="The container's tag.")],
    command: Annotated[
        list[str] | None, typer.Argument(metavar="[--] [COMMAND]...", help="What to run; default: a shell.")
    ] = None,
    tty: Annotated[
        bool | None,
        typer.Option("--tty/--no-tty", "-t/-T", help="Give it a terminal (default: if this is one)."),
    ] = None,
    stdin: Annotated[bool, typer.Option("--stdin/--no-stdin", help="Pass standard input on.")] = True,
    user: Annotated[str, typer.Option(help="Whose container; administrators only.")] = "",
) -> None:
    """Run a command in a container, beside its nodes and within its limits.

    The exit code is the command's; 125 if it could not be run. Whatever it started ends with it.
    """
    argv = tuple(command or ())
    if argv[:1] == ("--",):
        argv = argv[1:]
    terminal = _is_terminal() if tty is None else tty
    asked = Command(argv=argv, terminal=terminal, variables=_variables() if terminal else {})
    raise typer.Exit(run_command(container, asked, user=user, stdin=stdin))


def run_command(container: str, command: Command, *, user: str = "", stdin: bool = True) -> int:
    """Run a command with this program's standard streams; print the reason of a failure.

    Returns:
        The exit code.
    """
    if command.terminal:
        size = shutil.get_terminal_size()
        command = replace(command, rows=min(size.lines, MAX_SIDE), columns=min(size.columns, MAX_SIDE))
    try:
        return asyncio.run(_run(container, command, user, stdin))
    except BrokenPipeError:
        raise  # the output is not wanted any more, and the program ends quietly
    except (CliError, MasterError, OSError) as error:
        typer.echo(f"rce: {error}", err=True)
        return NOT_RUN
    except KeyboardInterrupt:
        return _INTERRUPTED


def _is_terminal() -> bool:
    return sys.stdin.isatty() and sys.stdout.isatty()


def _variables() -> dict[str, str]:
    return {name: os.environ[name] for name in _PASSED_ON if name in os.environ}


async def _run(container: str, command: Command, user: str, stdin: bool) -> int:
    query = {"user": user} if user else {}
    async with (
        ApiClient.of(credentials.load()) as client,
        client.websocket(f"/containers/{container}/exec", query, MAX_DATA + 2) as socket,
    ):
        await socket.send_str(msgspec.json.encode(replace(command, window=WINDOW)).decode())
        with _raw_terminal(command.terminal), OutputWriter() as writer:
            with _signals(socket, writer, command.terminal):
                code = await _Run(socket, command.terminal, writer).hold(stdin)
            await writer.drain()  # Ctrl-C ends this program now
    if code is None:
        raise CliError("the connection to the master was lost; the command has been ended")
    return code


class _Run:
    """Passes a command's streams between it and this program's own."""

    def __init__(self, socket: ClientWebSocketResponse, terminal: bool, writer: OutputWriter) -> None:
        self._socket = socket
        self._terminal = terminal
        self._writer = writer
        self._uses_windows = False
        self._started: asyncio.Future[Window] = asyncio.get_running_loop().create_future()
        """The window for input, once the command runs."""
        self._code: int | None = None

    async def hold(self, stdin: bool) -> int | None:
        """Pass data until the command has ended or the connection is lost.

        Returns:
            The exit code; None if the connection was lost.
        """
        typing = asyncio.create_task(self._send_input(stdin))
        try:
            await run_until_first(self._show(), self._acknowledge())
        finally:
            await cancel_and_wait(typing)
        return self._code

    async def _show(self) -> None:
        """Have the command's output written, until it has ended or the connection is lost."""
        async for message in self._socket:
            if message.type is aiohttp.WSMsgType.BINARY:
                self._take(decode(message.data))
                if self._code is not None:
                    return

    def _take(self, frame: Frame) -> None:
        match frame.part:
            case Part.OUTPUT:
                self._writer.write(1, frame.data)
            case Part.ERROR:
                self._writer.write(2, frame.data)
            case Part.STARTED:
                self._uses_windows = bool(frame.data)
                self._started.set_result(Window(read_amount(frame.data) if frame.data else None))
            case Part.TAKEN:
                self._started.result().give_back(read_amount(frame.data))
            case Part.ENDED:
                ended = read_ended(frame.data)
                if ended.reason:
                    self._writer.write(2, f"rce: {ended.reason}\n".encode())
                self._code = ended.code
            case Part.INPUT | Part.END_OF_INPUT | Part.SIZE | Part.SIGNAL:
                raise CliError(f"the engine sent {frame.part.name}, which only a user sends")
            case _:
                assert_never(frame.part)

    async def _acknowledge(self) -> None:
        """Tell what was written; raise what keeps it from being written.

        Raises:
            OSError: The output is not read any more.
        """
        while True:
            amount = await self._writer.written()
            if self._uses_windows:
                with contextlib.suppress(ConnectionError):  # told by the other direction
                    await self._socket.send_bytes(amount_frame(Part.TAKEN, amount).encode())

    async def _send_input(self, stdin: bool) -> None:
        """Send the typed or piped input, and its end."""
        window = await self._started
        while stdin:
            reserved = await window.reserve(MAX_DATA)
            data = await _read_input(reserved)
            window.give_back(reserved - len(data))
            if not data:
                break
            await self._socket.send_bytes(Frame(Part.INPUT, data).encode())
        if not self._terminal:
            await self._socket.send_bytes(Frame(Part.END_OF_INPUT).encode())


async def _read_input(most: int) -> bytes:
    loop = asyncio.get_running_loop()
    ready = loop.create_future()
    try:
        loop.add_reader(0, _wake, ready)
    except PermissionError:  # a file: it is always ready
        await asyncio.sleep(0)
    else:
        try:
            await ready
        finally:
            loop.remove_reader(0)
    return os.read(0, most)


def _wake(ready: asyncio.Future[None]) -> None:
    if not ready.done():
        ready.set_result(None)


@contextlib.contextmanager
def _raw_terminal(wanted: bool) -> Iterator[None]:
    """Pass keystrokes unprocessed to the terminal in the container."""
    if not wanted or not sys.stdin.isatty():
        yield
        return
    import termios
    import tty

    before = termios.tcgetattr(0)
    tty.setraw(0, termios.TCSADRAIN)  # input typed ahead is kept
    try:
        yield
    finally:
        termios.tcsetattr(0, termios.TCSADRAIN, before)


@contextlib.contextmanager
def _signals(socket: ClientWebSocketResponse, writer: OutputWriter, terminal: bool) -> Iterator[None]:
    """Pass signals and the terminal's size on to the command.

    The end of the command comes behind its output. If that is not read, a signal that comes again ends this
    program instead.
    """
    loop = asyncio.get_running_loop()
    tasks: set[asyncio.Task[None]] = set()
    passed: set[int] = set()

    def send(frame: Frame) -> None:
        task = loop.create_task(socket.send_bytes(frame.encode()))
        tasks.add(task)
        task.add_done_callback(tasks.discard)

    def pass_on(number: signal.Signals) -> None:
        if number in passed and writer.stuck_for > STUCK_S:
            raise SystemExit(128 + number)
        passed.add(number)
        send(Frame(Part.SIGNAL, bytes([number])))

    def resized() -> None:
        size = shutil.get_terminal_size()
        send(size_frame(size.lines, size.columns))

    handled = (signal.SIGINT, signal.SIGTERM)
    for number in handled:
        loop.add_signal_handler(number, pass_on, number)
    if terminal:
        loop.add_signal_handler(signal.SIGWINCH, resized)
    try:
        yield
    finally:
        for number in (*handled, signal.SIGWINCH):
            loop.remove_signal_handler(number)
        for task in tasks:
            task.cancel()


execute = Plugged(_execute, {"allow_interspersed_args": False})

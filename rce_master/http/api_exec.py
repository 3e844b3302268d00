"""REST: running commands in containers, over a WebSocket."""

from __future__ import annotations

import asyncio
import contextlib
from typing import TYPE_CHECKING

import msgspec
from aiohttp import WSMsgType, web
from websockets.exceptions import ConnectionClosed

from rce.aio.tasks import run_until_first
from rce.control.execution import MAX_COMMAND, NOT_RUN, Command, ended_frame, read_command
from rce.web.writing import write_in_time
from rce_master.audit import DONE, REFUSED
from rce_master.exceptions import InvalidRequestError, MasterError
from rce_master.http.routes import OF_USER, Call, route_table

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from websockets.asyncio.server import ServerConnection


routes = route_table("exec")

FIRST_MESSAGE_S = 10.0
HEARTBEAT_S = 15.0
CHECK_S = 60.0
"""Interval of checks whether the login has ended."""
_LOGIN_ENDED = "your login has ended"


@routes.route(
    "GET",
    "/containers/{container}/exec",
    "Run a command in a container: a WebSocket, on which the command is sent as JSON and frames follow",
    query=(OF_USER,),
    media="application/octet-stream",
    status=101,
    acts=True,
)
async def execute(call: Call) -> web.StreamResponse:
    """Run a command."""
    id_ = f"{call.controlled_owner}/{call.path('container')}"
    call.services.reconciler.task_set_of(id_)
    user = web.WebSocketResponse(compress=False, heartbeat=HEARTBEAT_S, max_msg_size=MAX_COMMAND + 1)
    if not user.can_prepare(call.request):
        raise InvalidRequestError("this path is for WebSockets; 'rce exec' uses it")
    await user.prepare(call.request)
    try:
        command = await _first(user)
        async with _opened(call, id_, command) as machine:
            await _relay(call, user, machine)
    except (MasterError, ValueError, TimeoutError) as error:
        text = str(error) or f"no command came within {FIRST_MESSAGE_S:g} s"
        with contextlib.suppress(ConnectionError):
            await write_in_time(call.request, user.send_bytes(ended_frame(NOT_RUN, text).encode()))
    await user.close()
    return user


@contextlib.asynccontextmanager
async def _opened(call: Call, id_: str, command: Command) -> AsyncIterator[ServerConnection]:
    """Have the container's machine run the command, and record in the audit log whether it does.

    Raises:
        ValueError: The login has ended since the request began.
        MasterError: The command does not run.
    """
    program = command.argv[0] if command.argv else "a shell"  # arguments may hold secrets

    def record(outcome: str, detail: str = "") -> None:
        call.services.audit.add(
            *(call.caller.name, "execute", id_),
            detail=f"program {program}{detail}",
            address=call.address,
            outcome=outcome,
        )

    is_open = False
    try:
        _check_login(call)
        peer = call.services.reconciler.task_set_of(id_)  # the container may have moved since
        async with call.services.executions.open(peer, id_, command) as machine:
            is_open = True
            record(DONE)
            yield machine
    except (MasterError, ValueError) as error:
        if not is_open:
            record(REFUSED, f": {error}")
        raise


def _check_login(call: Call) -> None:
    if not call.is_still_valid:
        raise ValueError(_LOGIN_ENDED)


async def _first(user: web.WebSocketResponse) -> Command:
    """Receive the command.

    Raises:
        ValueError: The message is not a command.
        TimeoutError: No message was received.
    """
    async with asyncio.timeout(FIRST_MESSAGE_S):
        message = await user.receive()
    if message.type is not WSMsgType.TEXT:
        raise ValueError("the first message must be the command, as JSON text")
    try:
        return read_command(message.data)
    except msgspec.MsgspecError as error:
        raise ValueError(f"the command: {error}") from error


async def _relay(call: Call, user: web.WebSocketResponse, machine: ServerConnection) -> None:
    """Pass frames on until either side disconnects or takes nothing, or the user loses the permission.

    Raises:
        EndedError: This master ends.
        FencedError: This master leads no more.
        ValueError: The login has ended, or the user sends what is not a frame.
    """
    with contextlib.suppress(ConnectionClosed, ConnectionError):  # either side may disconnect
        await run_until_first(_to_machine(call, user, machine), _to_user(call, machine, user), _watch(call))


async def _to_machine(call: Call, user: web.WebSocketResponse, machine: ServerConnection) -> None:
    async for message in user:
        if message.type is not WSMsgType.BINARY:
            raise ValueError("only binary frames may follow the command")
        call.check_lead()
        with contextlib.suppress(
            ConnectionClosed
        ):  # the command has ended; its last frames are still passed on
            await machine.send(message.data)


async def _to_user(call: Call, machine: ServerConnection, user: web.WebSocketResponse) -> None:
    async for frame in machine:
        if isinstance(frame, bytes):
            call.check_lead()
            await write_in_time(call.request, user.send_bytes(frame))


async def _watch(call: Call) -> None:
    """Never return; raise when the login has ended.

    Raises:
        EndedError: This master ends.
        ValueError: The login has ended.
    """
    while await call.lasts(CHECK_S):
        pass
    raise ValueError(_LOGIN_ENDED)

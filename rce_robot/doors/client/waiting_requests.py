"""A robot's requests to the master: bounded, and carried out one after another."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

import msgspec

from rce.model import ConfigureComponents, ConfigureConnections, FaultCode, Request
from rce.protocol import ErrorReport, memory_of, type_of

if TYPE_CHECKING:
    from collections.abc import Callable

    from rce_robot.doors.base import Owner
    from rce_robot.settings import SessionSettings


class WaitingRequests:
    """The requests of one robot, in the order in which it sent them.

    Args:
        owner: Passes them on to the master.
        settings: How many may wait, and of how many bytes.
        send: Sends the robot what was refused.

    Attributes:
        bytes: Bytes of memory of waiting and running requests.
    """

    def __init__(self, owner: Owner, settings: SessionSettings, send: Callable[[ErrorReport], None]) -> None:
        self._owner = owner
        self._settings = settings
        self._send = send
        self._queue: asyncio.Queue[tuple[Request, int, int] | None] = asyncio.Queue()
        """Requests with the bytes of their texts and their memory."""
        self._text_bytes = 0
        self.bytes = 0

    def put(self, request: Request, size: int) -> None:
        """Report a request's faults, and let what is valid of it wait; refuse it if too many wait already.

        Args:
            request: The request.
            size: Bytes of its text; 0 if it waited for binary values, and its text is gone.
        """
        if isinstance(request, (ConfigureComponents, ConfigureConnections)):
            for fault in request.faults:
                self._send(ErrorReport(problem=str(fault), path=fault.path, code=fault.code))
            request = msgspec.structs.replace(request, faults=())
        memory = memory_of(request)
        waiting = self._text_bytes + size
        if self._queue.qsize() >= self._settings.max_requests or waiting > self._settings.max_request_bytes:
            problem = f"{type_of(request)}: too many requests wait; this one was dropped"
            self._send(ErrorReport(problem=problem, code=FaultCode.BUSY))
        else:
            self._text_bytes = waiting
            self.bytes += memory
            self._queue.put_nowait((request, size, memory))
            self._owner.grew()

    def close(self) -> None:
        """Let :meth:`carry_out` end after the requests that wait now."""
        self._queue.put_nowait(None)

    async def carry_out(self) -> None:
        """Pass the requests on to the master until :meth:`close`; cancelling forgets those that wait."""
        while (item := await self._queue.get()) is not None:
            request, size, memory = item
            for report in await self._owner.ask_master(request):
                self._send(report)
            self._text_bytes -= size
            self.bytes -= memory

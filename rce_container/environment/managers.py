"""The managers of a container: they come one after another, and only the newest one is heard."""

from __future__ import annotations

import asyncio
import logging
from collections import deque
from typing import TYPE_CHECKING, Protocol

import msgspec

from rce_container.environment import messages as m
from rce_container.environment.channel import Channel, accept
from rce_container.environment.exceptions import ChannelError

if TYPE_CHECKING:
    import socket

    from rce.control import Unknown

_log = logging.getLogger(__name__)

_MAX_UNTOLD = 100


class ManagerListener(Protocol):
    """Follows the managers of a container."""

    def manager_arrived(self, channel: Channel, /) -> None:
        """A manager has connected; it has been sent nothing."""

    async def handle(self, channel: Channel, message: m.ToEnvironment | Unknown) -> None:
        """Carry out a manager's request.

        Raises:
            ChannelError: A descriptor that belongs to the request is missing.
        """

    def end(self, reason: str) -> None:
        """End the container: no manager was connected for the grace time."""


class Managers:
    """Accepts managers on a unix socket, which it owns.

    Args:
        control: The listening socket.
        grace: Seconds that the container may be without a manager.
        listener: Follows them.

    Attributes:
        channel: The connection to the manager; None while there is none.
    """

    def __init__(self, control: socket.socket, grace: float, listener: ManagerListener) -> None:
        self.channel: Channel | None = None
        self._control = control
        self._grace = grace
        self._listener = listener
        self._tasks: asyncio.TaskGroup | None = None
        self._timer: asyncio.TimerHandle | None = None
        self._waits = True
        self._untold: deque[str] = deque(maxlen=_MAX_UNTOLD)

    async def serve(self, tasks: asyncio.TaskGroup) -> None:
        """Accept managers until cancelled; tasks of the group talk to them."""
        self._tasks = tasks
        self._wait()
        with self._control:
            await accept(self._control, self._greet)

    def send(self, message: msgspec.Struct) -> bool:
        """Send a message to the manager; return whether there is one."""
        if self.channel is None:
            return False
        self.channel.send(m.encode(message))
        return True

    def tell_fault(self, text: str) -> None:
        """Send a fault to the manager, or to the next one."""
        if not self.send(m.Fault(text=text)):
            self._untold.append(text)

    def stop_waiting(self) -> None:
        """Wait for no further manager: the container ends."""
        self._waits = False
        if self._timer is not None:
            self._timer.cancel()

    def close(self) -> None:
        """Close the connection to the manager."""
        self.stop_waiting()
        if self.channel is not None:
            self.channel.close()

    def _wait(self) -> None:
        if self._waits:
            reason = f"no manager for {self._grace:g} s"
            self._timer = asyncio.get_running_loop().call_later(self._grace, self._listener.end, reason)

    def _greet(self, sock: socket.socket) -> None:
        """Replace the current manager by a new one."""
        assert self._tasks is not None
        if self.channel is not None:
            self.channel.close()
        elif self._timer is not None:
            self._timer.cancel()
        channel = self.channel = Channel(sock)
        self._listener.manager_arrived(channel)
        while self._untold:
            channel.send(m.encode(m.Fault(text=self._untold.popleft())))
        self._tasks.create_task(self._converse(channel), name="manager")

    async def _converse(self, channel: Channel) -> None:
        try:
            while (line := await channel.receive()) is not None:
                await self._listener.handle(channel, m.decode_to_environment(line))
        except (ChannelError, msgspec.DecodeError) as error:
            _log.error("the manager is not understood: %s", error)
        finally:
            channel.close()
            if self.channel is channel:
                self.channel = None
                self._wait()

"""The connection of a robot or another program to the engine: :class:`Connection`."""

from __future__ import annotations

from typing import TYPE_CHECKING, NoReturn, Self

from rce.masters import Masters
from rce_client.engine_transport import Target, Timing
from rce_client.life import State
from rce_client.own_interfaces import OwnInterfaces
from rce_client.requests import Requests
from rce_client.sendqueue import QueueLimits
from rce_client.session import Session

if TYPE_CHECKING:
    import ssl
    from collections import deque
    from collections.abc import Callable, Mapping, Sequence
    from types import TracebackType

    from rce.model import Request

__all__ = ["Connection", "State"]


class Connection(Requests, OwnInterfaces):
    """A lasting connection to the engine: it reconnects when it breaks, and restores the program's requests.

    Use it as an async context manager. Entering waits for the engine without limit; use ``asyncio.timeout``
    to set one. Cancelling ends the attempt. Leaving sends queued messages for at most ``timing.flush``
    seconds, and closes the connection; if it is cancelled, it closes at once. Containers, interfaces and
    other requested items stay in the engine; :meth:`remove_all` removes them.

    Requests such as :meth:`create_container` return when they were handed to the network. Without a
    connection, they are stored and sent after the reconnect. Removals that the engine may not have received
    before the connection broke are sent again, before everything that exists is restored. The protocol does
    not confirm success; a failure arrives as an error text at ``on_error``. Cancelling a request does not
    withdraw it: it is sent and stored.

    Args:
        url: The master, ``http://HOST:9000/`` or ``https://``; several, in a list or separated by commas, are
            tried in turn.
        user_id: User ID.
        password: The user's password; only its SHA-256 is sent. Empty if there is a token.
        robot_id: Names this robot; one connection at a time.
        token: The robot's own token (``rce robot add``), instead of the user's password.
        tls: TLS settings, or a function that returns them for each connection; the system's if None.
        on_error: Called with the text of every ``ER`` that belongs to no service call, and once with the
            number of requests that a busy engine dropped; must not block.
            Without it, the texts are logged.
        on_state: Called with every new state and a short description; must not block.
        timing: Times in seconds and sizes in bytes.
        limits: How many messages and bytes may wait to be sent.

    Example:
        ```python
        from rce_client import Connection

        async def main():
            async with Connection("http://localhost:9000/", "testUser", "testUser", "testRobot") as robot:
                await robot.create_container("brain")
                await robot.add_node("brain", "echo", "Test", "stringEcho.py")
                await robot.remove_all()
        ```

    Raises:
        RefusedError: On entering: the engine refuses this client.
    """

    def __init__(
        self,
        url: str | Sequence[str],
        user_id: str,
        password: str,
        robot_id: str,
        *,
        token: str = "",
        tls: ssl.SSLContext | Callable[[], ssl.SSLContext] | None = None,
        on_error: Callable[[str], None] | None = None,
        on_state: Callable[[State, str], None] | None = None,
        timing: Timing | None = None,
        limits: QueueLimits | None = None,
    ) -> None:
        self.robot_id = robot_id
        """Names this robot."""
        target = Target(
            url=str(Masters(url)), user=user_id, password=password, token=token, robot=robot_id, tls=tls
        )
        self._session = Session(target, on_error=on_error, on_state=on_state, timing=timing, limits=limits)

    async def __aenter__(self) -> Self:
        """Connect, and wait until the connection is established.

        It waits for an engine that cannot be reached without limit; use ``asyncio.timeout`` to set one.
        Cancelling ends the attempt and leaves nothing behind.

        Raises:
            RefusedError: The engine refuses this client.
        """
        await self._session.__aenter__()
        return self

    async def __aexit__(
        self,
        exc_type: type[BaseException] | None,
        exc: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        """Send queued messages for at most ``timing.flush`` seconds, then close the connection.

        Requested items stay in the engine. After an exception, and when it is cancelled, it closes
        without sending queued messages.
        """
        await self._session.__aexit__(exc_type, exc, traceback)

    @property
    def state(self) -> State:
        """The state of the connection."""
        return self._session.state

    @property
    def connected(self) -> bool:
        """Whether there is a connection at this moment."""
        return self._session.transport.connected

    @property
    def errors(self) -> deque[str]:
        """The newest error texts, at most 100."""
        return self._session.errors

    @property
    def active(self) -> Mapping[str, bool]:
        """Whether each own interface is connected to a peer, by interface tag."""
        return self._session.interfaces.active

    @property
    def dropped(self) -> Mapping[str, int]:
        """The number of messages dropped because a queue was full, by interface tag."""
        return self._session.transport.dropped

    @property
    def knows_sources(self) -> bool:
        """Whether the engine accepts the names of latched messages' sources."""
        return self._session.knows_sources

    @property
    def takes_single_frames(self) -> bool:
        """Whether the engine accepts serialized messages in one frame."""
        return self._session.takes_single_frames

    # Requests

    async def request(self, request: Request) -> None:
        """Send any request, and store it for reconnects.

        It returns when the request was handed to the network. Without a connection it returns at once, and
        the request is sent after the reconnect. Cancelling ends the wait; the request is
        sent and stored anyway.

        Args:
            request: A request of :mod:`rce.model.requests`.

        Raises:
            RefusedError: The engine refused this client permanently.
            NotConnectedError: The program closed the connection, or has not opened it yet.

        Example:
            ```python
            from rce.model import CreateContainer

            await robot.request(CreateContainer(tag="brain"))
            ```
        """
        await self._session.request(request)

    async def remove_all(self) -> None:
        """Remove everything that was requested through this connection.

        Cancelling may leave a part of it; call it again to remove the rest.

        Raises:
            RefusedError: The engine refused this client permanently.
            NotConnectedError: The program closed the connection, or has not opened it yet.

        Example:
            ```python
            await robot.create_container("brain")
            await robot.remove_all()
            ```
        """
        for request in self._session.desired.undo():
            await self.request(request)

    async def repeat_requests(self) -> None:
        """Send all stored requests again, because something that they need may exist by now.

        The engine silently accepts requests for items that exist. Without a connection it returns at once, as
        all requests are sent after the reconnect anyway. Cancelling does not affect existing items.

        Raises:
            RefusedError: The engine refused this client permanently.
            NotConnectedError: The program closed the connection, or has not opened it yet.

        Example:
            ```python
            await robot.connect("testRobot/say", "otherRobot/hear")  # which may be created later
            await robot.repeat_requests()
            ```
        """
        await self._session.repeat()

    # Own interfaces

    async def wait_active(self, tag: str, timeout: float | None = None) -> None:
        """Wait until an own interface is connected to a peer (``ST`` true). Cancelling changes nothing.

        Args:
            tag: Interface tag.
            timeout: Seconds; no limit if None.

        Raises:
            TimeoutError: It is not connected after ``timeout`` seconds; the text has the newest error texts.
            RefusedError: The engine refused this client permanently.
            NotConnectedError: The program closed the connection, or has not opened it yet.

        Example:
            ```python
            await robot.publisher("say", "std_msgs/String")
            await robot.connect("testRobot/say", "brain/names")
            await robot.wait_active("say", timeout=30)
            ```
        """
        await self._session.wait_active(tag, timeout)

    async def wait_refused(self) -> NoReturn:
        """Wait until the engine refuses this client permanently; after any other loss it reconnects.

        For programs that work in callbacks. Cancelling changes nothing.

        Raises:
            RefusedError: The engine refused this client permanently.
            NotConnectedError: The program closed the connection, or has not opened it yet.

        Example:
            ```python
            await robot.subscriber("greetings", "std_msgs/String", print)
            await robot.wait_refused()
            ```
        """
        while True:
            await self._session.until(lambda: False)

    def is_active(self, tag: str) -> bool:
        """Return whether an interface is connected to a peer.

        Example:
            ```python
            if robot.is_active("say"):
                print("the cloud listens")
            ```
        """
        return self._session.is_active(tag)

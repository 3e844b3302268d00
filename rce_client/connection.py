"""A robot's, or any program's, connection to the engine: :class:`Connection`."""

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

    from rce.model.requests import Request

__all__ = ["Connection", "State"]


class Connection(Requests, OwnInterfaces):
    """A connection that stays: it dials again when it breaks, and restores what the program had made.

    An async context manager. Entering waits for the engine without limit (put ``asyncio.timeout`` around it
    for one); cancelling ends the attempt. Leaving sends what waits, for at most ``timing.flush`` seconds, and
    closes; cancelled, it closes at once. What was made stays in the engine; :meth:`remove_all` removes it.

    Requests such as :meth:`create_container` return when they were handed to the network, or were noted for
    the reconnect while there is no connection. The protocol has no answer for success; what fails comes as
    an error text to ``on_error``. Cancelling a request does not take it back: it is sent, and remembered.

    Args:
        url: The master, ``http://HOST:9000/`` or ``https://``; several, in a list or separated by commas, are
            asked in turn.
        user_id: User ID.
        password: The user's password; only its SHA-256 is sent. Empty if there is a token.
        robot_id: Names this robot; one connection at a time.
        token: The robot's own token (``rce robot add``), in place of the user's password.
        tls: TLS settings, or a function that returns them for each connection; the system's if None.
        on_error: Called with the text of every ``ER`` that belongs to no service call; must not block.
            Without it the texts are logged.
        on_state: Called with every new state and a few words; must not block.
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
        RefusedError: On entering: the engine does not take this client.
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
        """Connect, and wait until it is done.

        An engine that cannot be reached is waited for without limit; put ``asyncio.timeout`` around it for
        one. Cancelling ends the attempt and leaves nothing behind.

        Raises:
            RefusedError: The engine does not take this client.
        """
        await self._session.__aenter__()
        return self

    async def __aexit__(
        self,
        exc_type: type[BaseException] | None,
        exc: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        """Send what waits, for as long as ``timing.flush`` allows, then close.

        What was made in the engine stays there. After an exception, and when it is cancelled, it closes
        without sending what waits.
        """
        await self._session.__aexit__(exc_type, exc, traceback)

    @property
    def state(self) -> State:
        """Where the connection is in its life."""
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
        """Own interface tags to whether they are joined with a peer."""
        return self._session.interfaces.active

    @property
    def dropped(self) -> Mapping[str, int]:
        """Interface tag to the number of its messages that were dropped because its queue was full."""
        return self._session.transport.dropped

    @property
    def knows_sources(self) -> bool:
        """Whether the engine takes the names of latched messages' sources."""
        return self._session.knows_sources

    @property
    def takes_single_frames(self) -> bool:
        """Whether the engine takes serialized messages in one frame."""
        return self._session.takes_single_frames

    # Requests

    async def request(self, request: Request) -> None:
        """Send any request, and remember it for reconnects.

        Returns when the request was handed to the network, or at once without a connection; it is sent after
        the reconnect then. Cancelling stops the wait; the request is sent and remembered all the same.

        Args:
            request: A request of :mod:`rce.model.requests`.

        Raises:
            RefusedError: The engine refused this client for good.
            NotConnectedError: The program closed the connection, or has not opened it yet.

        Example:
            ```python
            from rce.model.requests import CreateContainer

            await robot.request(CreateContainer(tag="brain"))
            ```
        """
        await self._session.request(request)

    async def remove_all(self) -> None:
        """Remove everything that was made through this connection.

        Cancelling leaves a part of it; call it again to remove the rest.

        Raises:
            RefusedError: The engine refused this client for good.
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
        """Ask again for everything that was made, because something that it needs may be there by now.

        The engine accepts silently what is there already. Cancelling it changes nothing that was made.

        Raises:
            RefusedError: The engine refused this client for good.
            NotConnectedError: The program closed the connection, or has not opened it yet.

        Example:
            ```python
            await robot.connect("testRobot/say", "otherRobot/hear")  # which may come later
            await robot.repeat_requests()
            ```
        """
        for request in self._session.desired.restore():
            await self.request(request)

    # Own interfaces

    async def wait_active(self, tag: str, timeout: float | None = None) -> None:
        """Wait until an own interface is joined with a peer (``ST`` true); cancelling changes nothing.

        Args:
            tag: Interface tag.
            timeout: Seconds; without limit if None.

        Raises:
            TimeoutError: It is not joined after ``timeout`` seconds; the newest error texts are in the text.
            RefusedError: The engine refused this client for good.
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
        """Wait until the engine refuses this client for good; any other loss is repaired meanwhile.

        For a program whose work is done by callbacks. Cancelling changes nothing.

        Raises:
            RefusedError: It did.
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
        """Return whether an interface is joined with a peer.

        Example:
            ```python
            if robot.is_active("say"):
                print("the cloud listens")
            ```
        """
        return self._session.is_active(tag)

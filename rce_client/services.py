"""The interfaces of services: :class:`ServiceClient` and :class:`ServiceProvider`."""

from __future__ import annotations

import asyncio
import inspect
import logging
import uuid
from typing import TYPE_CHECKING, Generic, TypeVar

from rce.aio.tasks import pass_cancellation
from rce.model import Role
from rce.protocol import CallId, DataMessage
from rce_client.exceptions import CallError, CallTimeoutError, NotConnectedError
from rce_client.interfaces import ClientInterface, InterfaceOwner

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable


_log = logging.getLogger(__name__)

M = TypeVar("M")
"""The type of messages: ``dict[str, Any]`` with a converter, bytes-like with a forwarder."""


class ServiceClient(ClientInterface, Generic[M]):
    """Calls a service; created by :meth:`rce_client.Connection.service_client`. Calls run concurrently.

    Example:
        ```python
        ask = await robot.service_client("ask", "Test/StringEcho")
        await ask.wait_active(timeout=30)
        answer = await ask({"data": "hello"}, timeout=5.0)
        print(answer["data"])
        ```
    """

    role = Role.SERVICE_PROVIDER

    def __init__(self, owner: InterfaceOwner, tag: str, message_type: str, *, raw: bool) -> None:
        super().__init__(owner, tag, message_type, raw=raw)
        self._calls: dict[str, asyncio.Future[M]] = {}

    async def __call__(self, request: M, timeout: float = 30.0) -> M:
        """Call the service and return the answer.

        Cancelling ends the wait; the service may still process the call.

        Args:
            request: The request.
            timeout: Seconds to wait for the answer.

        Raises:
            NotConnectedError: There is no connection; the request was not sent.
            CallError: The call failed, with the text of the engine or the provider, or the connection broke.
            CallTimeoutError: No answer arrived in time.
            TypeError: The request cannot be written as JSON.
        """
        msg_id = uuid.uuid4().hex
        answer: asyncio.Future[M] = asyncio.get_running_loop().create_future()
        self._calls[msg_id] = answer
        try:
            if not self._owner.post_control(self._frames(request, msg_id)):
                raise NotConnectedError(f"{self.tag}: not connected, or too much waits to be sent")
            async with asyncio.timeout(timeout):
                return await answer
        except TimeoutError as error:
            raise CallTimeoutError(f"{self.tag}: no answer within {timeout:g} s") from error
        finally:
            del self._calls[msg_id]

    def deliver(self, message: DataMessage) -> None:
        """Complete a call."""
        answer = self._calls.get(message.msg_id)
        if answer is None:
            _log.info("%s: an answer came too late, msgID %s", self.tag, message.msg_id)
        elif not answer.done():
            answer.set_result(message.msg)

    def on_fault(self, msg_id: str, text: str) -> None:
        """Fail a call."""
        answer = self._calls.get(msg_id)
        if answer is not None and not answer.done():
            answer.set_exception(CallError(f"{self.tag}: {text}"))

    def call_of(self, text: str) -> CallId | None:
        """Return the call that an ``ER`` names in its text only, as engines of the release before do."""
        calls = (CallId(self.tag, msg_id) for msg_id in self._calls)
        return next((call for call in calls if text.startswith(f"{call}: ")), None)

    def on_lost(self) -> None:
        """Fail all calls; they may have been processed."""
        for answer in self._calls.values():
            if not answer.done():
                answer.set_exception(CallError(f"{self.tag}: the connection broke before the answer came"))

    def on_closed(self) -> None:
        """Fail all calls."""
        self.on_lost()


class ServiceProvider(ClientInterface, Generic[M]):
    """Answers calls with a handler; created by :meth:`rce_client.Connection.service_provider`.

    Calls run concurrently. They are cancelled when the connection breaks or the provider is closed.
    """

    role = Role.SERVICE_CLIENT

    def __init__(
        self,
        owner: InterfaceOwner,
        tag: str,
        message_type: str,
        handler: Callable[[M], Awaitable[M] | M],
        *,
        raw: bool,
        max_calls: int,
    ) -> None:
        super().__init__(owner, tag, message_type, raw=raw)
        self._handler = handler
        self._max_calls = max_calls
        self._calls: set[asyncio.Task[None]] = set()

    def deliver(self, message: DataMessage) -> None:
        """Start to answer a call."""
        if len(self._calls) >= self._max_calls:
            self._answer(message.msg_id, f"the robot serves {self._max_calls} calls already")
            return
        task = self._owner.spawn(self._serve(message))
        self._calls.add(task)
        task.add_done_callback(self._calls.discard)

    def on_fault(self, msg_id: str, text: str) -> None:
        """Answer an unreadable request with an error."""
        self._answer(msg_id, f"the robot could not read the request: {text}")

    def on_lost(self) -> None:
        """Cancel all calls: their callers got an error."""
        for task in self._calls:
            task.cancel()

    def on_closed(self) -> None:
        """Cancel all calls."""
        self.on_lost()

    async def _serve(self, message: DataMessage) -> None:
        try:
            made = self._handler(message.msg)
            answer: object = await made if inspect.isawaitable(made) else made
        except CallError as error:  # the handler asked another service
            _log.warning("service %s: %s", self.tag, error)
            answer = str(error)
        except (Exception, asyncio.CancelledError) as error:  # noqa: BLE001 - logged, and the caller gets it
            pass_cancellation(error)
            _log.exception("handler of service %s", self.tag)
            answer = f"{type(error).__name__}: {error}"  # a string is the engine's sign for a failure
        self._answer(message.msg_id, answer)

    def _answer(self, msg_id: str, answer: object) -> None:
        try:
            frames = self._frames(answer, msg_id)
        except Exception as error:  # noqa: BLE001 - logged, and the caller gets it
            _log.exception("answer of service %s", self.tag)
            frames = self._frames(f"the answer cannot be sent: {error}", msg_id)
        if not self._owner.post_control(frames):
            _log.warning("%s: no connection to send an answer on", self.tag)

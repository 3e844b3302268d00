"""Delivers the core's calls to nodes: in order for each node, independently of other nodes."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable
from itertools import islice
from typing import Any

from rce.aio.backoff import Backoff
from rce.aio.tasks import TaskScope
from rce.ros.core.events import Call
from rce.ros.errors import MalformedDocumentError, RpcRefusedError, RpcUnreachableError, XmlRpcError
from rce.ros.xmlrpc import RpcClient
from rce.ros.xmlrpc.batches import MAX_CALLS
from rce.ros.xmlrpc.codec import encode_call
from rce.ros.xmlrpc.dispatch import ERROR

_log = logging.getLogger(__name__)

CALL_TIMEOUT = 5.0
"""Seconds that a node may take to answer one call."""

RETRY = Backoff(first=0.5, longest=15.0, jitter=0.5)
"""Seconds until a call is repeated that a node did not answer."""

MAX_REPEATS = 60
"""A node that answers none of so many calls in a row, for some 15 minutes, is taken to be gone."""

SHUTDOWN = "shutdown"
"""The only call that is not repeated: it may reach a newer node at the same address."""

MAX_DOCUMENTS = 2 * MAX_CALLS
"""How many of the newest calls are kept in serialized form."""

CALLER = "/master"
"""The name under which a core calls nodes."""


class Notifier:
    """One queue of calls for each node.

    A newer call takes the place of a waiting one with the same key, so a queue is never longer than the
    number of topics and parameters of its node, however slow the node is.

    A call that is not answered is repeated: nothing else tells a node that was busy, stopped or out of reach
    for a moment of a publisher that came meanwhile. Only a refused connection shows that the node is gone.
    """

    def __init__(
        self, client: RpcClient, tasks: TaskScope, on_unwanted: Callable[[Call], None] = lambda _: None
    ) -> None:
        """Make a notifier.

        Args:
            client: Makes the calls.
            tasks: Owns a task for each node while calls wait for it.
            on_unwanted: Takes a call that a node answered with -1: it does not know the topic or parameter.
        """
        self._client = client
        self._on_unwanted = on_unwanted
        self._tasks = tasks
        self._waiting: dict[str, dict[object, Call]] = {}
        self._documents: dict[tuple[str, int], tuple[tuple[Any, ...], bytes]] = {}

    def submit(self, call: Call) -> None:
        """Queue a call; returns at once."""
        queue = self._waiting.get(call.uri)
        if queue is None:
            queue = self._waiting[call.uri] = {}
            self._tasks.spawn(self._deliver(call.uri, queue), name=f"notify {call.uri}")
        queue.pop(call.key, None)
        queue[call.key] = call

    async def _deliver(self, uri: str, queue: dict[object, Call]) -> None:
        pauses, repeats = RETRY.start(), 0
        try:
            while queue:
                unanswered = await self._make(uri, self._take(uri, queue), queue)
                if not unanswered:
                    pauses.reset()
                    repeats = 0
                    continue
                repeats += 1
                if repeats > MAX_REPEATS:
                    _log.warning("%s has not answered %d calls: it is not called any more", uri, repeats)
                    return
                _put_first(queue, unanswered)
                await asyncio.sleep(pauses.next())
        finally:
            del self._waiting[uri]

    def _take(self, uri: str, queue: dict[object, Call]) -> list[Call]:
        """Take the next call from a queue; several if the node answers them in one request."""
        count = MAX_CALLS if self._client.takes_batches(uri) else 1
        return [queue.pop(key) for key in list(islice(queue, count))]

    def _written(self, call: Call) -> bytes:
        """Return a call's document, made once for all nodes that are told the same.

        Raises:
            MalformedDocumentError: An argument has no XML-RPC form.
        """
        key = (call.method, id(call.arguments))
        known = self._documents.get(key)
        if known is not None:  # an entry keeps its arguments alive, so their id stays unique
            return known[1]
        document = encode_call(call.method, (CALLER, *call.arguments))
        if len(self._documents) >= MAX_DOCUMENTS:
            del self._documents[next(iter(self._documents))]
        self._documents[key] = call.arguments, document
        return document

    async def _make(self, uri: str, calls: list[Call], queue: dict[object, Call]) -> list[Call]:
        """Make calls, in their order; return those that are to be repeated."""
        written: list[tuple[Call, bytes]] = []
        for call in calls:
            try:
                written.append((call, self._written(call)))
            except MalformedDocumentError as error:
                _log.warning("%s to %s: %s", call.method, uri, error)
        if not written:
            return []
        method, documents = written[0][0].method, [document for _, document in written]
        try:
            answers = await self._client.send_in_order(uri, method, documents, timeout=CALL_TIMEOUT)
        except RpcRefusedError as error:
            _log.info("%s is not delivered: %s", method, error)
            queue.clear()  # the node is gone; a new node at this address registers and learns the state again
            return []
        except RpcUnreachableError as error:
            again = [call for call, _ in written if call.method != SHUTDOWN]
            _log.info("%s is %s: %s", method, "repeated" if again else "not delivered", error)
            return again
        for (call, _), answer in zip(written, answers, strict=True):
            if isinstance(answer, XmlRpcError):
                _log.warning("%s to %s: %s", call.method, uri, answer)
            elif _is_error(answer):
                self._on_unwanted(call)
        return []


def _put_first(queue: dict[object, Call], calls: list[Call]) -> None:
    """Put calls back that were not answered, unless a newer one carries the whole state too.

    Their order stays: the update of a namespace must not come after that of a parameter in it.
    """
    later = queue.copy()
    queue.clear()
    for call in calls:
        if call.key not in later:
            queue[call.key] = call
    queue.update(later)


def _is_error(answer: Any) -> bool:
    return isinstance(answer, (list, tuple)) and list(answer[:1]) == [ERROR]

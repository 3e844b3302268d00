"""Delivers the core's calls to nodes: in order for each node, independently of other nodes."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable
from typing import Any

from rce.aio.backoff import Backoff
from rce.aio.tasks import TaskScope
from rce.ros.core.events import Call
from rce.ros.errors import RpcRefusedError, RpcUnreachableError, XmlRpcError
from rce.ros.xmlrpc import RpcClient
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

MAX_DOCUMENTS = 32
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
                call = queue.pop(next(iter(queue)))
                if await self._call(call, queue):
                    pauses.reset()
                    repeats = 0
                    continue
                repeats += 1
                if repeats > MAX_REPEATS:
                    _log.warning("%s has not answered %d calls: it is not called any more", uri, repeats)
                    return
                if call.key not in queue:  # a newer one carries the whole state too
                    _put_first(queue, call)
                await asyncio.sleep(pauses.next())
        finally:
            del self._waiting[uri]

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

    async def _call(self, call: Call, queue: dict[object, Call]) -> bool:
        """Make a call; return whether it is done with, delivered or not."""
        try:
            document = self._written(call)
            answer = await self._client.send(call.uri, call.method, document, timeout=CALL_TIMEOUT)
        except RpcRefusedError as error:
            _log.info("%s is not delivered: %s", call.method, error)
            queue.clear()  # the node is gone; a new node at this address registers and learns the state again
        except RpcUnreachableError as error:
            if call.method == SHUTDOWN:
                _log.info("%s is not delivered: %s", call.method, error)
                return True
            _log.info("%s is repeated: %s", call.method, error)
            return False
        except XmlRpcError as error:
            _log.warning("%s to %s: %s", call.method, call.uri, error)
        else:
            if _is_error(answer):
                self._on_unwanted(call)
        return True


def _put_first(queue: dict[object, Call], call: Call) -> None:
    """Keep the order: the update of a namespace must not come after that of a parameter in it."""
    later = queue.copy()
    queue.clear()
    queue[call.key] = call
    queue.update(later)


def _is_error(answer: Any) -> bool:
    return isinstance(answer, (list, tuple)) and list(answer[:1]) == [ERROR]

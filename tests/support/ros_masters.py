"""Masters that pass calls on to a core, in ways of their own: served by threads of the test's process."""

from __future__ import annotations

import asyncio
import threading
import xmlrpc.client
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from socketserver import ThreadingMixIn
from typing import Any, Protocol
from xmlrpc.server import SimpleXMLRPCServer


class PassingMaster(Protocol):
    """Answers a node's calls."""

    def _dispatch(self, method: str, arguments: tuple[Any, ...]) -> Any:
        """Answer a call."""


class HoldingMaster:
    """Passes calls on to a core, but holds those of one kind for one name.

    Args:
        core_uri: The core.
        name: The topic, service or parameter.
        method: Beginning of the methods that are held.

    Attributes:
        uri: Where it is served, if the test notes it here.
        calls: The methods that were called with this name, in the order in which they were answered.
        held: How many calls are held.
        refuses: Whether held calls are refused.
        failures: How many of the calls that unregister the name are not carried out.
    """

    def __init__(self, core_uri: str, name: str, method: str = "register") -> None:
        self.uri = ""
        self.calls: list[str] = []
        self.held = 0
        self.refuses = False
        self.failures = 0
        self._core_uri = core_uri
        self._name = name
        self._method = method
        self._released = threading.Event()

    def release(self) -> None:
        """Answer the held registrations, and later ones at once."""
        self._released.set()

    def _dispatch(self, method: str, arguments: tuple[Any, ...]) -> Any:
        concerns = len(arguments) > 1 and arguments[1] == self._name
        if concerns and method.startswith(self._method):
            self.held += 1
            self._released.wait(60)
            self.held -= 1
            if self.refuses:
                self.calls.append(method)
                return -1, "refused", 0
        if concerns and method.startswith("unregister") and self.failures:
            self.failures -= 1
            raise RuntimeError("too busy")
        with xmlrpc.client.ServerProxy(self._core_uri) as core:
            answer: Any = getattr(core, method)(*arguments)
        if concerns:
            self.calls.append(method)
        return answer


class _Server(ThreadingMixIn, SimpleXMLRPCServer):
    """Serves each connection in a thread: a node keeps one open to its master."""


@asynccontextmanager
async def serving(master: PassingMaster) -> AsyncIterator[str]:
    """Serve a master; give its URI."""
    server = _Server(("127.0.0.1", 0), logRequests=False)
    server.register_instance(master)
    thread = threading.Thread(target=server.serve_forever, args=(0.01,))
    thread.start()
    try:
        yield f"http://127.0.0.1:{server.server_address[1]}/"
    finally:
        # Not in the event loop: a call on its way waits for the core, which may be served by it.
        await asyncio.to_thread(_end, server, thread)


def _end(server: _Server, thread: threading.Thread) -> None:
    """End a server, when it has answered what it was asked."""
    server.shutdown()
    thread.join()
    server.server_close()

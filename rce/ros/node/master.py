"""A node's view of its master: the Master API and Parameter Server API as typed coroutines."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from rce.ros.errors import MasterRefusedError, MasterUnreachableError, RpcTimeoutError, XmlRpcError
from rce.ros.xmlrpc import RpcClient
from rce.ros.xmlrpc.codec import encode_call
from rce.ros.xmlrpc.dispatch import SUCCESS


@dataclass(slots=True)
class MasterClient:
    """Calls the master in the name of one node. Every method raises MasterError, as :meth:`call` does."""

    uri: str
    caller: str
    """The node's global name."""
    slave_uri: str
    """The node's own API."""
    rpc: RpcClient
    timeout: float = 10.0
    """Seconds for each call."""

    async def call(self, method: str, *arguments: Any) -> Any:
        """Call any method, with the node's name before ``arguments``.

        Returns:
            The value of the answer.

        Raises:
            MalformedDocumentError: An argument has no XML-RPC form; the master was not asked.
            MasterUnreachableError: No usable answer.
            MasterRefusedError: The status is not success.
        """
        document = encode_call(method, (self.caller, *arguments))
        try:
            answer = await self.rpc.send(self.uri, method, document, timeout=self.timeout)
            status, text, value = answer
        except XmlRpcError as error:
            is_late = isinstance(error, RpcTimeoutError)
            raise MasterUnreachableError(self.uri, str(error), is_late=is_late) from error
        except (TypeError, ValueError) as error:
            raise self._unknown_form(method) from error
        if status != SUCCESS:
            raise MasterRefusedError(method, status, text)
        return value

    async def register_publisher(self, topic: str, message_type: str) -> None:
        """Register the node as a publisher of ``topic``."""
        await self.call("registerPublisher", topic, message_type, self.slave_uri)

    async def unregister_publisher(self, topic: str) -> None:
        """Unregister the node as a publisher of ``topic``."""
        await self.call("unregisterPublisher", topic, self.slave_uri)

    async def register_subscriber(self, topic: str, message_type: str) -> list[str]:
        """Register the node as a subscriber of ``topic``; return the slave APIs of its publishers."""
        publishers = await self.call("registerSubscriber", topic, message_type, self.slave_uri)
        if not isinstance(publishers, list) or not all(isinstance(uri, str) for uri in publishers):
            raise self._unknown_form("registerSubscriber")
        return publishers

    async def unregister_subscriber(self, topic: str) -> None:
        """Unregister the node as a subscriber of ``topic``."""
        await self.call("unregisterSubscriber", topic, self.slave_uri)

    async def register_service(self, name: str, service_uri: str) -> None:
        """Register a service of the node, at ``service_uri``."""
        await self.call("registerService", name, service_uri, self.slave_uri)

    async def unregister_service(self, name: str, service_uri: str) -> None:
        """Unregister a service of the node."""
        await self.call("unregisterService", name, service_uri)

    async def lookup_node(self, name: str) -> str | None:
        """Return the slave API of a node, if the master knows it."""
        try:
            uri: str = await self.call("lookupNode", name)
        except MasterRefusedError:
            return None
        return uri

    async def lookup_service(self, name: str) -> str | None:
        """Return the ``rosrpc`` URI of a service's provider, if there is one."""
        try:
            uri = await self.call("lookupService", name)
        except MasterRefusedError:
            return None
        if not isinstance(uri, str):
            raise self._unknown_form("lookupService")
        return uri

    def _unknown_form(self, method: str) -> MasterUnreachableError:
        return MasterUnreachableError(self.uri, f"{method} was answered in no known form")

"""Questions to other discoveries and to synchronizations."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import replace
from typing import Any

from rce.printable import one_line
from rce.ros.errors import RosError, XmlRpcError
from rce.ros.multimaster import messages
from rce.ros.multimaster.errors import MalformedStateError
from rce.ros.multimaster.filters import SyncFilter
from rce.ros.multimaster.monitor import Origins
from rce.ros.multimaster.peer_table import Contact, PeerKey
from rce.ros.multimaster.source import Snapshot
from rce.ros.multimaster.state import MasterInfo, host_of
from rce.ros.node import Node, ServiceClient
from rce.ros.types.exceptions import SerializationError
from rce.ros.xmlrpc import RpcClient

_log = logging.getLogger(__name__)

CONTACT_TIMEOUT = 5.0
STATE_TIMEOUT = 20.0
ORIGINS_TIMEOUT = 3.0
"""Seconds that others may take to answer."""

MAX_TEXT = 1024
"""Characters of a URI or name in a contact."""

SYNC_INFO = "get_sync_info"


async def ask_contact(rpc: RpcClient, key: PeerKey) -> Contact:
    """Ask a discovery for its contact.

    Raises:
        MalformedStateError: It does not answer, or not in the known form, or does not know its master yet.
    """
    try:
        answer = await rpc.call(key.monitor_uri, "masterContacts", (), timeout=CONTACT_TIMEOUT)
        stamp, master_uri, name, node, _ = answer
        if float(stamp) == 0:
            raise MalformedStateError(f"the discovery at {key.monitor_uri} does not know its master yet")
        return Contact(_text(master_uri), _text(name), _text(node))
    except (XmlRpcError, TypeError, ValueError, OverflowError) as error:
        raise MalformedStateError(
            f"the discovery at {key.monitor_uri} does not say who it is: {error}"
        ) from error


def _text(value: Any) -> str:
    if not isinstance(value, str) or len(value) > MAX_TEXT or one_line(value) != value:
        raise TypeError("a URI or name is not a text, is too long or has control characters")
    return value


async def ask_state(rpc: RpcClient, monitor_uri: str, chosen: SyncFilter) -> MasterInfo:
    """Ask a discovery for its master's state, as far as it passes a filter.

    Raises:
        XmlRpcError: No answer, or the discovery refuses one.
        MalformedStateError: The answer is not of the known form.
    """
    answer = await rpc.call(monitor_uri, "masterInfoFiltered", (chosen.to_wire(),), timeout=STATE_TIMEOUT)
    return MasterInfo.from_wire(answer)


class OriginsReader:
    """Asks the synchronizations at a master where what they registered came from.

    What one answered last counts while it does not answer: else its nodes would be told as this master's own.
    """

    def __init__(self, node: Node, hosts: Callable[[], frozenset[str]]) -> None:
        """Prepare to ask.

        Args:
            node: Asks.
            hosts: Tells all names and addresses of this machine: other machines' synchronizations are not
                asked.
        """
        self._node = node
        self._hosts = hosts
        self._clients: dict[str, ServiceClient] = {}
        self._answers: dict[str, list[Any]] = {}
        """By the service; what was answered last."""
        self._silent: set[str] = set()
        """The services that did not answer when they were asked last."""

    async def read(self, snapshot: Snapshot) -> Origins:
        """Ask all synchronizations among the registrations in ``snapshot``."""
        hosts = self._hosts()
        for service in self._clients.keys() - snapshot.service_uris.keys():
            await self._clients.pop(service).close()
            self._answers.pop(service, None)
            self._silent.discard(service)
        found: list[Any] = []
        for service, uri in snapshot.service_uris.items():
            if service.endswith(SYNC_INFO) and host_of(uri) in hosts:
                found += await self._ask(service)
        return replace(messages.read_origins(found), is_complete=not self._silent)

    async def _ask(self, service: str) -> list[Any]:
        client = self._clients.get(service)
        if client is None:
            client = self._node.service_client(service, messages.GET_SYNC_INFO, persistent=False)
            self._clients[service] = client
        try:
            answer = await client.call({}, timeout=ORIGINS_TIMEOUT)
        except (RosError, SerializationError) as error:
            if service not in self._silent:
                _log.warning("what is registered by others is not known: %s", error)
            self._silent.add(service)
        else:
            self._silent.discard(service)
            self._answers[service] = list(answer.hosts)
        return self._answers.get(service, [])

"""Keeps remote nodes registered at the local master: adds, removes, and restores after a restart."""

from __future__ import annotations

import asyncio
import json
import logging
from collections.abc import Iterable, Mapping
from typing import Any

from rce.aio.backoff import Backoff
from rce.aio.tasks import TaskScope
from rce.ros.errors import (
    MasterError,
    ParameterMissingError,
    RpcRefusedError,
    RpcUnreachableError,
    XmlRpcError,
)
from rce.ros.multimaster.plan import Clash, Registration, RegistrationKind, split_clashes
from rce.ros.multimaster.source import multicall, multicall_as
from rce.ros.node import Node
from rce.ros.node.master import MasterClient

_log = logging.getLogger(__name__)

RECORD = "~registrations"
"""Parameter that records the registrations, so that a successor can remove them after a kill."""

UPDATE_TIMEOUT = 5.0
UPDATE_ATTEMPTS = 10
"""How often a remote subscriber that does not answer is told of its publishers."""
RETRY = Backoff(first=0.5, longest=15.0, jitter=0.5)
"""Seconds between these attempts."""
MASTER_CALLER = "/master"

_REGISTER = {
    RegistrationKind.SUBSCRIBER: "registerSubscriber",
    RegistrationKind.PUBLISHER: "registerPublisher",
    RegistrationKind.SERVICE: "registerService",
}
_UNREGISTER = {
    RegistrationKind.SUBSCRIBER: "unregisterSubscriber",
    RegistrationKind.PUBLISHER: "unregisterPublisher",
    RegistrationKind.SERVICE: "unregisterService",
}
_ORDER = tuple(_REGISTER)
"""Subscribers first: a publisher's registration then tells them."""


class Registrar:
    """All registrations of one synchronization, by the remote master.

    Attributes:
        held: ``{master URI: entries}``.
    """

    def __init__(self, node: Node, master: MasterClient, tasks: TaskScope) -> None:
        """Begin with nothing.

        Args:
            node: The synchronization's node.
            master: Its master.
            tasks: Owns calls to remote subscribers.
        """
        self.held: dict[str, set[Registration]] = {}
        self._node = node
        self._master = master
        self._tasks = tasks
        self._lock = asyncio.Lock()
        self._recorded = ""
        self._told: set[str] = set()

    async def hold(
        self, origin: str, wanted: set[Registration], publishers: Mapping[str, Iterable[str]]
    ) -> list[Clash]:
        """Make exactly the registrations ``wanted`` for a remote master.

        Args:
            origin: The remote master's URI.
            wanted: Its registrations.
            publishers: Topic -> URIs of its publishers at the remote master; its subscribers keep them.

        Returns:
            The entries that could not be registered, because the local graph has one of that name.

        Raises:
            MasterError: The local master does not answer; to be tried again.
        """
        async with self._lock:
            held = self.held.get(origin, set())
            await self._unregister(origin, held - wanted)
            fine, clashes = await self._without_clashes(origin, wanted - held)
            await self._register(origin, fine, publishers)
        for clash in clashes:
            self._tell_once(str(clash))
        return clashes

    async def release(self, origin: str) -> None:
        """Remove all registrations of a remote master.

        Raises:
            MasterError: The local master does not answer; to be tried again.
        """
        async with self._lock:
            await self._unregister(origin, set(self.held.get(origin, ())))

    async def restore(self) -> None:
        """Register everything again: the local master was restarted.

        Raises:
            MasterError: It does not answer.
        """
        async with self._lock:
            everything, self.held = self.held, {}
            self._recorded = ""
            for origin, entries in everything.items():
                fine, _ = await self._without_clashes(origin, entries)
                await self._register(origin, fine, {})

    async def take_back_leftovers(self) -> None:
        """Remove the registrations of a synchronization that was killed.

        Raises:
            MasterError: The local master does not answer.
        """
        try:
            entries = json.loads(await self._node.get_param(RECORD))
            left = [Registration(RegistrationKind(kind), *rest) for kind, *rest in entries]
        except ParameterMissingError:
            return
        except (TypeError, ValueError) as error:
            _log.warning("the record of a former synchronization cannot be read: %s", error)
            return
        if left:
            _log.info("%d registrations of a former synchronization are taken back", len(left))
            await multicall_as(self._master, [_unregistering(entry) for entry in left])

    # Inside

    async def _without_clashes(
        self, origin: str, candidates: set[Registration]
    ) -> tuple[set[Registration], list[Clash]]:
        nodes = sorted({entry.node for entry in candidates})
        services = sorted(entry.name for entry in candidates if entry.kind is RegistrationKind.SERVICE)
        node_uris = await multicall(self._master, [("lookupNode", node) for node in nodes])
        addresses = await multicall(self._master, [("lookupService", service) for service in services])
        own = {(entry.node, entry.uri) for entry in self.held.get(origin, ())}
        taken = {
            node: uri for node, uri in zip(nodes, node_uris, strict=True) if uri and (node, uri) not in own
        }
        provided = {name: uri for name, uri in zip(services, addresses, strict=True) if uri}
        return split_clashes(candidates, taken, provided)

    async def _register(
        self, origin: str, entries: set[Registration], publishers: Mapping[str, Iterable[str]]
    ) -> None:
        if not entries:
            return
        ordered = sorted(entries, key=lambda entry: (_ORDER.index(entry.kind), entry.name, entry.node))
        # Recorded before it is registered: questions for a node's origin get the right answer meanwhile.
        self.held.setdefault(origin, set()).update(entries)
        try:
            await self._record()
            answers = await multicall_as(self._master, [_registering(entry) for entry in ordered])
        except MasterError:
            self.held[origin] -= entries
            raise
        for entry, answer in zip(ordered, answers, strict=True):
            _log.info("%s %s of %s is registered", entry.kind.value, entry.name, entry.node)
            if entry.kind is RegistrationKind.SUBSCRIBER and isinstance(answer, list) and answer:
                uris = [*dict.fromkeys([*publishers.get(entry.name, ()), *answer])]
                self._tasks.spawn(self._tell_subscriber(entry, uris), name=f"tell {entry.node}")

    async def _unregister(self, origin: str, entries: set[Registration]) -> None:
        if not entries:
            return
        await multicall_as(self._master, [_unregistering(entry) for entry in entries])
        for entry in entries:
            _log.info("%s %s of %s is taken back", entry.kind.value, entry.name, entry.node)
        self.held[origin] -= entries
        if not self.held[origin]:
            del self.held[origin]
        await self._record()

    async def _record(self) -> None:
        rows = [
            [entry.kind.value, entry.name, entry.node, entry.uri, entry.detail]
            for entries in self.held.values()
            for entry in entries
        ]
        text = json.dumps(sorted(rows))
        if text != self._recorded:
            await self._node.set_param(RECORD, text)
            self._recorded = text

    async def _tell_subscriber(self, entry: Registration, uris: list[str]) -> None:
        """Send a remote subscriber its publishers, which the master only gave in its answer to this node."""
        arguments = (MASTER_CALLER, entry.name, uris)
        left = UPDATE_ATTEMPTS
        pauses = RETRY.start()
        while True:
            left -= 1
            try:
                await self._master.rpc.call(entry.uri, "publisherUpdate", arguments, timeout=UPDATE_TIMEOUT)
            except XmlRpcError as error:
                is_gone = isinstance(error, RpcRefusedError) or not isinstance(error, RpcUnreachableError)
                if is_gone or not left:
                    _log.warning("%s does not learn of publishers of %s: %s", entry.node, entry.name, error)
                    return
                await asyncio.sleep(pauses.next())  # it may be busy, or out of reach for a moment
            else:
                return

    def _tell_once(self, text: str) -> None:
        if text not in self._told:
            self._told.add(text)
            _log.warning("%s", text)


def _registering(entry: Registration) -> tuple[str, str, tuple[Any, ...]]:
    return _REGISTER[entry.kind], entry.node, (entry.name, entry.detail, entry.uri)


def _unregistering(entry: Registration) -> tuple[str, str, tuple[Any, ...]]:
    address = entry.detail if entry.kind is RegistrationKind.SERVICE else entry.uri
    return _UNREGISTER[entry.kind], entry.node, (entry.name, address)

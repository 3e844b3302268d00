"""Keeps remote nodes registered at the local master: adds, removes, and restores after a restart."""

from __future__ import annotations

import asyncio
import contextlib
import hashlib
import json
import logging
from collections.abc import Collection, Mapping
from collections.abc import Set as AbstractSet
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
"""Namespace of parameters that record the registrations, so that a successor can remove them after a kill.

One parameter for each remote master: what changes at one of many costs what that one has. Former releases
wrote one for all, without a namespace.
"""

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
        self._recorded: dict[str, str] = {}
        """By the remote master: the parameter as it was written last."""
        self._unsure: set[str] = set()
        """Remote masters of which a call was not answered: what it registered may be there or not."""
        self._told: set[str] = set()
        self._publishers: dict[str, Mapping[str, Collection[str]]] = {}
        """By the remote master: topic -> URIs of its publishers there, as they were told last."""

    async def hold(
        self,
        origin: str,
        wanted: set[Registration],
        publishers: Mapping[str, Collection[str]],
        *,
        stale: AbstractSet[str] = frozenset(),
        again: bool = False,
    ) -> list[Clash]:
        """Make exactly the registrations ``wanted`` for a remote master.

        Args:
            origin: The remote master's URI.
            wanted: Its registrations.
            publishers: Topic -> URIs of its publishers at the remote master; its subscribers keep them.
            stale: The URIs of masters that are offline: their registrations give way to these.
            again: Make also those again that were made before; subscribers are then told of all publishers.

        Returns:
            The entries that could not be registered, because the local graph has one of that name.

        Raises:
            MasterError: The local master does not answer; to be tried again.
        """
        async with self._lock:
            self._publishers[origin] = publishers
            held = self.held.get(origin, set())
            again = again or origin in self._unsure
            await self._unregister(origin, held - wanted)
            await self._give_way(origin, wanted - held, stale)
            fine, clashes = await self._without_clashes(origin, wanted if again else wanted - held)
            held -= {clash.registration for clash in clashes}  # a node here took the name from it
            await self._register(origin, fine)
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
            self._unsure.discard(origin)
            self._publishers.pop(origin, None)

    async def restore(self) -> None:
        """Register everything again: the local master was restarted.

        What is at the master already, as it was registered since, stays this synchronization's own.

        Raises:
            MasterError: It does not answer; to be tried again.
        """
        async with self._lock:
            self._recorded.clear()
            self._unsure |= self.held.keys()
            for origin, entries in list(self.held.items()):
                fine, clashes = await self._without_clashes(origin, entries)
                entries -= {clash.registration for clash in clashes}  # a node here took the name from it
                if not entries:
                    del self.held[origin]
                await self._register(origin, fine)
                await self._record(origin)

    async def take_back_leftovers(self) -> None:
        """Remove the registrations of a synchronization that was killed.

        Raises:
            MasterError: The local master does not answer.
        """
        try:
            record = await self._node.get_param(RECORD)
        except ParameterMissingError:
            return
        left: list[Registration] = []
        for text in record.values() if isinstance(record, dict) else [record]:
            try:
                left += [Registration(RegistrationKind(kind), *rest) for kind, *rest in json.loads(text)]
            except (TypeError, ValueError) as error:
                _log.warning("the record of a former synchronization cannot be read: %s", error)
        if left:
            _log.info("%d registrations of a former synchronization are taken back", len(left))
            await multicall_as(self._master, [_unregistering(entry) for entry in left])
        await self._delete(RECORD)

    # Inside

    async def _give_way(self, origin: str, candidates: set[Registration], stale: AbstractSet[str]) -> None:
        """Take back what offline masters have by the names of ``candidates``: it may have moved."""
        nodes = {entry.node: entry.uri for entry in candidates}
        services = {entry.name for entry in candidates if entry.kind is RegistrationKind.SERVICE}
        for other in stale & self.held.keys() - {origin}:
            taken = {
                entry
                for entry in self.held[other]
                if nodes.get(entry.node, entry.uri) != entry.uri
                or (entry.kind is RegistrationKind.SERVICE and entry.name in services)
            }
            await self._unregister(other, taken)

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

    async def _register(self, origin: str, entries: set[Registration]) -> None:
        if not entries:
            return
        ordered = sorted(entries, key=lambda entry: (_ORDER.index(entry.kind), entry.name, entry.node))
        # Recorded before it is registered: questions for a node's origin get the right answer meanwhile.
        self.held.setdefault(origin, set()).update(entries)
        self._unsure.add(origin)
        await self._record(origin)
        answers = await multicall_as(self._master, [_registering(entry) for entry in ordered])
        self._unsure.discard(origin)
        for entry, answer in zip(ordered, answers, strict=True):
            _log.info("%s %s of %s is registered", entry.kind.value, entry.name, entry.node)
            if entry.kind is RegistrationKind.SUBSCRIBER and isinstance(answer, list) and answer:
                self._tasks.spawn(self._tell_subscriber(origin, entry, answer), name=f"tell {entry.node}")

    async def _unregister(self, origin: str, entries: set[Registration]) -> None:
        if not entries:
            return
        await multicall_as(self._master, [_unregistering(entry) for entry in entries])
        for entry in entries:
            _log.info("%s %s of %s is taken back", entry.kind.value, entry.name, entry.node)
        self.held[origin] -= entries
        if not self.held[origin]:
            del self.held[origin]
        await self._record(origin)

    async def _record(self, origin: str) -> None:
        rows = [
            [entry.kind.value, entry.name, entry.node, entry.uri, entry.detail]
            for entry in self.held.get(origin, ())
        ]
        text = json.dumps(sorted(rows)) if rows else ""
        if text == self._recorded.get(origin, ""):
            return
        if text:
            await self._node.set_param(_record_of(origin), text)
            self._recorded[origin] = text
        else:
            await self._delete(_record_of(origin))
            del self._recorded[origin]

    async def _delete(self, name: str) -> None:
        with contextlib.suppress(ParameterMissingError):  # as after a restart of the master
            await self._node.delete_param(name)

    async def _tell_subscriber(self, origin: str, entry: Registration, here: list[str]) -> None:
        """Send a remote subscriber its publishers, which the master only gave in its answer to this node."""
        left = UPDATE_ATTEMPTS
        pauses = RETRY.start()
        while here:
            left -= 1
            there = self._publishers.get(origin, {}).get(entry.name, ())
            arguments = (MASTER_CALLER, entry.name, [*dict.fromkeys([*there, *here])])
            try:
                await self._master.rpc.call(entry.uri, "publisherUpdate", arguments, timeout=UPDATE_TIMEOUT)
            except XmlRpcError as error:
                is_gone = isinstance(error, RpcRefusedError) or not isinstance(error, RpcUnreachableError)
                if is_gone or not left:
                    _log.warning("%s does not learn of publishers of %s: %s", entry.node, entry.name, error)
                    return
            else:
                return
            await asyncio.sleep(pauses.next())  # it may be busy, or out of reach for a moment
            with contextlib.suppress(MasterError):  # then those that it named last are told
                here = await self._publishers_here(origin, entry)

    async def _publishers_here(self, origin: str, entry: Registration) -> list[str]:
        """Ask the master for the publishers of a remote subscriber; none if that is not held any longer.

        The master may have told the subscriber of a change meanwhile, which must not be undone.

        Raises:
            MasterError: The master does not answer.
        """
        async with self._lock:
            if entry not in self.held.get(origin, ()):
                return []
            (answer,) = await multicall_as(self._master, [_registering(entry)])
        return answer if isinstance(answer, list) else []

    def _tell_once(self, text: str) -> None:
        if text not in self._told:
            self._told.add(text)
            _log.warning("%s", text)


def _record_of(origin: str) -> str:
    """Return the parameter that records the registrations of a remote master."""
    return f"{RECORD}/m{hashlib.sha256(origin.encode()).hexdigest()[:16]}"


def _registering(entry: Registration) -> tuple[str, str, tuple[Any, ...]]:
    return _REGISTER[entry.kind], entry.node, (entry.name, entry.detail, entry.uri)


def _unregistering(entry: Registration) -> tuple[str, str, tuple[Any, ...]]:
    address = entry.detail if entry.kind is RegistrationKind.SERVICE else entry.uri
    return _UNREGISTER[entry.kind], entry.node, (entry.name, address)

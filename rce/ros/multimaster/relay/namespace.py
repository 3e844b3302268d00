"""A remote master's topics and services in a namespace of their own here: renamed, hence relayed."""

from __future__ import annotations

import asyncio
import logging

from rce.aio.tasks import TaskScope
from rce.ros.multimaster import messages
from rce.ros.multimaster.filters import SyncFilter
from rce.ros.multimaster.peer_table import Neighbour
from rce.ros.multimaster.relay.exporter import Exporter
from rce.ros.multimaster.relay.frames import Frame
from rce.ros.multimaster.relay.importer import Importer
from rce.ros.multimaster.relay.link import broken_by
from rce.ros.multimaster.remote import Remote
from rce.ros.names import SEPARATOR, canonical
from rce.ros.node import Node
from rce.ros.node.master import MasterClient
from rce.ros.xmlrpc import RpcClient

_log = logging.getLogger(__name__)


def add_namespace(name: str, namespace: str) -> str:
    """Put a global name below a namespace (``/ns``)."""
    return canonical(namespace + SEPARATOR + name)


def strip_namespace(name: str, namespace: str) -> str | None:
    """Undo :func:`add_namespace`; None for a name that is not below the namespace."""
    prefix = canonical(namespace) + SEPARATOR
    return SEPARATOR + name.removeprefix(prefix) if name.startswith(prefix) else None


class NamespaceRemote(Remote):
    """Relays a master's ``/x`` to ``/NS/x`` here, and what is published here as ``/NS/y`` to ``/y`` there.

    It uses a node of its own at the remote master, and the synchronization's node here.
    """

    def __init__(
        self,
        master: Neighbour,
        *,
        namespace: str,
        chosen: SyncFilter,
        node: Node,
        local: MasterClient,
        rpc: RpcClient,
        tasks: TaskScope,
    ) -> None:
        """Begin.

        Args:
            master: The remote master.
            namespace: Where its names are here.
            chosen: The user's filter, by the names there.
            node: The synchronization's node.
            local: Its master.
            rpc: Makes calls.
            tasks: Owns the relay.
        """
        super().__init__(master, rpc)
        self._namespace = canonical(SEPARATOR + namespace)
        self._chosen = chosen
        self._node = node
        self._local = local
        self._tasks = tasks
        self._relay: asyncio.Task[None] | None = None

    async def synchronize(self, *, again: bool = False) -> None:
        """Begin to relay, unless it is being relayed already."""
        del again  # the relay's own node makes its connections anew
        if self._relay is None or self._relay.done():
            self._relay = self._tasks.spawn(self._run_relay(), name=f"relay of {self.master.name}")

    async def release(self) -> None:
        """End the relay."""
        if self._relay is not None:
            self._relay.cancel()
            await asyncio.wait([self._relay])
            self._relay = None

    async def _run_relay(self) -> None:
        _log.info("master %s is relayed as %s", self.master.name, self._namespace)
        try:
            async with self._make_node() as there, TaskScope() as tasks:
                remote = MasterClient(self.master.uri, there.name, there.uri, self.rpc)
                await self._join(there, remote, tasks)
        except Exception as error:  # noqa: BLE001 - a master's answers must not end the relays of others
            _log.warning("the relay of %s ends: %s", self.master.name, broken_by(error))

    def _make_node(self) -> Node:
        return Node(
            "master_sync_relay",
            argv=[],
            master_uri=self.master.uri,
            types=messages.registry(),
            anonymous=True,
            master_timeout=None,
        )

    async def _join(self, there: Node, remote: MasterClient, tasks: TaskScope) -> None:
        """Run two pairs of ends, one for each direction."""
        inward = _Pair()
        outward = _Pair()
        inward.exporter = Exporter(there, remote, self._chosen, inward.to_importer, tasks)
        inward.importer = Importer(
            self._node,
            self._local,
            self._chosen,
            inward.to_exporter,
            rename=lambda name: add_namespace(name, self._namespace),
        )
        outward.exporter = Exporter(
            self._node,
            self._local,
            self._chosen,
            outward.to_importer,
            tasks,
            rename=lambda name: strip_namespace(name, self._namespace),
        )
        outward.importer = Importer(there, remote, self._chosen, outward.to_exporter)
        async with asyncio.TaskGroup() as group:
            for end in (inward.exporter, inward.importer, outward.exporter, outward.importer):
                group.create_task(end.run())


class _Pair:
    """Two ends of a relay in one process."""

    exporter: Exporter
    importer: Importer

    def to_importer(self, frame: Frame) -> None:
        self.importer.take(frame)

    def to_exporter(self, frame: Frame) -> None:
        self.exporter.take(frame)

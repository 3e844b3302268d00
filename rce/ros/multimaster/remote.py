"""One remote master in a synchronization."""

from __future__ import annotations

import asyncio
import contextlib
import logging
from abc import ABC, abstractmethod

from rce.ros.errors import RosError
from rce.ros.multimaster.contacts import ask_state
from rce.ros.multimaster.filters import SyncFilter
from rce.ros.multimaster.peer_table import Neighbour
from rce.ros.multimaster.plan import unreachable_nodes, wanted
from rce.ros.multimaster.registrar import Registrar
from rce.ros.multimaster.state import MasterInfo
from rce.ros.xmlrpc import RpcClient

_log = logging.getLogger(__name__)

RETRY = 1.0
"""Seconds until a failed attempt is repeated."""

LOOK_AGAIN = 10.0
"""Seconds between checks of a master's state without an announcement: a clash may have ended."""


class Remote(ABC):
    """Synchronizes with one master, for as long as it is there."""

    def __init__(self, master: Neighbour) -> None:
        self.master = master
        self._is_gone = False
        self._wake = asyncio.Event()
        self._wake.set()

    def update(self, master: Neighbour) -> None:
        """Take the master's present state from the discovery."""
        was_gone, self._is_gone = self._is_gone, False
        if was_gone or master != self.master:
            self.master = master
            self._wake.set()

    def again(self) -> None:
        """Check the master again."""
        self._wake.set()

    def leave(self) -> None:
        """Take note that the master is gone or no longer wanted; :meth:`run` then ends."""
        self._is_gone = True
        self._wake.set()

    @property
    def is_online(self) -> bool:
        """Whether the master is there and wanted."""
        return self.master.online and not self._is_gone

    async def run(self) -> None:
        """Synchronize until the master is gone and all its registrations are removed."""
        timeout = 0.0
        while True:
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(timeout):
                    await self._wake.wait()
            self._wake.clear()
            try:
                if self.is_online:
                    await self.synchronize()
                else:
                    await self.release()
                    if self._is_gone:
                        return
                timeout = LOOK_AGAIN
            except (RosError, OSError) as error:
                _log.warning("master %s: %s", self.master.name, error)
                timeout = RETRY

    @abstractmethod
    async def synchronize(self) -> None:
        """Bring the local graph in step with the master.

        Raises:
            RosError: It does not work now; it is tried again.
        """

    @abstractmethod
    async def release(self) -> None:
        """Take everything back.

        Raises:
            RosError: It does not work now; it is tried again.
        """


class DirectRemote(Remote):
    """Registers a master's nodes here, so that nodes connect to each other directly."""

    def __init__(
        self,
        master: Neighbour,
        *,
        own_uri: str,
        chosen: SyncFilter,
        registrar: Registrar,
        rpc: RpcClient,
        distinct_names: bool,
    ) -> None:
        """Begin.

        Args:
            master: The remote master.
            own_uri: The local one.
            chosen: The user's filter.
            registrar: Registers at the local master.
            rpc: Asks the remote discovery.
            distinct_names: Register nodes as ``NODE_at_MASTER``.
        """
        super().__init__(master)
        self._own_uri = own_uri
        self._chosen = chosen
        self._registrar = registrar
        self._rpc = rpc
        self._distinct_names = distinct_names
        self._warned: set[str] = set()

    async def synchronize(self) -> None:
        """Register what the master has."""
        info = await ask_state(self._rpc, self.master.monitor_uri, self._chosen)
        entries = wanted(info, self._own_uri, self._chosen, distinct_names=self._distinct_names)
        self._warn_of_unreachable(info)
        await self._registrar.hold(self.master.uri, entries, publisher_uris(info))

    async def release(self) -> None:
        """Take everything back."""
        await self._registrar.release(self.master.uri)

    def _warn_of_unreachable(self, info: MasterInfo) -> None:
        nodes = [node for node in unreachable_nodes(info) if node not in self._warned]
        if nodes:
            self._warned.update(nodes)
            _log.warning(
                "master %s: %s can only be reached on their own machine: set ROS_IP there",
                self.master.name,
                ", ".join(nodes),
            )


def publisher_uris(info: MasterInfo) -> dict[str, list[str]]:
    """Return the addresses of the publishers of each topic."""
    return {
        topic: [info.nodes[node].uri for node in nodes if node in info.nodes]
        for topic, nodes in info.publishers.items()
    }

"""One remote master in a synchronization."""

from __future__ import annotations

import asyncio
import contextlib
import logging
from abc import ABC, abstractmethod
from collections.abc import Callable
from collections.abc import Set as AbstractSet

from rce.ros.errors import RosError, XmlRpcError
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


REACH_TIMEOUT = 3.0
"""Seconds that the discovery of a master that is offline has to answer."""


class Remote(ABC):
    """Synchronizes with one master, for as long as it is there."""

    def __init__(self, master: Neighbour, rpc: RpcClient) -> None:
        self.master = master
        self.rpc = rpc
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
        """Synchronize until the master is gone and all its registrations are removed.

        While it is offline, they stay: its nodes may work on, and a subscriber of roscpp closes the
        connection to a publisher that its master ceases to name. When it is back, all are made again, so that
        the subscribers are told of the publishers again: rospy makes a lost connection anew only then. If its
        discovery could not be reached meanwhile, connections may hang, until TCP tries again after a time as
        long as the outage was; so all are taken back first, which has them made anew.
        """
        timeout = 0.0
        was_offline = was_away = False
        fault = ""
        """Why the last attempt failed; logged once, not each second."""
        while True:
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(timeout):
                    await self._wake.wait()
            self._wake.clear()
            timeout = LOOK_AGAIN
            try:
                was_gone = self._is_gone
                if was_gone or (was_away and self.master.online):
                    await self.release()
                    was_offline = was_away = False
                    if was_gone and self._is_gone:  # and not back meanwhile
                        return
                if self.master.online:
                    await self.synchronize(again=was_offline)
                    was_offline = False
                else:
                    was_offline = True
                    was_away = was_away or not await self._is_reachable()
            except (RosError, OSError) as error:
                if str(error) != fault:
                    _log.warning("master %s: %s", self.master.name, error)
                fault = str(error)
                timeout = RETRY
            else:
                fault = ""

    async def _is_reachable(self) -> bool:
        try:
            await self.rpc.call(self.master.monitor_uri, "masterContacts", (), timeout=REACH_TIMEOUT)
        except XmlRpcError:
            return False
        return True

    @abstractmethod
    async def synchronize(self, *, again: bool = False) -> None:
        """Bring the local graph in step with the master.

        Args:
            again: The master was offline: what is registered already is registered again.

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
        offline: Callable[[], AbstractSet[str]],
    ) -> None:
        """Begin.

        Args:
            master: The remote master.
            own_uri: The local one.
            chosen: The user's filter.
            registrar: Registers at the local master.
            rpc: Asks the remote discovery.
            distinct_names: Register nodes as ``NODE_at_MASTER``.
            offline: Returns the URIs of the masters that are offline.
        """
        super().__init__(master, rpc)
        self._own_uri = own_uri
        self._chosen = chosen
        self._registrar = registrar
        self._distinct_names = distinct_names
        self._offline = offline
        self._warned: set[str] = set()

    async def synchronize(self, *, again: bool = False) -> None:
        """Register what the master has."""
        info = await ask_state(self.rpc, self.master.monitor_uri, self._chosen)
        entries = wanted(info, self._own_uri, self._chosen, distinct_names=self._distinct_names)
        self._warn_of_unreachable(info)
        await self._registrar.hold(
            self.master.uri, entries, publisher_uris(info), stale=self._offline(), again=again
        )

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

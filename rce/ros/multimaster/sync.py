"""A synchronization: registers the entries of other masters here, as far as the user's filters take them."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable, Mapping
from contextlib import AsyncExitStack
from dataclasses import dataclass, field
from types import TracebackType
from typing import Any, Self

from rce.aio.tasks import TaskScope
from rce.ros.errors import MasterError, RosError
from rce.ros.multimaster import messages
from rce.ros.multimaster.addresses import master_name
from rce.ros.multimaster.filters import SyncLists
from rce.ros.multimaster.listing import masters_known_at
from rce.ros.multimaster.peer_table import Neighbour, PeerChange, PeerEvent
from rce.ros.multimaster.registrar import Registrar
from rce.ros.multimaster.relay.exporter import Exporter
from rce.ros.multimaster.relay.frames import Frame
from rce.ros.multimaster.relay.importer import Importer
from rce.ros.multimaster.relay.link import LinkIdentity, RelayLinks, check_listening
from rce.ros.multimaster.relay.namespace import NamespaceRemote, add_namespace
from rce.ros.multimaster.remote import DirectRemote, Remote
from rce.ros.multimaster.settings import local_master
from rce.ros.multimaster.source import Run, ask_run
from rce.ros.node import Node
from rce.ros.node.master import MasterClient
from rce.ros.node.runtime import TypeName
from rce.ros.tcpros.header import ANY
from rce.ros.types import MessageType
from rce.ros.types.exceptions import SerializationError, TypesError
from rce.ros.xmlrpc import RpcClient

_log = logging.getLogger(__name__)

DISCOVERY_URI = "/master_discovery/masteruri"
REFRESH = 5.0
"""Seconds between reads of the discovery's whole list, besides the changes that it announces."""

LOOK_FOR_DISCOVERY = 0.5
WATCH_MASTER = 1.0
GOODBYE_TIMEOUT = 5.0


@dataclass(frozen=True, slots=True)
class SyncSettings:
    """Settings of one synchronization."""

    master_uri: str = ""
    """The local master; if empty, ``ROS_MASTER_URI``."""
    node_name: str = "master_sync"
    lists: SyncLists = field(default_factory=SyncLists)
    distinct_names: bool = False
    """Register remote nodes as ``NODE_at_MASTER``."""
    namespaces: Mapping[str, str] = field(default_factory=dict)
    """Master's name (``*``: every other) -> namespace that its names get here, which takes a relay."""
    relay_to: tuple[tuple[str, int], ...] = ()
    """Hosts and ports to make relay links to."""
    relay_listen: int | None = None
    """Port on which to take relay links; None: none, 0: a free one."""
    relay_addr: str = ""
    """Address on which to take relay links; if empty, all."""
    relay_token: str = field(default="", repr=False)
    """The token that both sides of a relay link must have."""
    relay_name: str = ""
    """This side's name on relay links; if empty, the local master's."""

    def __post_init__(self) -> None:
        """Refuse relay links from other machines without a token.

        Raises:
            MultimasterError: Other machines could connect, and no token is set that they must have.
        """
        if self.relay_listen is not None:
            check_listening(self.relay_addr, self.relay_token)

    def namespace_of(self, master: str) -> str:
        """Return the namespace for a master; empty: its names stay."""
        return self.namespaces.get(master, self.namespaces.get("*", ""))


class MasterSync:
    """Registers what other masters have at the local one. An async context manager, working inside its block.

    It needs a discovery at the local master, ours or fkie's, and waits for one. Leaving the block takes
    everything back.
    """

    def __init__(self, settings: SyncSettings | None = None) -> None:
        self.settings = settings or SyncSettings()
        self._master_uri = local_master(self.settings.master_uri)
        self._remotes: dict[str, Remote] = {}
        self._own_uri = ""
        self._is_leaving = False
        self._changes_topics: set[str] = set()
        self._waiting: dict[str, PeerEvent] | None = None
        """The last change of each master since the list was asked for; None while it is not."""
        self._stack = AsyncExitStack()
        self._links = RelayLinks(LinkIdentity(""), self._make_ends)
        self.relay_port = 0
        """The port on which relay links are taken."""
        self._node: Node
        self._master: MasterClient
        self._tasks: TaskScope
        self._rpc: RpcClient
        self._state_type: MessageType
        self.registrar: Registrar

    @property
    def masters(self) -> list[str]:
        """Names of the masters that are synchronized with and online."""
        return sorted(remote.master.name for remote in self._remotes.values() if remote.is_online)

    # Life

    async def __aenter__(self) -> Self:
        async with AsyncExitStack() as stack:
            self._rpc = await stack.enter_async_context(RpcClient())
            types = messages.registry()
            self._state_type = types.message(messages.MASTER_STATE)
            self._node = await stack.enter_async_context(
                Node(
                    self.settings.node_name,
                    argv=[],
                    master_uri=self._master_uri,
                    types=types,
                    master_timeout=None,
                )
            )
            self._master = MasterClient(self._master_uri, self._node.name, self._node.uri, self._rpc)
            background = await stack.enter_async_context(TaskScope())
            self.registrar = Registrar(self._node, self._master, background)
            await self.registrar.take_back_leftovers()
            await self._node.advertise_service("~get_sync_info", messages.GET_SYNC_INFO, self._sync_info)
            stack.push_async_callback(self._take_back)
            self._tasks = await stack.enter_async_context(TaskScope())
            self._tasks.spawn(self._follow_discovery(), name="follow the discovery")
            self._tasks.spawn(self._watch_master(), name="watch the master")
            await self._start_links()
            self._stack = stack.pop_all()
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._is_leaving = True
        await self._stack.aclose()

    async def _take_back(self) -> None:
        try:
            async with asyncio.timeout(GOODBYE_TIMEOUT):
                for origin in list(self.registrar.held):
                    await self.registrar.release(origin)
        except (MasterError, TimeoutError) as error:
            _log.warning("not everything is taken back: %s", str(error) or "it took too long")

    def _sync_info(self, _request: Any) -> dict[str, Any]:
        return {
            "hosts": [
                messages.sync_master_info(origin, entries) for origin, entries in self.registrar.held.items()
            ]
        }

    # The discovery

    async def _follow_discovery(self) -> None:
        """Keep the remotes in step with the discovery's list and its changes."""
        has_discovery = True
        while True:
            self._waiting = {}
            try:
                await self._listen_for_changes()
                masters = await masters_known_at(self._node, self._master)
                self._own_uri = await self._ask_own_uri()
            except (RosError, TypesError) as error:
                if has_discovery:
                    _log.warning("%s", error)
                has_discovery = False
            else:
                has_discovery = True
                self._take_list(masters)
            self._take_waiting()
            await asyncio.sleep(REFRESH if has_discovery else LOOK_FOR_DISCOVERY)

    async def _ask_own_uri(self) -> str:
        """Return the local master's URI as its discovery tells others."""
        uri: str = await self._node.get_param(DISCOVERY_URI, "") or await self._master.call("getUri")
        return uri

    async def _listen_for_changes(self) -> None:
        """Listen to discoveries of any release: their constants differ, and so does the checksum."""
        types = await self._master.call("getTopicTypes")
        found = {topic for topic, kind in types if kind == messages.MASTER_STATE} - self._changes_topics
        for topic in found:
            await self._node.subscribe_serialized(
                topic, TypeName(messages.MASTER_STATE, ANY), self._take_serialized_change
            )
            self._changes_topics.add(topic)

    def _take_list(self, masters: list[Neighbour]) -> None:
        for master in masters:
            self._take(master)
        for gone in self._remotes.keys() - {master.uri for master in masters}:
            self._remotes[gone].leave()

    def _take_serialized_change(self, payload: bytes, latched: bool) -> None:
        del latched
        try:
            event = messages.read_master_state(self._state_type.deserialize(payload))
        except (SerializationError, ValueError) as error:
            _log.warning("a change that is not understood: %s", error)
            return
        if self._waiting is None:
            self._take_change(event)
        else:
            self._waiting[event.master.uri] = event

    def _take_waiting(self) -> None:
        """Apply the changes that came while the list was requested: they may be newer than it."""
        waiting, self._waiting = self._waiting or {}, None
        for event in waiting.values():
            self._take_change(event)

    def _take_change(self, event: PeerEvent) -> None:
        if event.change is not PeerChange.REMOVED:
            self._take(event.master)
        elif event.master.uri in self._remotes:
            self._remotes[event.master.uri].leave()

    def _take(self, master: Neighbour) -> None:
        remote = self._remotes.get(master.uri)
        if remote is not None:
            if self._is_wanted(master):  # one that was left for a relay link stays left
                remote.update(master)
        elif self._is_wanted(master):
            remote = self._remotes[master.uri] = self._make_remote(master)
            self._tasks.spawn(self._run(remote), name=f"synchronize with {master.name}")

    def _is_wanted(self, master: Neighbour) -> bool:
        if self._is_leaving or self._own_uri in ("", master.uri) or master.name in self._links.connected:
            return False
        return self.settings.lists.takes_host(master.name)

    def _make_remote(self, master: Neighbour) -> Remote:
        own_nodes = (master.discoverer, self._node.name)
        chosen = self.settings.lists.filter_for(master.name, never_nodes=own_nodes)
        if namespace := self.settings.namespace_of(master.name):
            return NamespaceRemote(
                master,
                namespace=namespace,
                chosen=chosen,
                node=self._node,
                local=self._master,
                rpc=self._rpc,
                tasks=self._tasks,
            )
        return DirectRemote(
            master,
            own_uri=self._own_uri,
            chosen=chosen,
            registrar=self.registrar,
            rpc=self._rpc,
            distinct_names=self.settings.distinct_names,
            offline=self._offline_masters,
        )

    def _offline_masters(self) -> set[str]:
        return {uri for uri, remote in self._remotes.items() if not remote.is_online}

    async def _run(self, remote: Remote) -> None:
        try:
            await remote.run()
        finally:
            del self._remotes[remote.master.uri]

    # Relay links

    async def _start_links(self) -> None:
        settings = self.settings
        if not settings.relay_to and settings.relay_listen is None:
            return
        name = settings.relay_name or master_name(await self._ask_own_uri())
        self._links = RelayLinks(LinkIdentity(name, settings.relay_token), self._make_ends)
        for host, port in settings.relay_to:
            self._tasks.spawn(self._links.dial(host, port), name=f"relay link to {host}:{port}")
        if settings.relay_listen is not None:
            server = await self._links.open_server(settings.relay_addr or None, settings.relay_listen)
            self.relay_port = server.sockets[0].getsockname()[1]
            self._tasks.spawn(self._links.serve(server), name="take relay links")

    def _make_ends(
        self, send: Callable[[Frame], None], tasks: TaskScope, name: str
    ) -> tuple[Exporter, Importer]:
        """Make the ends of a link; stop registering the master at its other side directly."""
        for remote in self._remotes.values():
            if remote.master.name == name:
                remote.leave()
        chosen = self.settings.lists.filter_for(name, never_nodes=(self._node.name,))
        namespace = self.settings.namespace_of(name)
        takes = self.settings.lists.takes_host(name)

        def rename(offered: str) -> str | None:
            return add_namespace(offered, namespace) if takes else None

        return (
            Exporter(self._node, self._master, chosen, send, tasks, foreign=self._registered_nodes),
            Importer(self._node, self._master, chosen, send, rename=rename),
        )

    def _registered_nodes(self) -> set[str]:
        return {entry.node for entries in self.registrar.held.values() for entry in entries}

    # The own master

    async def _watch_master(self) -> None:
        """Register everything again when another process has replaced the master."""
        known: Run | None = None
        while True:
            try:
                run = await ask_run(self._master)
                if known not in (None, run):
                    _log.warning("the master at %s was restarted", self._master_uri)
                    await self.registrar.restore()
                known = run
            except MasterError as error:
                _log.debug("%s", error)
            await asyncio.sleep(WATCH_MASTER)

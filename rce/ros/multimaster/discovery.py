"""A discovery: announces its master, finds others, and reports them to its graph and its program."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import time
from collections.abc import Awaitable, Callable, Iterator
from contextlib import AsyncExitStack, contextmanager
from types import TracebackType
from typing import Self

from rce.aio.tasks import TaskScope
from rce.ros.core import Core
from rce.ros.errors import MasterError
from rce.ros.multimaster import addresses, messages
from rce.ros.multimaster.announcements import Announcements
from rce.ros.multimaster.contacts import OriginsReader, ask_contact
from rce.ros.multimaster.errors import MalformedHeartbeatError, MultimasterError
from rce.ros.multimaster.events import EventQueue
from rce.ros.multimaster.heartbeat import Heartbeat, Kind, decode
from rce.ros.multimaster.monitor import MasterMonitor
from rce.ros.multimaster.peer_table import (
    Contact,
    Neighbour,
    PeerEvent,
    PeerKey,
    PeerTable,
    Step,
)
from rce.ros.multimaster.robot_hosts import RobotHosts
from rce.ros.multimaster.rpc import DiscoveryApi, PlainDispatcher
from rce.ros.multimaster.settings import DiscoverySettings, local_master
from rce.ros.multimaster.source import open_source
from rce.ros.multimaster.state import MasterInfo
from rce.ros.multimaster.udp import HeartbeatSocket
from rce.ros.node import Node
from rce.ros.node.master import MasterClient
from rce.ros.types.exceptions import TypesError
from rce.ros.xmlrpc import RpcClient, RpcServer

_log = logging.getLogger(__name__)

DEAD_AFTER_POLLS = 3
"""After so many requests without an answer, no heartbeats are sent until the master answers: others then have
it as offline after their time for silence. It does not leave, because its nodes may work on."""

FIRST_REQUESTS = 3
"""How often, at the start, all masters are asked for their state."""


class Discovery:
    """Announces a master and finds others. An async context manager, working inside its block.

    It waits for its master, as long as that takes, before it enters the block.
    """

    def __init__(self, settings: DiscoverySettings | None = None, *, core: Core | None = None) -> None:
        """Prepare a discovery.

        Args:
            settings: How it is set up.
            core: The master itself, if it runs in this process: it is then watched, not asked.
        """
        self.settings = settings = settings or DiscoverySettings()
        self._core = core
        self._master_uri = core.uri if core is not None else local_master(settings.master_uri)
        self._neighbours = PeerTable(settings.liveness)
        self._watches: set[EventQueue[PeerEvent]] = set()
        self._beat_now = asyncio.Event()
        self._robots = RobotHosts(settings.robot_addresses, self._beat_now.set)
        self._is_master_up = True
        self._is_listening = False
        """Whether heartbeats are handled; earlier and later ones are ignored, as they are repeated."""
        self._last_request = 0.0
        self._types = messages.registry()
        self._stack = AsyncExitStack()
        self._monitor: MasterMonitor
        self._node: Node
        self._announcements: Announcements
        self._rpc: RpcClient
        self._tasks: TaskScope
        self._socket: HeartbeatSocket
        self._own = PeerKey("", 0)
        self._contact: Contact

    # For programs

    @property
    def masters(self) -> list[Neighbour]:
        """The known masters, the own one among them."""
        return self._neighbours.masters

    @property
    def info(self) -> MasterInfo | None:
        """The registrations at the own master; None until it was asked."""
        return self._monitor.info

    @property
    def monitor_uri(self) -> str:
        """The URI of the RPC server."""
        return self._own.monitor_uri

    @contextmanager
    def watch(self) -> Iterator[EventQueue[PeerEvent]]:
        """Watch the masters come, change and go: ``with discovery.watch() as events: async for ...``."""
        events: EventQueue[PeerEvent] = EventQueue()
        self._watches.add(events)
        try:
            yield events
        finally:
            self._watches.discard(events)

    def refresh(self) -> None:
        """Ask all masters for their state."""
        request = Heartbeat(Kind.REQUEST, self._own.rpc_port, self.settings.heartbeat_hz).encode()
        self._socket.send(request, self._unicast_addresses())

    # Life

    async def __aenter__(self) -> Self:
        settings = self.settings
        group, interface = addresses.split_group(settings.mcast_group)
        address = await addresses.own_address(interface, group)
        async with AsyncExitStack() as stack:
            self._rpc = await stack.enter_async_context(RpcClient())
            self._node = await stack.enter_async_context(self._make_node())
            master = MasterClient(self._master_uri, self._node.name, self._node.uri, self._rpc)
            uri = addresses.public_uri(await master.call("getUri"), address)
            self._contact = Contact(uri, settings.name or addresses.master_name(uri), self._node.name)
            source = await stack.enter_async_context(open_source(master, self._core))
            self._monitor = MasterMonitor(
                uri,
                self._contact.master_name,
                source,
                lambda: addresses.local_hosts(address),
                OriginsReader(self._node, lambda: addresses.local_hosts(address)).read,
            )
            server = RpcServer(
                PlainDispatcher(self._api().methods()), settings.rpc_addr or None, settings.rpc_port_for(uri)
            )
            await stack.enter_async_context(server)
            self._own = PeerKey(address, server.port)
            self._socket = await stack.enter_async_context(self._open_socket(group, address))
            self._announcements = await Announcements.open(
                self._node,
                lambda: self.masters,
                self.refresh,
                name=self._contact.master_name,
                uri=uri,
            )
            stack.callback(self._say_goodbye)
            self._tasks = await stack.enter_async_context(TaskScope())
            self._tasks.spawn(self._watch_master(source.wait), name="watch the master")
            self._tasks.spawn(self._robots.follow(), name="look up robot hosts")
            self._tasks.spawn(self._send_heartbeats(), name="send heartbeats")
            self._tasks.spawn(self._pass_time(), name="look for silent masters")
            self._is_listening = True
            self._stack = stack.pop_all()
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._is_listening = False
        await self._stack.aclose()

    def _make_node(self) -> Node:
        return Node(
            self.settings.node_name,
            argv=[],
            master_uri=self._master_uri,
            types=self._types,
            master_timeout=None,
        )

    def _open_socket(self, group: str, address: str) -> HeartbeatSocket:
        settings = self.settings
        return HeartbeatSocket(
            self._received,
            group=group,
            port=settings.mcast_port,
            address=address,
            send_mcast=settings.send_mcast,
            listen_mcast=settings.listen_mcast,
        )

    def _api(self) -> DiscoveryApi:
        return DiscoveryApi(
            self._contact.master_uri,
            self._contact.master_name,
            self._contact.discoverer,
            lambda: self.monitor_uri,
            lambda: self._monitor.info,
            self._md5sum,
        )

    def _md5sum(self, kind: str) -> str | None:
        try:
            return self._types.message(kind).md5sum
        except TypesError:
            return None

    def _say_goodbye(self) -> None:
        """Tell the others and the own graph, last of all."""
        leaving = Heartbeat(Kind.LEAVING, self._own.rpc_port, self.settings.heartbeat_hz)
        self._socket.send(leaving.encode(), self._unicast_addresses())
        self._follow(self._neighbours.leave())

    # The own master

    async def _watch_master(self, wait: Callable[[float], Awaitable[None]]) -> None:
        failures = 0
        restarts = 0
        while True:
            try:
                changed = await self._monitor.poll(time.time())
                if failures >= DEAD_AFTER_POLLS or self._monitor.restarts != restarts:
                    await self._return_to_graph()
                    restarts = self._monitor.restarts
                failures = 0
            except MasterError as error:
                failures += 1
                changed = failures == DEAD_AFTER_POLLS
                if changed:
                    _log.warning("%s", error)
            self._is_master_up = failures < DEAD_AFTER_POLLS
            if changed:
                self._beat_now.set()
            await wait(1 / self.settings.rosmaster_hz)

    async def _return_to_graph(self) -> None:
        _log.info("the master at %s was restarted", self._master_uri)
        await self._node.reregister()
        await self._announcements.set_parameters(
            self._node, self._contact.master_name, self._contact.master_uri
        )

    # Heartbeats

    async def _send_heartbeats(self) -> None:
        requests = FIRST_REQUESTS
        while True:
            if requests > 0 and self._monitor.info is not None:
                requests -= 1
                self.refresh()
            self._socket.renew()
            self._announce()
            self._beat_now.clear()
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(1 / self.settings.heartbeat_hz):
                    await self._beat_now.wait()

    def _announce(self, only_to: tuple[str, int] | None = None) -> None:
        info = self._monitor.info
        if info is None or not self._is_master_up:
            return
        beat = Heartbeat(
            Kind.STATE, self._own.rpc_port, self.settings.heartbeat_hz, info.stamp, info.stamp_local
        )
        if only_to is not None:
            self._socket.send_to(beat.encode(), only_to)
            return
        self._socket.send(beat.encode(), self._unicast_addresses())
        self._follow(self._neighbours.received(self._own.host, beat, self._now()))

    def _received(self, datagram: bytes, sender: tuple[str, int], to_group: bool) -> None:
        try:
            beat = decode(datagram)
        except MalformedHeartbeatError as error:
            _log.debug("from %s: %s", sender, error)
            return
        host = sender[0]
        if not self._is_listening:
            return
        if beat.rpc_port == self._own.rpc_port and host in addresses.local_addresses():
            return  # the own one
        self._follow(self._neighbours.received(host, beat, self._now()))
        if beat.kind is Kind.REQUEST:
            self._answer(sender, to_group=to_group)

    def _answer(self, sender: tuple[str, int], *, to_group: bool) -> None:
        """Send the own state to the asking host, and to the group if that was asked or has several ends."""
        now = self._now()
        if (
            to_group or sender[0] == self._own.host
        ) and now - self._last_request >= 1 / self.settings.rosmaster_hz:
            self._last_request = now
            self._announce()
        self._announce(sender)

    async def _pass_time(self) -> None:
        while True:
            await asyncio.sleep(min(0.25, 1 / self.settings.heartbeat_hz))
            now = self._now()
            self._follow(self._neighbours.tick(now))
            self._announcements.tell_links(
                self._contact.master_name, self._neighbours.links(now), time.time()
            )

    def _unicast_addresses(self) -> list[tuple[str, int]]:
        """The hosts that heartbeats are sent to one by one: all known ones, if not to the group."""
        known = self._robots.addresses
        if not self.settings.send_mcast:
            named = {host for host, _ in known} | {self._own.host}
            known = known + [(host, self.settings.mcast_port) for host in self._neighbours.hosts - named]
        return known

    # Steps and events

    def _follow(self, step: Step) -> None:
        for event in step.events:
            _log.info("master %s (%s): %s", event.master.name, event.master.uri, event.change.value)
            self._announcements.tell(event)
            for watch in self._watches:
                watch.put(event)
        for key in step.ask_contact:
            if key == self._own:
                self._follow(self._neighbours.contacted(key, self._contact, self._now()))
            else:
                self._tasks.spawn(self._learn(key), name=f"ask {key.monitor_uri} for its name")
        request = Heartbeat(Kind.REQUEST, self._own.rpc_port, self.settings.heartbeat_hz).encode()
        for host in step.request_state:
            self._socket.send_to(request, (host, self.settings.mcast_port))

    async def _learn(self, key: PeerKey) -> None:
        try:
            contact = await ask_contact(self._rpc, key)
        except MultimasterError as error:
            _log.info("%s", error)
            return
        self._follow(self._neighbours.contacted(key, contact, self._now()))

    @staticmethod
    def _now() -> float:
        return asyncio.get_running_loop().time()

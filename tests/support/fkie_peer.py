"""A stand-in for fkie's master_discovery and master_sync, made of the facts of their wire alone.

Run by any Python, with the standard library only: ``fkie_peer.py MASTER_URI RPC_PORT MCAST_PORT ADDRESS``.
Sends heartbeats to 226.0.0.0, answers the RPC methods, registers at its master what others have, and prints a
line for each master that it finds or loses.
"""
# ruff: noqa: PT018, T201, UP031

from __future__ import annotations

import re
import select
import signal
import socket
import struct
import sys
import threading
import time
import xmlrpc.client
from collections.abc import Sequence
from typing import Any, NamedTuple
from xmlrpc.server import SimpleXMLRPCServer

Lists = Sequence[tuple[str, Sequence[str]]]
"""Names of topics or services, each with the nodes that have it."""
Address = tuple[str, int]
LAYOUT = "cBBiiHii"  # native alignment
GROUP = "226.0.0.0"
ME = "/master_discovery"
SYNC = "/master_sync"
FILTER = (
    False,
    r"\A/rosout\Z|\A/master_discovery\Z|\A/master_sync\Z|\A/node_manager\Z",
    "",
    r"\A/rosout\Z|\A/rosout_agg\Z|\A/master_discovery/.*\Z|\A/master_sync/.*\Z",
    "",
    r"\A/.*get_loggers\Z|\A/.*set_logger_level\Z|\A/master_discovery/.*\Z|\A/master_sync/.*\Z",
    "",
    r"\Abond/Status\Z|\Afkie_multimaster_msgs/SyncTopicInfo\Z",
    "",
    "",
    "",
)


class State(NamedTuple):
    publishers: Lists
    subscribers: Lists
    services: Lists
    types: Sequence[tuple[str, str]]
    uris: dict[str, str]
    service_uris: dict[str, str]


class Registration(NamedTuple):
    kind: str
    name: str
    detail: str
    node: str
    at: str


class Peer:
    socket: socket.socket

    def __init__(self, master_uri: str, rpc_port: int, mcast_port: int, address: str) -> None:
        self.master_uri = master_uri
        self.master: Any = xmlrpc.client.ServerProxy(master_uri)  # a call gives any value
        self.rpc_port = rpc_port
        self.mcast_port = mcast_port
        self.address = address
        self.stamp = 0.0
        self.state: State | None = None
        self.origins: dict[str, str] = {}
        self.others: dict[Address, tuple[int, int]] = {}
        self.held: dict[Address, set[Registration]] = {}
        self.lock = threading.Lock()

    # RPC

    def contacts(self) -> tuple[str, str, str, str, str]:
        uri = f"http://{self.address}:{self.rpc_port}"
        return ("%.9f" % self.stamp, self.master_uri, "fkie", ME, uri)

    def info(self, _filter: object = None) -> tuple[Any, ...]:
        """Answer ``masterInfo``."""
        with self.lock:
            assert self.state is not None
            publishers, subscribers, services, types, uris, service_uris = self.state
            nodes = [
                (
                    name,
                    uri,
                    self.origins.get(name, self.master_uri),
                    4711,
                    "remote" if name in self.origins else "local",
                )
                for name, uri in uris.items()
            ]
            providers = [(name, uri, self.master_uri, "", "local") for name, uri in service_uris.items()]
            stamp = "%.9f" % self.stamp
            return (
                stamp,
                stamp,
                self.master_uri,
                "fkie",
                publishers,
                subscribers,
                services,
                types,
                nodes,
                providers,
            )

    def serve(self) -> None:
        server = SimpleXMLRPCServer((self.address, self.rpc_port), logRequests=False, allow_none=True)
        server.register_introspection_functions()
        server.register_function(self.info, "masterInfo")
        server.register_function(self.info, "masterInfoFiltered")
        server.register_function(self.contacts, "masterContacts")
        server.register_function(lambda: (self.master_uri, time.time()), "getCurrentTime")
        threading.Thread(target=server.serve_forever, daemon=True).start()

    # The own master

    def poll(self) -> None:
        publishers, subscribers, services = self.master.getSystemState(ME)[2]
        types = self.master.getTopicTypes(ME)[2]
        names = {node for part in (publishers, subscribers, services) for _, nodes in part for node in nodes}
        uris = {name: self.master.lookupNode(ME, name)[2] for name in sorted(names)}
        service_uris = {name: self.master.lookupService(ME, name)[2] for name, _ in services}
        state = State(publishers, subscribers, services, types, uris, service_uris)
        if state != self.state:
            with self.lock:
                self.state = state
                self.stamp = time.time()

    # Heartbeats

    def open(self) -> None:
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM, socket.IPPROTO_UDP)
        self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEPORT, 1)
        self.socket.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_TTL, struct.pack("@i", 20))
        self.socket.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_LOOP, 1)
        interface = socket.inet_aton(self.address)
        self.socket.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, interface)
        self.socket.setsockopt(
            socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, socket.inet_aton(GROUP) + interface
        )
        self.socket.bind((GROUP, self.mcast_port))

    def beat(self, version: int = 2, secs: int | None = None, nsecs: int = 0) -> None:
        if secs is None:
            secs, nsecs = int(self.stamp), int((self.stamp - int(self.stamp)) * 1000000000)
        packet = struct.pack(LAYOUT, b"R", version, 50, secs, nsecs, self.rpc_port, secs, nsecs)
        assert len(packet) == 24
        self.socket.sendto(packet, (GROUP, self.mcast_port))

    def receive(self) -> None:
        packet, (host, _) = self.socket.recvfrom(1024)
        mark, version, rate, secs, nsecs, port, _, _ = struct.unpack(LAYOUT, packet)
        assert mark == b"R" and version in (2, 3), packet
        if port == self.rpc_port:
            return
        key = (host, port)
        if secs == -1:
            if key in self.others:
                self.lose(key)
        elif version == 3 and secs == 0 and nsecs == 0:
            self.beat()
        elif self.others.get(key) != (secs, nsecs):
            monitor: Any = xmlrpc.client.ServerProxy(f"http://{host}:{port}")
            try:
                stamp, uri, name, node, _ = monitor.masterContacts()
            except OSError:
                return  # it just left
            if float(stamp) == 0:
                return
            assert node.startswith("/") and re.match(r"http://.*:\d+/?$", uri), (node, uri)
            if key not in self.others:
                print("found", name, uri, rate / 10, flush=True)
            assert "masterInfoFiltered" in monitor.system.listMethods()
            self.sync(key, monitor.masterInfoFiltered(FILTER))
            self.others[key] = (secs, nsecs)

    # Synchronization

    def sync(self, key: Address, info: Sequence[Any]) -> None:
        _, _, uri, _, publishers, subscribers, services, typed, nodes, providers = info
        types = dict(typed)
        local = {
            name: at for name, at, origin, _, place in nodes if place == "local" and origin != self.master_uri
        }
        served = {name: at for name, at, origin, _, place in providers if place == "local"}
        wanted: set[Registration] = set()
        for topic, names in publishers:
            wanted |= {
                Registration("Publisher", topic, types[topic], name, local[name])
                for name in names
                if name in local
            }
        for topic, names in subscribers:
            wanted |= {
                Registration("Subscriber", topic, types.get(topic, "*"), name, local[name])
                for name in names
                if name in local
            }
        for service, names in services:
            wanted |= {
                Registration("Service", service, served[service], name, local[name])
                for name in names
                if name in local
            }
        held = self.held.setdefault(key, set())
        for entry in held - wanted:
            self.unregister(entry)
        for kind, name, detail, node, at in wanted - held:
            self.origins[node] = uri
            code, text, value = getattr(self.master, f"register{kind}")(node, name, detail, at)
            assert code == 1, text
            if kind == "Subscriber" and value:
                subscriber: Any = xmlrpc.client.ServerProxy(at)
                subscriber.publisherUpdate("/master", name, value)
        self.held[key] = wanted

    def unregister(self, entry: Registration) -> None:
        kind, name, detail, node, at = entry
        getattr(self.master, f"unregister{kind}")(node, name, detail if kind == "Service" else at)

    def lose(self, key: Address) -> None:
        print("lost", *key, flush=True)
        for entry in self.held.pop(key, ()):
            self.unregister(entry)
        del self.others[key]

    # Life

    def run(self) -> None:
        self.poll()
        self.open()
        self.serve()
        self.beat(version=3, secs=0, nsecs=0)
        next_beat = 0.0
        stopped: list[bool] = []
        signal.signal(signal.SIGTERM, lambda *_: stopped.append(True))
        while not stopped:
            if time.time() >= next_beat:
                next_beat = time.time() + 0.2
                self.poll()
                self.beat()
            if select.select([self.socket], [], [], 0.1)[0]:
                self.receive()
        self.beat(secs=-1, nsecs=-1)


if __name__ == "__main__":
    Peer(sys.argv[1], int(sys.argv[2]), int(sys.argv[3]), sys.argv[4]).run()

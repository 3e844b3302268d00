"""Where the machines of the mode ``multi`` are: in network namespaces, or on ports of loopback."""

from __future__ import annotations

import asyncio
import os
import secrets
import shutil
import subprocess
from collections.abc import Sequence
from dataclasses import dataclass
from ipaddress import IPv4Address, IPv4Network

import psutil

from rce.ros.multimaster.addresses import DEFAULT_MASTER_PORT, DEFAULT_PORT, RPC_PORT_OFFSET
from rce_fleet.demo.children import Children
from rce_fleet.demo.config import Machines
from rce_fleet.demo.exceptions import NetworkError
from rce_fleet.demo.ports import LOOPBACK, free_ports

HOST, WORLD, FIRST = 1, 2, 10
"""Numbers in the subnet: this machine, the world, the first of the others."""
HOLDER_TIMEOUT = 10.0
TOOLS = ("unshare", "nsenter", "ip")


@dataclass(frozen=True, slots=True)
class Site:
    """A machine of the fleet, with a ROS core.

    Attributes:
        name: Its name, which is its master's too.
        address: Its address.
        core_port: Port of its core.
        rpc_port: Port of its discovery.
        enter: Command before each program's own, which lets it run there.
    """

    name: str
    address: str
    core_port: int
    rpc_port: int
    enter: tuple[str, ...] = ()

    @property
    def core_uri(self) -> str:
        """The ROS master."""
        return f"http://{self.address}:{self.core_port}/"


@dataclass(frozen=True, slots=True)
class Network:
    """All machines.

    Attributes:
        sites: Those with a core, in the order in which they were asked for.
        multicast_port: Where their discoveries meet.
        enter_world: Command before the world's own.
    """

    sites: tuple[Site, ...]
    multicast_port: int = DEFAULT_PORT
    enter_world: tuple[str, ...] = ()


async def make_network(kind: Machines, names: Sequence[str], children: Children) -> Network:
    """Make machines. They last as long as the programs on them, however these end.

    Args:
        kind: What stands for machines.
        names: Their names.
        children: Get what keeps the network.

    Raises:
        NetworkError: There can be no such network.
    """
    if kind is Machines.AUTO:
        kind = Machines.NAMESPACES if await _may_make_namespaces() else Machines.PORTS
    if kind is Machines.NAMESPACES:
        return await _Namespaces(children).make(names)
    multicast_port, *ports = free_ports(1 + 2 * len(names))
    pairs = zip(ports[::2], ports[1::2], strict=True)
    sites = (Site(name, LOOPBACK, core, rpc) for name, (core, rpc) in zip(names, pairs, strict=True))
    return Network(tuple(sites), multicast_port)


class _Namespaces:
    """Network namespaces without names, held by programs, and cables between them and a switch.

    The kernel removes a namespace with its last process, and a cable with the namespace of one of its ends.
    """

    def __init__(self, children: Children) -> None:
        self._children = children
        self._subnet = _free_subnet()

    async def make(self, names: Sequence[str]) -> Network:
        switch = await self._hold("switch", needed=True)
        await _ip(["link add switch type bridge mcast_snooping 0", "link set switch up"], switch)
        cable = f"rce{secrets.token_hex(4)}"
        await _ip(
            [
                f"link add {cable} type veth peer name host netns {switch}",
                f"address add {self._address(HOST)}/{self._subnet.prefixlen} dev {cable}",
                f"link set {cable} up",
            ]
        )
        await _ip(["link set host master switch", "link set host up"], switch)
        world = await self._plug_in("world", WORLD, switch)
        sites = []
        for number, name in enumerate(names, start=FIRST):
            enter = await self._plug_in(name, number, switch)
            port = DEFAULT_MASTER_PORT
            sites.append(Site(name, str(self._address(number)), port, port + RPC_PORT_OFFSET, enter))
        return Network(tuple(sites), enter_world=world)

    def _address(self, number: int) -> IPv4Address:
        return self._subnet[number]

    async def _plug_in(self, name: str, number: int, switch: int) -> tuple[str, ...]:
        """Make a machine that is cabled to the switch; returns how to run something on it."""
        holder = await self._hold(name)
        await _ip(
            [
                "link set lo up",
                f"link add eth0 type veth peer name port{number} netns {switch}",
                f"address add {self._address(number)}/{self._subnet.prefixlen} dev eth0",
                "link set eth0 up",
            ],
            holder,
        )
        await _ip([f"link set port{number} master switch", f"link set port{number} up"], switch)
        return _entering(holder)

    async def _hold(self, name: str, *, needed: bool = False) -> int:
        """Make a namespace; returns the id of the process that holds it."""
        argv = ["unshare", "--net", "sh", "-c", "echo made; exec sleep infinity"]
        holder = await self._children.start(f"network-{name}", argv, needed=needed)
        await self._children.wait_line(holder, "made", HOLDER_TIMEOUT)
        return holder.child.pid


async def _may_make_namespaces() -> bool:
    if os.geteuid() != 0 or not all(map(shutil.which, TOOLS)):
        return False
    cable = f"rce{secrets.token_hex(4)}"
    try:
        await _ip([f"link add {cable} type veth peer name {cable}p", f"link delete {cable}"])
        await _run("unshare", "--net", "true")
    except NetworkError:
        return False
    return True


async def _ip(commands: Sequence[str], holder: int | None = None) -> None:
    """Give commands to ``ip`` in a namespace, or here."""
    enter = () if holder is None else _entering(holder)
    await _run(*enter, "ip", "-batch", "-", given="".join(f"{command}\n" for command in commands))


async def _run(*argv: str, given: str = "") -> None:
    # Not by asyncio: under uvloop, what is given to a program that has ended already is a RuntimeError.
    def run() -> subprocess.CompletedProcess[str]:
        return subprocess.run(  # noqa: S603 - its words are this module's own
            argv, input=given, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, check=False
        )

    try:
        ended = await asyncio.to_thread(run)
    except OSError as error:
        raise NetworkError(f"{argv[0]}: {error.strerror}") from error
    if ended.returncode != 0:
        raise NetworkError(ended.stdout.strip())


def _entering(holder: int) -> tuple[str, ...]:
    return ("nsenter", f"--net=/proc/{holder}/ns/net", "--")


def _free_subnet() -> IPv4Network:
    """A subnet of which this machine has no address."""
    own = {entry.address for entries in psutil.net_if_addrs().values() for entry in entries}
    while True:
        subnet = IPv4Network((f"10.{secrets.randbelow(256)}.{secrets.randbelow(256)}.0", 24))
        if not any(address.startswith(f"{str(subnet)[:-4]}") for address in own):
            return subnet

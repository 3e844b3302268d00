"""The machines of the mode ``multi``: network namespaces, or ports of the loopback interface."""

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
from rce_fleet.demo.config import MachineBackend
from rce_fleet.demo.exceptions import NetworkError
from rce_fleet.demo.programs import ProgramGroup
from rce_fleet.demo.resources import LOOPBACK, free_ports

HOST, WORLD, FIRST = 1, 2, 10
"""Host numbers in the subnet: this machine, the world, the first of the others."""
START_TIMEOUT_S = 10.0
TOOLS = ("unshare", "nsenter", "ip")


@dataclass(frozen=True, slots=True)
class DemoMachine:
    """A machine of the fleet, with a ROS core.

    Attributes:
        name: Name of the machine and of its ROS master.
        address: Its IP address.
        core_port: Port of its core.
        rpc_port: Port of its discovery.
        prefix: Words before each program's command that run it on this machine.
    """

    name: str
    address: str
    core_port: int
    rpc_port: int
    prefix: tuple[str, ...] = ()

    @property
    def core_uri(self) -> str:
        """URI of the ROS master."""
        return f"http://{self.address}:{self.core_port}/"


@dataclass(frozen=True, slots=True)
class Network:
    """All machines.

    Attributes:
        machines: Machines with a core, in the order of the given names.
        multicast_port: Port on which their discoveries find each other.
        world_prefix: Words before the world's command that run it in the network.
    """

    machines: tuple[DemoMachine, ...]
    multicast_port: int = DEFAULT_PORT
    world_prefix: tuple[str, ...] = ()


async def create_network(backend: MachineBackend, names: Sequence[str], group: ProgramGroup) -> Network:
    """Create machines. The kernel removes them with the last program that runs on them.

    Args:
        backend: What stands for a machine.
        names: Names of the machines.
        group: Gets the programs that keep the network namespaces.

    Raises:
        NetworkError: The network cannot be created.
    """
    if backend is MachineBackend.AUTO:
        backend = MachineBackend.NAMESPACES if await _can_create_namespaces() else MachineBackend.PORTS
    if backend is MachineBackend.NAMESPACES:
        return await _NamespaceNetwork(group).create(names)
    multicast_port, *ports = free_ports(1 + 2 * len(names))
    pairs = zip(ports[::2], ports[1::2], strict=True)
    machines = (
        DemoMachine(name, LOOPBACK, core, rpc) for name, (core, rpc) in zip(names, pairs, strict=True)
    )
    return Network(tuple(machines), multicast_port)


class _NamespaceNetwork:
    """Unnamed network namespaces, kept by programs, with a veth pair from each to a bridge.

    The kernel removes a namespace with its last process, and a veth pair with the namespace of one end.
    """

    def __init__(self, group: ProgramGroup) -> None:
        self._group = group
        self._subnet = _free_subnet()

    async def create(self, names: Sequence[str]) -> Network:
        switch = await self._create_namespace("switch", stop_last=True)
        await _ip(["link add switch type bridge mcast_snooping 0", "link set switch up"], switch)
        veth = f"rce{secrets.token_hex(4)}"
        await _ip(
            [
                f"link add {veth} type veth peer name host netns {switch}",
                f"address add {self._address(HOST)}/{self._subnet.prefixlen} dev {veth}",
                f"link set {veth} up",
            ]
        )
        await _ip(["link set host master switch", "link set host up"], switch)
        world = await self._add_machine("world", WORLD, switch)
        machines = []
        for number, name in enumerate(names, start=FIRST):
            prefix = await self._add_machine(name, number, switch)
            port = DEFAULT_MASTER_PORT
            machines.append(
                DemoMachine(name, str(self._address(number)), port, port + RPC_PORT_OFFSET, prefix)
            )
        return Network(tuple(machines), world_prefix=world)

    def _address(self, number: int) -> IPv4Address:
        return self._subnet[number]

    async def _add_machine(self, name: str, number: int, switch: int) -> tuple[str, ...]:
        """Create a machine that is connected to the bridge; return the prefix that runs a command on it."""
        holder = await self._create_namespace(name)
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
        return _command_prefix(holder)

    async def _create_namespace(self, name: str, *, stop_last: bool = False) -> int:
        """Create a namespace; return the id of the process that keeps it."""
        argv = ["unshare", "--net", "sh", "-c", "echo made; exec sleep infinity"]
        holder = await self._group.start(f"network-{name}", argv, stop_last=stop_last)
        await self._group.wait_line(holder, "made", START_TIMEOUT_S)
        return holder.child.pid


async def _can_create_namespaces() -> bool:
    if os.geteuid() != 0 or not all(map(shutil.which, TOOLS)):
        return False
    veth = f"rce{secrets.token_hex(4)}"
    try:
        await _ip([f"link add {veth} type veth peer name {veth}p", f"link delete {veth}"])
        await _run("unshare", "--net", "true")
    except NetworkError:
        return False
    return True


async def _ip(commands: Sequence[str], holder: int | None = None) -> None:
    """Run commands of ``ip`` in a namespace, or in this one."""
    prefix = () if holder is None else _command_prefix(holder)
    await _run(*prefix, "ip", "-batch", "-", given="".join(f"{command}\n" for command in commands))


async def _run(*argv: str, given: str = "") -> None:
    # Not by asyncio: under uvloop, input to a program that has ended already raises RuntimeError.
    def run() -> subprocess.CompletedProcess[str]:
        return subprocess.run(  # noqa: S603 - the command is made in this module
            argv, input=given, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, check=False
        )

    try:
        ended = await asyncio.to_thread(run)
    except OSError as error:
        raise NetworkError(f"{argv[0]}: {error.strerror}") from error
    if ended.returncode != 0:
        raise NetworkError(ended.stdout.strip())


def _command_prefix(holder: int) -> tuple[str, ...]:
    return ("nsenter", f"--net=/proc/{holder}/ns/net", "--")


def _free_subnet() -> IPv4Network:
    """Return a subnet in which this machine has no address."""
    own = {entry.address for entries in psutil.net_if_addrs().values() for entry in entries}
    while True:
        subnet = IPv4Network((f"10.{secrets.randbelow(256)}.{secrets.randbelow(256)}.0", 24))
        if not any(address.startswith(f"{str(subnet)[:-4]}") for address in own):
            return subnet

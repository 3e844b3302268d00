"""The groups of containers on this machine and their switches."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import os
from collections.abc import Iterable
from dataclasses import dataclass, field
from ipaddress import IPv4Interface
from pathlib import Path
from typing import NamedTuple

from rce.model import EndpointId
from rce_container.exceptions import NetworkError
from rce_container.folder import Record
from rce_container.network.addresses import choose, hosts_text
from rce_container.network.namespaces import configure, make_namespace, open_namespace
from rce_container.packages.disk import in_thread

_log = logging.getLogger(__name__)

INTERFACE = "eth0"
"""A member's interface to its group, as seen from inside."""
_BRIDGE = "bridge"
_MULTICAST = "224.0.0.0/4"
_NAMESPACE_LINK = "net:["


class Membership(NamedTuple):
    """A container's place in its group."""

    address: IPv4Interface
    switch: int
    """Descriptor of the switch's namespace.

    A process that lives as long as the container must open it too.
    """

    @property
    def path(self) -> str:
        """The switch's namespace as a file, for other processes."""
        return f"/proc/{os.getpid()}/fd/{self.switch}"


@dataclass(slots=True)
class _Member:
    tag: str
    address: IPv4Interface
    hosts: Path
    """The container's ``/etc/hosts``."""
    plugged: bool


@dataclass(slots=True)
class _Group:
    """The containers of one group, by id; never empty. Changing the switch requires the lock."""

    switch: int
    has_bridge: bool
    members: dict[str, _Member] = field(default_factory=dict)
    lock: asyncio.Lock = field(default_factory=asyncio.Lock)


class Networks:
    """All groups of one container task set. Containers of two task sets, or two users, never meet.

    A container is *enrolled* before it is started, *attached* when its namespaces exist and *detached* when
    its processes have ended.
    """

    def __init__(self) -> None:
        self._groups: dict[tuple[str, str], _Group] = {}
        self._of: dict[str, tuple[str, str]] = {}
        """The group of each container, by id."""

    def probe(self) -> None:
        """Find out whether groups work on this machine. Blocks.

        Raises:
            NetworkError: They do not work; the text says why.
        """
        with contextlib.ExitStack() as stack:
            switch, inside = make_namespace(), make_namespace()
            stack.callback(os.close, switch)
            stack.callback(os.close, inside)
            _make_bridge(switch)
            _plug_in(switch, inside, "probe", IPv4Interface("10.77.0.1/24"))

    def enroll(
        self, container: EndpointId, group: str, group_ip: str, incarnation_id: str, hosts: Path
    ) -> Membership:
        """Give a container that is to be started its place in its group.

        Args:
            container: Who it is.
            group: Its group.
            group_ip: Its requested address there; empty for any.
            incarnation_id: The id of its incarnation.
            hosts: Its ``/etc/hosts``, which is kept up to date from now on.

        Raises:
            NetworkError: The place cannot be given.
        """
        key = container.user, group
        if not group:
            raise NetworkError("the network 'group' needs the name of a group")
        found = self._groups.get(key)
        taken = {one.address: one.tag for one in found.members.values()} if found else {}
        address = choose(group_ip, taken)
        if found is None:
            found = self._groups[key] = _Group(make_namespace(), has_bridge=False)
        found.members[incarnation_id] = _Member(container.tag, address, hosts, plugged=False)
        self._of[incarnation_id] = key
        return Membership(address, found.switch)

    def adopt(self, container: EndpointId, record: Record, hosts: Path) -> None:
        """Take over a member that an earlier manager attached.

        Args:
            container: Who it is.
            record: That manager's record of it.
            hosts: Its ``/etc/hosts``.

        Raises:
            NetworkError: Its outermost process does not hold the group's switch any more.
        """
        key = container.user, record.group
        found = self._groups.get(key)
        if found is None:
            found = self._groups[key] = _Group(_held_by(record.pid), has_bridge=True)
        address = IPv4Interface(record.address)
        found.members[record.incarnation_id] = _Member(container.tag, address, hosts, plugged=True)
        self._of[record.incarnation_id] = key

    async def attach(self, incarnation_id: str, pid: int) -> None:
        """Connect an enrolled container to its switch, and add it to all members' ``/etc/hosts``.

        If it is cancelled, what was begun with the switch is done before it ends.

        Args:
            incarnation_id: The incarnation of the container.
            pid: A process in its network namespace.

        Raises:
            NetworkError: The container cannot be connected.
        """
        key = self._of.get(incarnation_id)
        if key is None:
            return
        group = self._groups[key]
        member = group.members[incarnation_id]
        async with group.lock:
            inside = open_namespace(pid)
            try:
                await in_thread(_connect, group, inside, _port(incarnation_id), member)
            finally:
                os.close(inside)
            await asyncio.to_thread(_write_hosts, list(group.members.values()))

    async def detach(self, incarnation_id: str) -> None:
        """Remove a container whose processes have ended from its group, if it has one."""
        key = self._of.pop(incarnation_id, None)
        if key is None:
            return
        group = self._groups[key]
        async with group.lock:
            member = group.members[incarnation_id]
            if member.plugged and len(group.members) > 1:
                try:
                    await asyncio.to_thread(configure, group.switch, [f"link delete {_port(incarnation_id)}"])
                except NetworkError as error:
                    _log.debug("the kernel has removed the port of %s already: %s", incarnation_id, error)
            del group.members[incarnation_id]
            if group.members:
                await asyncio.to_thread(_write_hosts, list(group.members.values()))
        if not group.members and self._groups.get(key) is group:
            del self._groups[key]
            os.close(group.switch)

    def close(self) -> None:
        """Close all switches; those of running containers stay."""
        for group in self._groups.values():
            os.close(group.switch)
        self._groups.clear()
        self._of.clear()


def _port(incarnation_id: str) -> str:
    """Return the switch's interface for a container; at most 15 characters."""
    return f"v{incarnation_id}"


def _connect(group: _Group, inside: int, port: str, member: _Member) -> None:
    """Connect a member; make the switch first if there is none. Notes each step that is done."""
    if not group.has_bridge:
        _make_bridge(group.switch)
        group.has_bridge = True
    _plug_in(group.switch, inside, port, member.address)
    member.plugged = True


def _make_bridge(switch: int) -> None:
    configure(switch, [f"link add name {_BRIDGE} type bridge mcast_snooping 0"])


def _plug_in(switch: int, inside: int, port: str, address: IPv4Interface) -> None:
    """Make the veth pair between a container and its switch."""
    cable = f"link add name {INTERFACE} type veth peer name {port} netns /proc/self/fd/{switch}"
    configure(
        inside,
        [
            "link set lo up",
            cable,
            f"address add {address} broadcast + dev {INTERFACE}",
            f"link set {INTERFACE} up",
            f"route add {_MULTICAST} dev {INTERFACE}",
        ],
        others=[switch],
    )
    configure(switch, [f"link set {_BRIDGE} up", f"link set {port} master {_BRIDGE} up"])


def _held_by(pid: int) -> int:
    """Return a copy of the switch's descriptor that a process holds."""
    folder = Path(f"/proc/{pid}/fd")
    try:
        for entry in folder.iterdir():
            if str(entry.readlink()).startswith(_NAMESPACE_LINK):
                return os.open(entry, os.O_RDONLY | os.O_CLOEXEC)
    except OSError as error:
        raise NetworkError(f"the group's switch cannot be found again: {error}") from error
    raise NetworkError("the group's switch is gone")


def _write_hosts(members: Iterable[_Member]) -> None:
    """Rewrite the members' files in place: containers may see the file itself, not its folder."""
    rows = [(member.tag, str(member.address.ip)) for member in members]
    for member in members:
        text = hosts_text(member.tag, rows)
        try:
            with member.hosts.open("r+") as file:
                file.write(text)
                file.truncate()
        except OSError as error:
            _log.debug("%s is gone: %s", member.hosts, error)

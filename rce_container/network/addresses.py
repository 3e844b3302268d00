"""Chooses the address of a container in its group, and writes its file ``/etc/hosts``. Pure."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from ipaddress import AddressValueError, IPv4Interface, IPv4Network, NetmaskValueError

from rce_container.exceptions import NetworkError

MAX_HOSTNAME = 63

DEFAULT_NETWORK = IPv4Network("10.77.0.0/24")
"""The network of groups whose containers name no addresses. All groups may use it: they are separate."""
_DEFAULT_PREFIX = 24
_LONGEST_PREFIX = 30
_SHORTEST_PREFIX = 8


def parse_address(text: str) -> IPv4Interface:
    """Read a ``groupIp``: an IPv4 address, with ``/24`` understood if it names no prefix.

    Raises:
        NetworkError: It is not an address that a container can have.
    """
    whole = text if "/" in text else f"{text}/{_DEFAULT_PREFIX}"
    try:
        address = IPv4Interface(whole)
    except (AddressValueError, NetmaskValueError, ValueError) as error:
        raise NetworkError(f"the groupIp {text!r} is not an IPv4 address, such as 10.0.0.2/16") from error
    network = address.network
    if not _SHORTEST_PREFIX <= network.prefixlen <= _LONGEST_PREFIX:
        raise NetworkError(
            f"the groupIp {text!r} needs a prefix from /{_SHORTEST_PREFIX} to /{_LONGEST_PREFIX}"
        )
    if address.ip in (network.network_address, network.broadcast_address):
        raise NetworkError(f"the groupIp {text!r} is the network's own or broadcast address; take another")
    if address.is_loopback or address.is_multicast or address.is_reserved or address.ip in _THIS_NETWORK:
        raise NetworkError(f"the groupIp {text!r} is not one for hosts; take one such as 10.0.0.2")
    return address


def choose(requested: str, taken: Mapping[IPv4Interface, str]) -> IPv4Interface:
    """Find the address of a new member of a group.

    Args:
        requested: Its ``groupIp``; if empty, a free one is found.
        taken: The group's addresses, and the container of each.

    Raises:
        NetworkError: The request cannot be granted; the text says what to do.
    """
    network = next((address.network for address in taken), None)
    if not requested:
        return _free(network or DEFAULT_NETWORK, taken)
    address = parse_address(requested)
    if network is not None and address.network != network:
        raise NetworkError(
            f"the groupIp {requested} is in {address.network}, but the group's other containers are in "
            f"{network}: give all of them addresses of one network, or none"
        )
    if address in taken:
        raise NetworkError(
            f"the groupIp {requested} belongs to container {taken[address]} of the same group; take another"
        )
    return address


_THIS_NETWORK = IPv4Network("0.0.0.0/8")


def _free(network: IPv4Network, taken: Mapping[IPv4Interface, str]) -> IPv4Interface:
    for host in network.hosts():
        address = IPv4Interface((host, network.prefixlen))
        if address not in taken:
            return address
    raise NetworkError(f"the group has no free address left in {network}; give its containers groupIps")


def hostname(tag: str) -> str:
    """Return the host name of the container with this tag."""
    return tag[:MAX_HOSTNAME]


def hosts_text(tag: str, members: Iterable[tuple[str, str]] = ()) -> str:
    """Return the contents of a container's ``/etc/hosts``.

    Args:
        tag: The container's.
        members: Tag and address of each container of its group, itself included; empty without a group.
    """
    lines = [f"{address} {hostname(name)}" for name, address in sorted(members)]
    own = "" if lines else f" {hostname(tag)}"
    return "\n".join([f"127.0.0.1 localhost{own}", *lines, ""])

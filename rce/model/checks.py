"""Checks of a request beyond the form of its fields. Pure."""

from __future__ import annotations

import ipaddress
import math
import re
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from rce.model.specs import ParameterValue

# A folder of the machine, or an image's name as in registries: no spaces, no option of a command line.
_IMAGE = re.compile(r"(/[^\x00-\x1f]*|[A-Za-z0-9][A-Za-z0-9._:/@+-]*)")
_MAX_IMAGE = 255

DEFAULT_PREFIX = 24
"""Prefix of a group's address without one."""
_SHORTEST_PREFIX, _LONGEST_PREFIX = 8, 30
_INT32 = 2**31


def read_image(text: str) -> str:
    """Check the name of a container's root file system; empty for none.

    Raises:
        ValueError: It is neither an image's name nor a path.
    """
    if text and (len(text) > _MAX_IMAGE or not _IMAGE.fullmatch(text)):
        raise ValueError("must be an image's name such as debian:12, or the path of a folder")
    return text


def read_group_address(text: str) -> str:
    """Check a container's address in the network of its group; empty for a free one.

    Raises:
        ValueError: It is not the IPv4 address of a host.
    """
    problem = _address_problem(text) if text else ""
    if problem:
        raise ValueError(f"{problem}, not {text!r:.60}")
    return text


def read_parameter_value(value: ParameterValue) -> ParameterValue:
    """Check that a parameter server can keep a value, and that JSON can carry it to one.

    Raises:
        ValueError: A number is not finite, or has more than 32 bits.
    """
    for item in value if isinstance(value, list) else [value]:
        if isinstance(item, int) and not -_INT32 <= item < _INT32:
            raise ValueError(f"must fit into 32 bits, the size of ROS's integers, not {_shown(item)}")
        if isinstance(item, float) and not math.isfinite(item):
            raise ValueError(f"must be a finite number, not {item}")
    return value


def find_circle(start: str, after: Mapping[str, Sequence[str]]) -> list[str]:
    """Find a cycle on which a node comes after itself.

    Args:
        start: The node's tag.
        after: The tags of the nodes that each node comes after.

    Returns:
        The tags on the cycle, ``start`` first and last; empty without a cycle.
    """
    way = [start]
    following = [reversed(after.get(start, ()))]  # what is left to follow from each tag of the way
    seen: set[str] = set()
    while way:
        tag = next(following[-1], None)
        if tag is None:
            way.pop()
            following.pop()
        elif tag == start:
            return [*way, tag]
        elif tag in after and tag not in seen:
            seen.add(tag)
            way.append(tag)
            following.append(reversed(after[tag]))
    return []


def _shown(number: int) -> str:
    """Write an integer, or its size: Python does not convert thousands of digits to text."""
    return str(number) if number.bit_length() <= 128 else f"one of {number.bit_length()} bits"  # noqa: PLR2004


def _address_problem(text: str) -> str:
    try:
        address = ipaddress.IPv4Interface(text if "/" in text else f"{text}/{DEFAULT_PREFIX}")
    except ValueError:
        return "must be an IPv4 address such as 10.0.0.2 or 10.0.0.2/24"
    network = address.network
    if not _SHORTEST_PREFIX <= network.prefixlen <= _LONGEST_PREFIX:
        return f"must have a prefix from /{_SHORTEST_PREFIX} to /{_LONGEST_PREFIX}"
    if address.ip in (network.network_address, network.broadcast_address):
        return f"must be an address of a host in {network}"
    return ""

"""Settings of a node from outside: environment variables and command line."""

from __future__ import annotations

import dataclasses
import ipaddress
import os
import socket
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from rce.lookups import LOOKUPS
from rce.ros.logfiles import log_folder
from rce.ros.names import Resolver, parse_arguments

DEFAULT_MASTER_URI = "http://127.0.0.1:11311/"
LOOPBACK = "127.0.0.1"
MAX_QUEUED_BYTES = 64 * 2**20
"""Most bytes that one queue of messages holds, unless a single message is longer."""
MAX_QUEUED_ITEMS = 2**20
"""Most messages in a queue for which no number is given."""
_DISCARD = 9
"""The port of the discard service (RFC 863)."""
SHOW_WARNINGS = "RCE_SHOW_WARNINGS"
"""Environment variable: ``yes`` has a node print its warnings and errors to standard error, ``no`` not."""
EVERYWHERE = "0.0.0.0"  # noqa: S104 - nodes of other machines must reach it


@dataclass(frozen=True, slots=True)
class NodeSettings:
    """Settings of one node."""

    resolver: Resolver
    master_uri: str
    host: str
    """Name or address under which others reach the node; if empty, the address that faces the master."""
    parameters: Mapping[str, Any]
    """Private parameters to set: name without ``~`` to value."""
    log_file: Path | None = None
    """Where to write the node's log, if it is set."""
    shows_warnings: bool = False
    """Whether warnings and errors go to standard error too, unless the program has set up its logging."""

    @classmethod
    def gather(
        cls,
        name: str,
        *,
        namespace: str,
        argv: Sequence[str],
        environ: Mapping[str, str],
        master_uri: str | None = None,
        anonymous: bool = False,
    ) -> NodeSettings:
        """Combine the program's settings with its environment and its command line; the command line wins.

        Args:
            name: The node's name without namespace.
            namespace: Its namespace; if empty, ``ROS_NAMESPACE``.
            argv: The command line, remappings among it.
            environ: ``ROS_MASTER_URI``, ``ROS_NAMESPACE``, ``ROS_IP``, ``ROS_HOSTNAME``
                where logs go (``ROS_LOG_DIR``, ``ROS_HOME``, ``HOME``) and ``RCE_SHOW_WARNINGS``
                are read. Without the latter, warnings are shown on a terminal.
            master_uri: The master, in place of ``ROS_MASTER_URI``.
            anonymous: Make the name unique.

        Raises:
            InvalidNameError: A name or remapping is not legal.
        """
        arguments = parse_arguments(argv)
        specials = arguments.specials
        if anonymous:
            name = anonymous_name(name)
        resolver = Resolver(
            specials.get("__name", name),
            specials.get("__ns") or namespace or environ.get("ROS_NAMESPACE", ""),
            arguments.remappings,
        )
        master = specials.get("__master") or master_uri or environ.get("ROS_MASTER_URI") or DEFAULT_MASTER_URI
        host = (
            specials.get("__hostname")
            or specials.get("__ip")
            or environ.get("ROS_HOSTNAME")
            or environ.get("ROS_IP", "")
        )
        parameters = {key: parse_value(text) for key, text in arguments.parameters.items()}
        log = specials.get("__log")
        log_file = log_folder(environ) / log if log else None  # an absolute path is taken as it is
        shown = environ.get(SHOW_WARNINGS)
        shows_warnings = sys.stderr is not None and sys.stderr.isatty() if shown is None else shown == "yes"
        return cls(resolver, master, host, parameters, log_file, shows_warnings)

    @property
    def bind(self) -> str:
        """The address to listen on."""
        return LOOPBACK if is_loopback(self.host) else EVERYWHERE

    async def placed(self) -> NodeSettings:
        """Return these settings with a host. The master's name may be looked up for it."""
        return self if self.host else dataclasses.replace(self, host=await address_towards(self.master_uri))


def queue_items(queue_size: int) -> int:
    """Return how many messages a queue holds: as given; for 0, as many as its bytes allow.

    Raises:
        ValueError: It is negative.
    """
    if queue_size < 0:
        raise ValueError(
            f"queue_size is {queue_size}, must be 0 (as many as {MAX_QUEUED_BYTES} bytes) or more"
        )
    return queue_size or MAX_QUEUED_ITEMS


def anonymous_name(name: str) -> str:
    """Make a name that no other node has: with the host's name, the process's id and the time in it."""
    host = "".join(character if character.isalnum() else "_" for character in socket.gethostname())
    return f"{name}_{host}_{os.getpid()}_{time.time_ns() // 1000}"


def is_loopback(host: str) -> bool:
    """Return whether only programs of this machine can reach ``host``."""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


async def address_towards(uri: str) -> str:
    """Return the address of this machine that faces the server at ``uri``.

    If the master is on loopback, the whole graph is assumed to be on this machine, and the address is
    loopback. If nodes of other machines join by another address, set ``ROS_IP``, as ROS advises.
    No packet is sent.
    """
    host = urlsplit(uri).hostname or LOOPBACK
    if is_loopback(host):
        return LOOPBACK
    try:
        infos = await LOOKUPS.addresses(host, _DISCARD, family=socket.AF_INET, kind=socket.SOCK_DGRAM)
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            probe.connect(infos[0][4])
            return str(probe.getsockname()[0])
    except (OSError, UnicodeError):
        return socket.gethostname()


def parse_value(text: str) -> Any:
    """Read a parameter's value as YAML, as ``_name:=value`` gives it; what is not YAML is a string."""
    import yaml

    try:
        value = yaml.safe_load(text)
    except yaml.YAMLError:
        return text
    return "" if value is None else value

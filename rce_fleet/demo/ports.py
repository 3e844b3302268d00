"""Which TCP ports a demo uses."""

from __future__ import annotations

import contextlib
import random
import socket
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, fields, replace

from rce_fleet.demo.exceptions import PortTakenError

LOOPBACK = "127.0.0.1"
QUIET = range(12000, 32000)
"""Below what systems hand out to those who ask for any port."""
ATTEMPTS = 100


@dataclass(frozen=True, slots=True)
class Ports:
    """The ports of engine, core and page; 0 stands for a free one that is still to be chosen."""

    page: int = 9080
    """The operator's page and the API for an ERP."""
    http: int = 9000
    """Clients and REST of the master."""
    control: int = 8080
    """Task sets."""
    ws: int = 9010
    """The robots' WebSockets."""
    robot_link: int = 10030
    """Links to robot endpoints."""
    container_link: int = 10031
    """Links to containers."""
    core: int = 11311
    """The ROS core of the mode ``single``."""

    def chosen(self, names: Iterable[str] = ()) -> Ports:
        """The same with every 0 replaced by a free port.

        Args:
            names: Those that are needed; the others stay as they are, and may be in use. None: all.

        Raises:
            PortTakenError: A port that was asked for is in use.
        """
        names = tuple(names) or [field.name for field in fields(self)]
        # All are held at once, so that none is found twice.
        with contextlib.ExitStack() as held:
            found = {name: held.enter_context(_hold(getattr(self, name), option_of(name))) for name in names}
        return replace(self, **found)


ANY = Ports(page=0, http=0, control=0, ws=0, robot_link=0, container_link=0, core=0)
"""Free ports, so that several demos can run side by side."""


def free_ports(count: int) -> list[int]:
    """Choose free ports for which there are no options."""
    with contextlib.ExitStack() as held:
        return [held.enter_context(_hold(0, "")) for _ in range(count)]


def option_of(name: str) -> str:
    """The option of ``rce demo`` that sets a port."""
    return "--port" if name == "page" else f"--{name.replace('_', '-')}-port"


@contextlib.contextmanager
def _hold(port: int, option: str) -> Iterator[int]:
    with _listen(port, option) if port else _listen_anywhere(option) as server:
        yield int(server.getsockname()[1])


def _listen(port: int, option: str) -> socket.socket:
    try:
        return socket.create_server((LOOPBACK, port))
    except OSError as error:
        raise PortTakenError(port, option) from error


def _listen_anywhere(option: str) -> socket.socket:
    """Listen on a port that the system gives to nobody by itself.

    It is let go and taken again later by the program that it is for; one of those that the system hands out
    might be somebody's in between.
    """
    for port in random.SystemRandom().sample(QUIET, ATTEMPTS):
        with contextlib.suppress(PortTakenError):
            return _listen(port, option)
    raise PortTakenError(QUIET.start, option)

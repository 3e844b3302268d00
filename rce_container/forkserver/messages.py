"""The messages between the manager and the fork server: JSON packets with descriptors.

The first packet holds the filter of system calls; each one after it is a :class:`SpawnRequest`.
"""

from __future__ import annotations

from typing import NamedTuple

import msgspec
from msgspec import Struct

from rce_container.environment.messages import Boot

MAX_PACKET = 1 << 18
"""Bytes."""


class VolumeOrder(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """A volume of the container."""

    path: str
    """Where it is in the container; the folder exists."""
    image: str = ""
    """The machine's file that is mounted there; empty: what is there already."""


class SpawnRequest(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """An environment to be made. Comes with the descriptors of :class:`Descriptors`."""

    boot: Boot
    environ: dict[str, str]
    """All of its environment variables."""
    uid: int
    """User and group of the machine that it runs as; 0: the fork server's own."""
    home_bytes: int
    """Size of the container's home."""
    tmp_bytes: int
    """Size of its ``/tmp``, and of its shared memory."""
    host_network: bool = False
    join: tuple[str, ...] = ()
    """See :attr:`rce_container.runtimes.base.Order.join`."""
    volumes: tuple[VolumeOrder, ...] = ()
    check: tuple[str, ...] = ()
    """A command that must succeed in the container before the answer reports success."""


class Descriptors(NamedTuple):
    """The descriptors that come with a request, in this order."""

    holder: int
    """A pidfd of the process that holds the namespaces."""
    answer: int
    """A socket on which the environment sends its :class:`Answer`; identifies the sender."""
    lifeline: int
    """The holder's other end: the container lives as long as the environment keeps it open."""
    control: int
    links: int
    log: int
    """Takes the environment's output."""


class Answer(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """The result of a request."""

    error: str = ""
    """Empty if the environment is about to run."""


FAREWELL = b"done\n"
"""Written to the lifeline by an environment that ended properly, so that the holder ends properly too."""

encode = msgspec.json.Encoder().encode
decode_request = msgspec.json.Decoder(SpawnRequest).decode
decode_answer = msgspec.json.Decoder(Answer).decode

"""The heartbeat by which masters find each other: one datagram of 24 bytes. Sans-I/O.

The layout is fkie master_discovery's, the C struct ``cBBiiHii`` as little-endian compilers pad it::

    offset 0   'R'
           1   version: 2 for a state, 3 for what version 2 does not know
           2   rate of the sender's heartbeats in tenths of a hertz
           4   seconds, nanoseconds (int32 each) of the last change of the sender's master
          12   port of the sender's RPC server (uint16)
          16   seconds, nanoseconds of its last change that no synchronization made

A zero stamp in version 3 asks all masters for their state; a stamp of -1 says that the sender leaves.
"""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass
from enum import Enum
from typing import NamedTuple

from rce.ros.multimaster.errors import MalformedHeartbeatError

MAX_RATE = 25.5
"""Highest rate that a heartbeat can hold, in hertz."""

_PACKET = struct.Struct("<cBBxiiHxxii")
SIZE = _PACKET.size

_MARK = b"R"
_STATE_VERSION = 2
_REQUEST_VERSION = 3
_GONE = -1
_NANO = 1_000_000_000


class Stamp(NamedTuple):
    """A time as the wire has it."""

    secs: int
    nsecs: int

    @classmethod
    def from_seconds(cls, seconds: float) -> Stamp:
        """Cut a time in seconds into its parts."""
        fraction, whole = math.modf(seconds)
        return cls(int(whole), int(fraction * _NANO))

    @property
    def seconds(self) -> float:
        """The time in seconds."""
        return self.secs + self.nsecs / _NANO


ZERO = Stamp(0, 0)


class Kind(Enum):
    """The kind of a heartbeat."""

    STATE = "state"
    REQUEST = "request"
    LEAVING = "leaving"


_FIXED_STAMPS = {Kind.REQUEST: (ZERO, ZERO), Kind.LEAVING: (Stamp(_GONE, _GONE), Stamp(_GONE, _GONE))}


@dataclass(frozen=True, slots=True)
class Heartbeat:
    """A decoded heartbeat."""

    kind: Kind
    rpc_port: int
    """Port of the sender's RPC server; with the sender's address, it identifies the sender."""
    rate: float = 1.0
    """Hertz, 0 to 25.5."""
    stamp: Stamp = ZERO
    """When the sender's master changed last; zero in what is not a state."""
    stamp_local: Stamp = ZERO
    """When it changed last other than by synchronization."""

    def encode(self) -> bytes:
        """Write the datagram."""
        version = _REQUEST_VERSION if self.kind is Kind.REQUEST else _STATE_VERSION
        stamp, local = _FIXED_STAMPS.get(self.kind, (self.stamp, self.stamp_local))
        rate = min(255, max(0, round(self.rate * 10)))
        return _PACKET.pack(_MARK, version, rate, *stamp, self.rpc_port, *local)


def decode(datagram: bytes) -> Heartbeat:
    """Read a datagram.

    Raises:
        MalformedHeartbeatError: The datagram is not a heartbeat of a known version.
    """
    if len(datagram) != SIZE:
        raise MalformedHeartbeatError(f"a heartbeat has {SIZE} bytes, not {len(datagram)}")
    mark, version, rate, secs, nsecs, port, local_secs, local_nsecs = _PACKET.unpack(datagram)
    if mark != _MARK:
        raise MalformedHeartbeatError(f"a heartbeat begins with 'R', not {mark!r}")
    if version not in (_STATE_VERSION, _REQUEST_VERSION):
        raise MalformedHeartbeatError(f"heartbeats of version {version} are not known")
    stamp, local = Stamp(secs, nsecs), Stamp(local_secs, local_nsecs)
    if _GONE in (secs, local_secs):
        return Heartbeat(Kind.LEAVING, port, rate / 10)
    if version == _REQUEST_VERSION and stamp == ZERO:
        return Heartbeat(Kind.REQUEST, port, rate / 10)
    return Heartbeat(Kind.STATE, port, rate / 10, stamp, local)

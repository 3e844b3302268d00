"""The table of known masters, by their heartbeats and silence. Pure: the time comes from outside.

Every call returns a :class:`Step`: the events to report and the requests to send. A master is identified by
the address of its heartbeats and the port of its RPC server; it is reported once that server gave its name.

A master whose heartbeats come often (:data:`QUALITY_HZ` and more) is offline when they stay out for
``measurement_intervals / rate * timeout_factor`` seconds. One whose heartbeats are rare is asked, after
``active_request_after`` seconds of silence and then with ``rosmaster_hz``, and is offline after
:data:`OFFLINE_AFTER_REQUESTS` questions without an answer. An offline master is forgotten ``remove_after``
seconds after its last heartbeat.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from enum import Enum
from typing import NamedTuple

from rce.ros.multimaster.heartbeat import Heartbeat, Kind, Stamp

QUALITY_HZ = 0.3
"""Heartbeats of at least this rate tell of losses and of the quality of the link."""

OFFLINE_AFTER_REQUESTS = 5
CONTACT_RETRY = 2.0
"""Seconds between attempts to learn a master's name."""

MAX_PEERS = 1024
"""How many masters are known at once; more are ignored, as an attacker can forge any number."""

MAX_BEATS = 256


class PeerKey(NamedTuple):
    """Identifies a discovery."""

    host: str
    """Address that its heartbeats come from."""
    rpc_port: int

    @property
    def monitor_uri(self) -> str:
        """The URI of its RPC server."""
        return f"http://{self.host}:{self.rpc_port}/"


class Contact(NamedTuple):
    """A discovery's contact, as its RPC server reports it."""

    master_uri: str
    master_name: str
    discoverer: str
    """Name of the discovery node."""


class PeerChange(Enum):
    """The kind of a change of a master."""

    NEW = "new"
    CHANGED = "changed"
    REMOVED = "removed"


@dataclass(frozen=True, slots=True)
class Neighbour:
    """A master, as told to others."""

    name: str
    uri: str
    """Its ``ROS_MASTER_URI``."""
    monitor_uri: str
    """RPC server of its discovery."""
    discoverer: str
    online: bool
    stamp: Stamp
    stamp_local: Stamp


@dataclass(frozen=True, slots=True)
class PeerEvent:
    """A change among the masters."""

    change: PeerChange
    master: Neighbour


@dataclass(slots=True)
class Step:
    """The events and requests that follow from a call."""

    events: list[PeerEvent] = field(default_factory=list)
    ask_contact: list[PeerKey] = field(default_factory=list)
    """The peers whose RPC server to ask for its name; the answer goes to :meth:`PeerTable.contacted`."""
    request_state: list[str] = field(default_factory=list)
    """Hosts to send a request to."""


class Link(NamedTuple):
    """Quality of the link to a master."""

    name: str
    quality: float
    """Percent of the expected heartbeats that came; -1 while that is unknown."""
    silence: float
    """Seconds since the last heartbeat."""


@dataclass(frozen=True, slots=True)
class LivenessSettings:
    """When a silent master counts as gone; names and meanings are those of master_discovery."""

    measurement_intervals: float = 5.0
    """Heartbeats over which the quality of a link is measured."""
    timeout_factor: float = 0.5
    """Part of the measurement that may be silence."""
    active_request_after: float = 60.0
    """Seconds of silence after which a master with rare heartbeats is asked."""
    rosmaster_hz: float = 1.0
    remove_after: float = 300.0
    """Seconds after which an offline master is forgotten; 0: never."""


@dataclass(slots=True)
class _Peer:
    key: PeerKey
    heard: Heartbeat
    first_beat: float
    last_beat: float
    contact_due: float | None
    """When to ask for the contact; None when that is known."""
    contact: Contact | None = None
    online: bool = False
    requests: list[float] = field(default_factory=list)
    beats: deque[float] = field(default_factory=lambda: deque(maxlen=MAX_BEATS))

    @property
    def measures(self) -> bool:
        return self.heard.rate >= QUALITY_HZ


class PeerTable:
    """The masters that were heard of, this machine's own among them."""

    def __init__(self, liveness: LivenessSettings | None = None) -> None:
        self._liveness = liveness or LivenessSettings()
        self._peers: dict[PeerKey, _Peer] = {}

    # Questions

    @property
    def masters(self) -> list[Neighbour]:
        """The masters whose names are known, online or not."""
        return [_neighbour(peer) for peer in self._peers.values() if peer.contact is not None]

    @property
    def hosts(self) -> set[str]:
        """The addresses that heartbeats came from."""
        return {key.host for key in self._peers}

    def links(self, now: float) -> list[Link]:
        """Return the quality of the links to all masters that are online."""
        return [
            Link(peer.contact.master_name, self._quality(peer, now), now - peer.last_beat)
            for peer in self._peers.values()
            if peer.contact is not None and peer.online
        ]

    # Events

    def received(self, host: str, beat: Heartbeat, now: float) -> Step:
        """Take a heartbeat.

        A request makes its sender known; the caller decides whether to answer it.
        """
        step = Step()
        key = PeerKey(host, beat.rpc_port)
        peer = self._peers.get(key)
        if beat.kind is Kind.LEAVING:
            if peer is not None:
                self._remove(peer, step)
        elif peer is None:
            if len(self._peers) < MAX_PEERS:
                self._peers[key] = peer = _Peer(key, beat, now, now, contact_due=now)
                self._due_contact(peer, now, step)
        elif beat.kind is Kind.STATE:
            self._beat(peer, beat, now, step)
        return step

    def contacted(self, key: PeerKey, contact: Contact, now: float) -> Step:
        """Take a discovery's contact, as its RPC server reported it."""
        step = Step()
        peer = self._peers.get(key)
        if peer is None:
            return step
        peer.contact_due = None
        if peer.contact is not None and peer.contact != contact:
            self._tell(peer, PeerChange.REMOVED, step)
            peer.contact = None
        if peer.contact is None:
            peer.contact = contact
            peer.online = True
            peer.last_beat = max(peer.last_beat, now)
            self._tell(peer, PeerChange.NEW, step)
        elif not peer.online:
            peer.online = True
            self._tell(peer, PeerChange.CHANGED, step)
        return step

    def tick(self, now: float) -> Step:
        """Let time pass; to be called about ``rosmaster_hz`` times a second."""
        step = Step()
        for peer in list(self._peers.values()):
            silence = now - peer.last_beat
            if self._liveness.remove_after > 0 and silence > self._liveness.remove_after:
                self._remove(peer, step)
                continue
            self._due_contact(peer, now, step)
            if peer.measures:
                if silence > self._allowed_silence(peer):
                    self._offline(peer, step)
            else:
                self._question(peer, now, step)
        return step

    def leave(self) -> Step:
        """Forget all masters: this discovery ends."""
        step = Step()
        for peer in list(self._peers.values()):
            self._remove(peer, step)
        return step

    # Inside

    def _beat(self, peer: _Peer, beat: Heartbeat, now: float, step: Step) -> None:
        is_new = (beat.stamp, beat.stamp_local) != (peer.heard.stamp, peer.heard.stamp_local)
        if beat.rate != peer.heard.rate:
            peer.beats.clear()
        peer.heard, peer.last_beat = beat, now
        peer.requests.clear()
        if peer.measures:
            peer.beats.append(now)
        if peer.contact is None:
            self._due_contact(peer, now, step)
        elif not peer.online:
            # Another master may have taken this one's address: it is online once its contact is known.
            if peer.contact_due is None:
                peer.contact_due = now
            self._due_contact(peer, now, step)
        elif is_new:
            self._tell(peer, PeerChange.CHANGED, step)

    def _due_contact(self, peer: _Peer, now: float, step: Step) -> None:
        if peer.contact_due is not None and now >= peer.contact_due:
            peer.contact_due = now + CONTACT_RETRY
            step.ask_contact.append(peer.key)

    def _question(self, peer: _Peer, now: float, step: Step) -> None:
        asked = bool(peer.requests)
        period = 1 / self._liveness.rosmaster_hz
        if asked and now - peer.requests[-1] < period:
            return
        if not asked and now - peer.last_beat <= self._liveness.active_request_after:
            return
        if len(peer.requests) >= OFFLINE_AFTER_REQUESTS:
            self._offline(peer, step)
            if now - peer.requests[-1] < self._liveness.active_request_after:
                return
        peer.requests.append(now)
        del peer.requests[: -OFFLINE_AFTER_REQUESTS - 1]
        step.request_state.append(peer.key.host)

    def _allowed_silence(self, peer: _Peer) -> float:
        return self._liveness.measurement_intervals / peer.heard.rate * self._liveness.timeout_factor

    def _quality(self, peer: _Peer, now: float) -> float:
        if not peer.measures:
            return -1.0
        duration = min(self._liveness.measurement_intervals / peer.heard.rate, now - peer.first_beat)
        expected = int(peer.heard.rate * duration)
        if expected <= 0:
            return -1.0
        came = sum(now - duration < beat <= now for beat in peer.beats)
        return min(100.0, 100.0 * came / expected)

    def _offline(self, peer: _Peer, step: Step) -> None:
        if peer.online:
            peer.online = False
            self._tell(peer, PeerChange.CHANGED, step)

    def _remove(self, peer: _Peer, step: Step) -> None:
        peer.online = False
        self._tell(peer, PeerChange.REMOVED, step)
        del self._peers[peer.key]

    @staticmethod
    def _tell(peer: _Peer, change: PeerChange, step: Step) -> None:
        if peer.contact is not None:
            step.events.append(PeerEvent(change, _neighbour(peer)))


def _neighbour(peer: _Peer) -> Neighbour:
    assert peer.contact is not None
    return Neighbour(
        name=peer.contact.master_name,
        uri=peer.contact.master_uri,
        monitor_uri=peer.key.monitor_uri,
        discoverer=peer.contact.discoverer,
        online=peer.online,
        stamp=peer.heard.stamp,
        stamp_local=peer.heard.stamp_local,
    )

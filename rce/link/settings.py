"""Times and limits of links, as frozen values."""

from __future__ import annotations

from dataclasses import dataclass

from rce.aio.backoff import Backoff

KIB = 1024
MIB = 1024 * KIB


@dataclass(frozen=True, slots=True, kw_only=True)
class LinkTimeouts:
    """Timeouts of links. All in seconds."""

    connect: float = 5.0
    """To reach a peer's socket."""
    handshake: float = 10.0
    """From an accepted connection to its HELLO, with TLS; more than ``unknown_link``. It begins again where a
    connection is handed over. The dialing end: to begin TLS, and then from HELLO to the answer."""
    unknown_link: float = 5.0
    """An accepted link that no endpoint knows yet: its spec may be on its way."""
    redial: Backoff = Backoff(first=0.02, longest=1.0, jitter=0.5)
    """Pauses before dialing again."""
    heartbeat: float = 2.0
    """A TCP link that was silent for so long is sent a PING."""
    silence: float = 8.0
    """A TCP link that was silent for so long is dead."""
    flush: float = 1.0
    """A closing connection may take so long to send the rest of its socket's buffer."""
    call: float = 30.0
    """A service call without a timeout of its own."""
    close: float = 10.0
    """An interface may take so long to close."""
    take: float = 5.0
    """The copy of a peer that was moved may take so long to say that it takes over."""
    former: float = 10.0
    """The former connection to a peer that was moved may take so long to answer the last calls."""
    quiet: float = 0.5
    """It ends once it has answered all calls and nothing came on it for so long."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LinkLimits:
    """How much links hold. Sizes in bytes."""

    max_message: int = 64 * MIB
    """A larger message is not sent, and ends the link if a peer sends it."""
    unfinished_bytes: int = 256 * MIB
    """Of all messages on one link that are partly sent; a sender waits, a receiver ends the link."""
    max_channels: int = 4096
    """Channels that a peer may have open on one link."""
    queue_messages: int = 64
    """Messages of one topic connection that wait to be sent."""
    queue_bytes: int = 32 * MIB
    """Bytes of one topic connection that wait to be sent; a single larger message may still wait alone."""
    max_calls: int = 1024
    """Calls of one service connection without an answer; also requests or answers that wait to be sent."""
    serving: int = 64
    """Requests that one interface serves at the same time."""
    waiting: int = 1024
    """Requests that wait until one interface can serve them."""
    unauthenticated: int = 1024
    """Accepted connections that have not named their link yet."""
    unauthenticated_per_address: int = 256
    """The same from one address."""

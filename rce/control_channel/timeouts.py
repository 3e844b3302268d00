"""Times and sizes of the control channel."""

from __future__ import annotations

from dataclasses import dataclass

from rce.aio.backoff import Backoff


@dataclass(frozen=True, slots=True, kw_only=True)
class ControlTimeouts:
    """Times of both ends, in seconds."""

    open: float = 5.0
    """A dial, with its handshake, and the first message after it."""
    connect: float = 2.0
    """A TCP connection to one of several masters: a machine that is off answers nothing, and another one may
    lead."""
    ping_interval: float = 5.0
    master_ping_interval: float = 2.0
    """The task set's on the control channel: of several masters, another one leads soon after the leading one
    hangs."""
    ping_timeout: float = 5.0
    """A peer that does not answer a ping for so long is gone."""
    close: float = 1.0
    request: float = 15.0
    """An answer of the master; long enough for a master that is being restarted, and for another one to lead
    after a machine was lost."""
    busy: float = 60.0
    """An answer of a master that is connected all the time, but has much to do."""
    log: float = 5.0
    """A piece of a node's log."""
    state: float = 20.0
    """A snapshot of a node's state that is made before its container moves."""
    backoff: Backoff = Backoff(first=0.05, longest=2.0, jitter=1.0)
    """Waits before the next dial."""
    backoff_refused: float = 5.0
    """The wait after the master refused this task set or its secret; dialing sooner would hardly help."""


DEFAULT_TIMEOUTS = ControlTimeouts()

MAX_FRAME = 256 * 2**20
"""Longest message, in bytes: ``Sync`` has the whole desired state of a task set. Both ends have
authenticated; the master limits how much a user may ask for."""
MAX_TEXT = MAX_FRAME // 4
"""Most characters that surely fit. If more wait for a peer, it is disconnected and starts again."""
MAX_QUEUED = 8192
"""How many messages may wait for a peer; one that is further behind is disconnected and starts again."""

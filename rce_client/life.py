"""The life of a client's connection: its states, what may happen in each, and what follows."""

from __future__ import annotations

from enum import Enum

from rce.lifecycle import LifeCycle


class State(Enum):
    """Where a connection is in its life."""

    CLOSED = "closed"
    """Not opened yet, closed by the program, or refused by the engine for good."""
    CONNECTING = "connecting"
    """Looking for the engine, for the first time or again."""
    CONNECTED = "connected"
    """Connected for the first time."""
    LOST = "lost"
    """The connection broke; everything that was made is remembered."""
    RESTORED = "restored"
    """Connected again, and everything that was made was asked for again."""


class ConnectionEvent(Enum):
    """What can happen to a connection."""

    DIAL = "dial"
    """An attempt to connect begins."""
    FAIL = "fail"
    """It failed; another one follows, unless the engine refused this client."""
    CONNECT = "connect"
    """It succeeded, for the first time."""
    RESTORE = "restore"
    """It succeeded, and there was a connection before."""
    LOSE = "lose"
    """The connection broke."""
    REFUSE = "refuse"
    """The engine refused this client for good."""
    CLOSE = "close"
    """The program closed the connection."""


CONNECTION_LIFE: LifeCycle[State, ConnectionEvent] = LifeCycle(
    "connection",
    {
        State.CLOSED: {
            ConnectionEvent.DIAL: State.CONNECTING,
            ConnectionEvent.CLOSE: State.CLOSED,
        },
        State.CONNECTING: {
            ConnectionEvent.DIAL: State.CONNECTING,
            ConnectionEvent.FAIL: State.CONNECTING,
            ConnectionEvent.CONNECT: State.CONNECTED,
            ConnectionEvent.RESTORE: State.RESTORED,
            ConnectionEvent.REFUSE: State.CLOSED,
            ConnectionEvent.CLOSE: State.CLOSED,
        },
        State.CONNECTED: {
            ConnectionEvent.LOSE: State.LOST,
            ConnectionEvent.CLOSE: State.CLOSED,
        },
        State.LOST: {
            ConnectionEvent.DIAL: State.CONNECTING,
            ConnectionEvent.CLOSE: State.CLOSED,
        },
        State.RESTORED: {
            ConnectionEvent.LOSE: State.LOST,
            ConnectionEvent.CLOSE: State.CLOSED,
        },
    },
)

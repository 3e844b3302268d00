"""The life of a client's connection: its states, what may happen in each, and what follows."""

from __future__ import annotations

from enum import Enum

from rce.lifecycle import LifeCycle


class State(Enum):
    """The states of a connection."""

    CLOSED = "closed"
    """Not opened yet, closed by the program, or refused by the engine permanently."""
    CONNECTING = "connecting"
    """Trying to connect, for the first time or again."""
    CONNECTED = "connected"
    """Connected for the first time."""
    LOST = "lost"
    """The connection broke; all requests are stored."""
    RESTORED = "restored"
    """Connected again, and all stored requests were sent again."""


class ConnectionEvent(Enum):
    """The events of a connection."""

    DIAL = "dial"
    """An attempt to connect begins."""
    FAIL = "fail"
    """The attempt failed; another one follows, unless the engine refused this client."""
    CONNECT = "connect"
    """The attempt succeeded for the first time."""
    RESTORE = "restore"
    """The attempt succeeded after an earlier connection."""
    LOSE = "lose"
    """The connection broke."""
    REFUSE = "refuse"
    """The engine refused this client permanently."""
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

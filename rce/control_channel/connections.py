"""The two ends of a WebSocket connection of the control channel: both watch each other for signs of life."""

from __future__ import annotations

from rce.guard.websocket import GuardedConnection
from rce.liveness.websocket import WatchedConnection
from rce.tls.websocket import TlsClientConnection


class MasterConnection(WatchedConnection, GuardedConnection):
    """The master's end."""


class TaskSetConnection(WatchedConnection, TlsClientConnection):
    """The task set's end."""

"""The settings of a robot task set. Times in seconds, sizes in bytes."""

from __future__ import annotations

from dataclasses import dataclass, field

from rce_robot.conversion.pool import ConversionSettings
from rce_robot.doors.client.outbox import OutboxLimits


@dataclass(frozen=True, slots=True, kw_only=True)
class SessionSettings:
    """The settings of one robot's connection."""

    ping_interval: float | None = 10.0
    """Time between pings; None for no pings: a silent loss of the connection is then not detected. A full
    connection is pinged only if it gives no sign of life for this time."""
    ping_timeout: float | None = 10.0
    """Time after a ping within which a robot has to give a sign of life; else it is disconnected. Any data
    from it is one, also that it takes data that waits for it (:mod:`rce.liveness`). None for no limit."""
    probe_timeout: float = 2.0
    """The same for a probe because the robot seems to connect a second time."""
    close_timeout: float = 2.0
    max_text: int = 16 << 20
    """Longest text frame that a robot may send."""
    max_message: int = 64 << 20
    """Largest WebSocket message that a robot may send."""
    write_buffer: tuple[int, int] = (128 << 10, 32 << 10)
    """Limits of waiting data in the socket; the rest waits in the outbox, where it can be overtaken."""
    max_requests: int = 256
    """Requests to the master (``CC``, ``DC``, ``CN``, ``CX``) that may wait."""
    max_request_bytes: int = 4 << 20
    """The same in bytes of their text; more than a stream's ``max_request``."""
    max_calls: int = 1024
    """Service calls of the robot that may wait for their answers."""
    drain_timeout: float = 10.0
    """Time to carry out the last requests of a robot that left."""
    outbox: OutboxLimits = field(default_factory=OutboxLimits)


@dataclass(frozen=True, slots=True, kw_only=True)
class RobotSettings:
    """The settings of the task set."""

    host: str = "0.0.0.0"  # noqa: S104 - robots connect from any address
    ws_port: int = 9010
    link_port: int | None = None
    """Port for data links; None is 10030, or a free one where that is taken. The master tells it to peers."""
    public_host: str = ""
    """The address of this machine for clients and links of other machines; detected if empty."""
    public_url: str = ""
    """The URL for clients; made of this machine's address and the port if empty."""
    machine: str = ""
    origins: tuple[str, ...] = ()
    """Origins whose pages may connect; robots and programs do not send an origin. ``*`` is any."""
    trusted_proxies: tuple[str, ...] = ()
    """Addresses or networks of proxies whose ``X-Forwarded-For`` is trusted."""
    login_timeout: float = 8.0
    """How long a login waits for a master that is away."""
    open_timeout: float = 20.0
    """The whole handshake; more than ``login_timeout``."""
    user_memory: int = 512 << 20
    """Bytes of waiting or incomplete messages of all robots of one user; beyond it the oldest are dropped."""
    memory: int = 0
    """The same for all users; 0 is half of the machine's memory."""
    unauthenticated: int = 1024
    """Connections whose robot has not logged in yet."""
    unauthenticated_per_address: int = 256
    """The same from one address."""
    conversion: ConversionSettings = field(default_factory=ConversionSettings)
    call_timeout: float = 30.0
    """How long a robot may take to answer a service call."""
    usage_interval: float = 2.0
    session: SessionSettings = field(default_factory=SessionSettings)

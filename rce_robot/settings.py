"""What can be set of a robot task set. Times in seconds, sizes in bytes."""

from __future__ import annotations

from dataclasses import dataclass, field

from rce_robot.conversion.pool import ConversionSettings
from rce_robot.doors.client.outbox import OutboxLimits


@dataclass(frozen=True, slots=True, kw_only=True)
class SessionSettings:
    """How one robot's connection is run."""

    ping_interval: float | None = 10.0
    """Time between pings; None for no pings, so that a silent loss is never noticed."""
    ping_timeout: float | None = 10.0
    """A robot that does not answer a ping for so long is gone."""
    probe_timeout: float = 2.0
    """The same when the robot is asked because it seems to come in a second time."""
    close_timeout: float = 2.0
    max_text: int = 16 << 20
    """Longest text frame that a robot may send."""
    max_message: int = 64 << 20
    """Largest WebSocket message that a robot may send."""
    write_buffer: tuple[int, int] = (128 << 10, 32 << 10)
    """Limits of what waits in the socket; the rest waits in the outbox, where it can be overtaken."""
    max_requests: int = 256
    """Requests to the master (``CC``, ``DC``, ``CN``, ``CX``) that may wait."""
    max_request_bytes: int = 4 << 20
    """The same in bytes of their text; more than a stream's ``max_request``."""
    max_calls: int = 1024
    """Service calls of the robot that may wait for their answers."""
    drain_timeout: float = 10.0
    """A robot that left has its last requests carried out for so long."""
    outbox: OutboxLimits = field(default_factory=OutboxLimits)


@dataclass(frozen=True, slots=True, kw_only=True)
class RobotSettings:
    """How the task set is run."""

    host: str = "0.0.0.0"  # noqa: S104 - robots come from everywhere
    ws_port: int = 9010
    link_port: int | None = None
    """Port for data links; None is 10030, or a free one where that is taken. The master tells it to peers."""
    public_host: str = ""
    """Where clients and links of other machines find this one; found out if empty."""
    public_url: str = ""
    """Where clients are sent; made of this machine's address and the port if empty."""
    machine: str = ""
    origins: tuple[str, ...] = ()
    """Origins whose pages may connect; robots and programs send none. ``*`` is any."""
    trusted_proxies: tuple[str, ...] = ()
    """Addresses or networks of proxies whose ``X-Forwarded-For`` is believed."""
    login_timeout: float = 8.0
    """How long a robot at the door waits for a master that is away."""
    open_timeout: float = 20.0
    """The whole handshake; more than ``login_timeout``."""
    user_memory: int = 512 << 20
    """Bytes of messages that wait for all robots of one user, or are incomplete; over it the oldest go."""
    memory: int = 0
    """The same for all users; 0 is half of the machine's memory."""
    strangers: int = 1024
    """Connections whose robot has not logged in yet."""
    strangers_per_address: int = 256
    """The same from one address."""
    conversion: ConversionSettings = field(default_factory=ConversionSettings)
    call_timeout: float = 30.0
    """How long a robot may take to answer a service call."""
    usage_interval: float = 2.0
    session: SessionSettings = field(default_factory=SessionSettings)

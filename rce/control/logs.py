"""The words of the logs that containers keep."""

from __future__ import annotations

from enum import Enum

from msgspec import Struct, field


class LogStream(Enum):
    """The origin of a line of a node's log."""

    STDOUT = "stdout"
    STDERR = "stderr"
    ROSOUT = "rosout"
    """The node's log records in ROS. The environment has those of all nodes, as in ROS's ``rosout.log``."""
    ENGINE = "engine"
    """The node's life cycle: how it ended, when it is started again."""


class LogLevel(Enum):
    """How serious a log record in ROS is, from the least to the most."""

    DEBUG = "debug"
    INFO = "info"
    WARN = "warn"
    ERROR = "error"
    FATAL = "fatal"


class LogQuery(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """Selects the lines to read from the logs of a container's node."""

    streams: tuple[LogStream, ...] = ()
    """Only these; all if empty. The environment's log knows ``rosout`` only, which is another log there."""
    level: LogLevel = LogLevel.DEBUG
    """Of log records in ROS only those that are at least as serious."""
    incarnation: str = field(default="", name="life")
    """Of which incarnation of the container, as an answer said; empty: of the present or last one."""
    previous: bool = False
    """Of the last incarnation that ended, though there may be a newer one; goes without ``incarnation``."""
    since: float = 0.0
    """Not of incarnations that began before this time (seconds since the epoch): they were another user's."""

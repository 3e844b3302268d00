"""The words of the logs that containers keep."""

from __future__ import annotations

from enum import Enum


class LogStream(Enum):
    """Where a line of a node's log comes from."""

    STDOUT = "stdout"
    STDERR = "stderr"
    ROSOUT = "rosout"
    """The node's log records in ROS. The environment has those of all nodes, as in ROS's ``rosout.log``."""
    ENGINE = "engine"
    """What became of the node: how it ended, when it is started again."""


class LogLevel(Enum):
    """How serious a log record in ROS is, from the least to the most."""

    DEBUG = "debug"
    INFO = "info"
    WARN = "warn"
    ERROR = "error"
    FATAL = "fatal"

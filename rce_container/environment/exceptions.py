"""The errors inside a container.

EnvironmentFaultError         told to the user as it is; the rest of the container continues
├── NodeError            a node cannot be started
├── ParameterError       a parameter cannot be set
└── NodeStateError        a snapshot of a node's state cannot be fetched or kept
ChannelError             the other end of the control socket breaks the protocol, or does not read
"""

from __future__ import annotations


class EnvironmentFaultError(Exception):
    """Something the user asked for cannot be done; the text says what to do."""


class NodeError(EnvironmentFaultError):
    """A node cannot be started."""


class ParameterError(EnvironmentFaultError):
    """A parameter cannot be set."""


class ChannelError(Exception):
    """The other end of a control socket breaks the protocol, or does not read."""


class NodeStateError(EnvironmentFaultError):
    """A snapshot of a node's state cannot be fetched or kept."""

"""Errors of :mod:`rce_client`.

::

    ClientError
    +-- RefusedError          the engine refuses the client; trying again does not help (credentials, version)
    |   +-- UntrustedError    the engine's certificate is not trusted, or it offers no TLS although it must
    +-- UnavailableError      the engine cannot be reached now; try again
    |   +-- InUseError        another client has this robotID
    |   +-- LostError         the connection broke
    +-- NotConnectedError     nothing can be sent now
    +-- InterfaceError        an interface does not support this use
    +-- CallError             a service call failed
        +-- CallTimeoutError  no answer arrived in time
"""

from __future__ import annotations


class ClientError(Exception):
    """Base of the errors of :mod:`rce_client`."""


class RefusedError(ClientError):
    """The engine refuses this client.

    Attributes:
        status: HTTP status, 0 if there was no answer.
        reason: The engine's explanation.
    """

    def __init__(self, status: int, reason: str) -> None:
        super().__init__(status, reason)
        self.status = status
        self.reason = reason

    def __str__(self) -> str:
        return f"refused ({self.status}): {self.reason}" if self.status else self.reason


class UntrustedError(RefusedError):
    """The engine's certificate is not trusted, or it offers no TLS although it must.

    No credential was sent. A client that was connected before keeps trying, as the operator can repair it.
    """

    def __init__(self, reason: str) -> None:
        super().__init__(0, reason)


class UnavailableError(ClientError):
    """The engine cannot be reached or has no room now.

    Attributes:
        reason: The cause.
        status: HTTP status, 0 if there was no answer.
    """

    def __init__(self, reason: str, status: int = 0) -> None:
        super().__init__(reason, status)
        self.reason = reason
        self.status = status

    def __str__(self) -> str:
        return f"unavailable ({self.status}): {self.reason}" if self.status else self.reason


class InUseError(UnavailableError):
    """Another client is connected with this robotID; the text says from where and since when."""

    def __str__(self) -> str:
        return f"the robotID is in use; waiting until it is free: {self.reason}"


class LostError(UnavailableError):
    """The connection broke."""


class NotConnectedError(ClientError):
    """Nothing can be sent: the connection is not established, or it was closed."""


class InterfaceError(ClientError):
    """An interface does not support this use."""


class CallError(ClientError):
    """A service call failed; the text comes from the engine or the provider."""


class CallTimeoutError(CallError, TimeoutError):
    """No answer to a service call arrived in time. The service may have processed the call."""

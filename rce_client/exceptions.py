"""Errors of :mod:`rce_client`.

::

    ClientError
    +-- RefusedError          the engine refuses the client; trying again does not help (credentials, version)
    |   +-- UntrustedError    the engine's certificate is not trusted, or it offers no TLS where it must
    +-- UnavailableError      the engine cannot be reached now; try again
    |   +-- InUseError        another client has this robotID
    |   +-- LostError         the connection broke
    +-- NotConnectedError     nothing can be sent now
    +-- InterfaceError        an interface is used in a way that it does not allow
    +-- CallError             a service call failed
        +-- CallTimeoutError  ... no answer came in time
"""

from __future__ import annotations


class ClientError(Exception):
    """Base of the errors of :mod:`rce_client`."""


class RefusedError(ClientError):
    """The engine refuses this client.

    Attributes:
        status: HTTP status, 0 if there was no answer.
        reason: What the engine said.
    """

    def __init__(self, status: int, reason: str) -> None:
        super().__init__(status, reason)
        self.status = status
        self.reason = reason

    def __str__(self) -> str:
        return f"refused ({self.status}): {self.reason}" if self.status else self.reason


class UntrustedError(RefusedError):
    """The engine's certificate is not trusted, or it offers no TLS where it must.

    No credential was sent. A client that was connected before keeps trying, as the operator can repair it.
    """

    def __init__(self, reason: str) -> None:
        super().__init__(0, reason)


class UnavailableError(ClientError):
    """The engine cannot be reached or has no room now.

    Attributes:
        reason: What happened.
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
    """Nothing can be sent: there is no connection now, or it was closed."""


class InterfaceError(ClientError):
    """An interface is used in a way that it does not allow."""


class CallError(ClientError):
    """A service call failed; the text is the engine's or the provider's."""


class CallTimeoutError(CallError, TimeoutError):
    """No answer to a service call came in time. The call may have been carried out."""

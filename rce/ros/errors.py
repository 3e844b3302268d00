"""Errors of a ROS graph.

::

    RosError
    +-- InvalidNameError            a graph name or remapping that ROS does not allow (also a ValueError)
    +-- XmlRpcError                 an XML-RPC exchange failed
    |   +-- MalformedDocumentError  a received document, or a value to send, is not valid XML-RPC
    |   +-- RemoteFaultError        the server answered with a fault
    |   +-- RpcUnreachableError     no answer: refused, lost or timed out
    |       +-- RpcTimeoutError     no answer in time
    |       +-- RpcRefusedError     no program listens at the server's address
    +-- MasterError
    |   +-- MasterUnreachableError  the master gave no answer
    |   +-- MasterRefusedError      the master answered with a status other than success
    +-- ParameterMissingError       no such parameter (also a KeyError)
    +-- ParameterValueError         a value that a parameter cannot have (also a ValueError)
    +-- TcprosError                 a TCPROS connection cannot continue
    |   +-- MalformedFrameError     a header or length that breaks the protocol
    |   +-- HandshakeRefusedError   the two ends do not agree on type or name
    +-- TypeMismatchError           one topic or service used with two types in one node
    +-- ServiceError                a service call got no response
    |   +-- ServiceNotFoundError    the service has no provider
    |   +-- ServiceLostError        the provider could not be reached or went away before it answered
    |   +-- ServiceFaultError       the provider answered with an error; handlers raise it to do so
    |   +-- ServiceTimeoutError     no answer in time (also a TimeoutError)
    +-- NodeClosedError             the node was used before it started or after it ended
"""

from __future__ import annotations


class RosError(Exception):
    """Base of all errors of :mod:`rce.ros`."""


class InvalidNameError(RosError, ValueError):
    """A graph name or remapping that ROS does not allow."""


class XmlRpcError(RosError):
    """An XML-RPC exchange failed."""


class MalformedDocumentError(XmlRpcError):
    """A document is not XML-RPC, breaks a limit, or a value has no XML-RPC form."""


class RemoteFaultError(XmlRpcError):
    """The server answered with a fault.

    Attributes:
        code: The server's fault code.
        text: The server's text.
    """

    def __init__(self, code: int, text: str) -> None:
        super().__init__(code, text)
        self.code = code
        self.text = text

    def __str__(self) -> str:
        return f"fault {self.code}: {self.text}"


class RpcUnreachableError(XmlRpcError):
    """No answer came from a server.

    Attributes:
        uri: The server's URI.
        reason: Why there is no answer.
    """

    def __init__(self, uri: str, reason: str) -> None:
        super().__init__(uri, reason)
        self.uri = uri
        self.reason = reason

    def __str__(self) -> str:
        return f"no answer from {self.uri}: {self.reason}"


class RpcTimeoutError(RpcUnreachableError):
    """A server did not answer in time: it may be slow, stopped, or gone without a word."""


class RpcRefusedError(RpcUnreachableError):
    """The host of a server refused the connection: no program listens at that address any longer."""


class MasterError(RosError):
    """The ROS master could not be used."""


class MasterUnreachableError(MasterError):
    """The ROS master gave no answer.

    Attributes:
        uri: The master's URI.
        reason: Why there is no answer.
        is_late: Whether it did not come in time: the master may only be busy.
    """

    def __init__(self, uri: str, reason: str, *, is_late: bool = False) -> None:
        super().__init__(uri, reason)
        self.uri = uri
        self.reason = reason
        self.is_late = is_late

    def __str__(self) -> str:
        return f"the ROS master at {self.uri} does not answer: {self.reason}"


class MasterRefusedError(MasterError):
    """The ROS master answered with a status other than success.

    Attributes:
        method: The method that was called.
        status: -1 for a caller's mistake, 0 for a failure of the master.
        text: The master's text.
    """

    def __init__(self, method: str, status: int, text: str) -> None:
        super().__init__(method, status, text)
        self.method = method
        self.status = status
        self.text = text

    def __str__(self) -> str:
        return f"{self.method}: {self.text}"


class ParameterValueError(RosError, ValueError):
    """A value that a parameter cannot have, because XML-RPC has no form for it.

    Attributes:
        name: The parameter's resolved name; of a namespace, the place in it.
        reason: Why it cannot be sent.
    """

    def __init__(self, name: str, reason: str) -> None:
        super().__init__(name, reason)
        self.name = name
        self.reason = reason

    def __str__(self) -> str:
        return f"parameter {self.name}: {self.reason}"


class ParameterMissingError(RosError, KeyError):
    """No such parameter on the parameter server.

    Attributes:
        name: The parameter's resolved name.
    """

    def __init__(self, name: str) -> None:
        super().__init__(name)
        self.name = name

    def __str__(self) -> str:
        return f"parameter {self.name} is not set"


class TcprosError(RosError):
    """A TCPROS connection cannot continue."""


class MalformedFrameError(TcprosError):
    """A connection header or frame length that breaks the protocol or a limit."""


class HandshakeRefusedError(TcprosError):
    """The two ends of a connection do not agree; the text says on what."""


class TypeMismatchError(RosError):
    """One topic or service is used with two types in the same node."""


class ServiceError(RosError):
    """A service call got no response.

    Attributes:
        service: The service's resolved name.
    """

    text = "the call failed"

    def __init__(self, service: str, text: str | None = None) -> None:
        super().__init__(service, text)
        self.service = service
        if text is not None:
            self.text = text

    def __str__(self) -> str:
        return f"service {self.service}: {self.text}"


class ServiceNotFoundError(ServiceError):
    """The service has no provider."""

    text = "it has no provider"


class ServiceLostError(ServiceError):
    """The provider could not be reached, or its connection broke before the answer."""

    text = "the provider went away"


class ServiceTimeoutError(ServiceError, TimeoutError):
    """No answer came in time."""

    text = "no answer in time"


class ServiceFaultError(ServiceError):
    """The provider answered with an error.

    A service handler raises ``ServiceFaultError(service, text)`` to answer its caller with ``text``.
    """


class NodeClosedError(RosError):
    """The node was used before it started or after it ended."""


class ToolError(Exception):
    """The command cannot be done; its text says why and what to do."""


class PackageError(Exception):
    """Base of all errors of packages."""


class PackageNotFoundError(PackageError, LookupError):
    """A package was not found on the path."""


class ExecutableNotFoundError(PackageError, LookupError):
    """A package has no such executable, or it may not be executed."""


class BadPackageError(PackageError, ValueError):
    """A package's manifest cannot be read."""

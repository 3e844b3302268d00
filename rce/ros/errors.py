"""Everything that can go wrong on a ROS graph.

::

    RosError
    +-- InvalidName             a graph name or remapping that ROS does not allow (also a ValueError)
    +-- XmlRpcError             talking XML-RPC
    |   +-- MalformedDocument   what came or should go is not acceptable XML-RPC
    |   +-- RemoteFault         the server answered with a fault
    |   +-- RpcUnreachable      no answer: refused, lost or timed out
    +-- MasterError
    |   +-- MasterUnreachable   the master gave no answer
    |   +-- MasterRefused       the master answered that it could not or would not
    +-- ParameterMissing        no such parameter (also a KeyError)
    +-- TcprosError             talking TCPROS
    |   +-- MalformedFrame      a header or length that breaks the protocol
    |   +-- HandshakeRefused    the two ends do not agree on type or name
    +-- TypeMismatch            one topic or service used with two types in one node
    +-- ServiceError            a service call that has no response
    |   +-- ServiceNotFound     nobody provides the service
    |   +-- ServiceLost         the provider could not be reached or went away before it answered
    |   +-- ServiceFault        the provider answered with an error; handlers raise it to do so
    |   +-- ServiceTimeout      no answer in time (also a TimeoutError)
    +-- NodeClosed              the node was used before it started or after it ended
"""

from __future__ import annotations


class RosError(Exception):
    """Base of all errors of :mod:`rce.ros`."""


class InvalidName(RosError, ValueError):  # noqa: N818
    """A graph name or remapping that ROS does not allow."""


class XmlRpcError(RosError):
    """An XML-RPC exchange failed."""


class MalformedDocument(XmlRpcError):  # noqa: N818
    """A document is not XML-RPC, breaks a limit, or a value has no XML-RPC form."""


class RemoteFault(XmlRpcError):  # noqa: N818
    """The server answered with a fault.

    Attributes:
        code: The server's fault code.
        text: The server's words.
    """

    def __init__(self, code: int, text: str) -> None:
        super().__init__(code, text)
        self.code = code
        self.text = text

    def __str__(self) -> str:
        return f"fault {self.code}: {self.text}"


class RpcUnreachable(XmlRpcError):  # noqa: N818
    """No answer came from a server.

    Attributes:
        uri: Who was called.
        reason: Why there is no answer.
    """

    def __init__(self, uri: str, reason: str) -> None:
        super().__init__(uri, reason)
        self.uri = uri
        self.reason = reason

    def __str__(self) -> str:
        return f"no answer from {self.uri}: {self.reason}"


class MasterError(RosError):
    """The ROS master could not be used."""


class MasterUnreachable(MasterError):  # noqa: N818
    """The ROS master gave no answer.

    Attributes:
        uri: The master's URI.
        reason: Why there is no answer.
    """

    def __init__(self, uri: str, reason: str) -> None:
        super().__init__(uri, reason)
        self.uri = uri
        self.reason = reason

    def __str__(self) -> str:
        return f"the ROS master at {self.uri} does not answer: {self.reason}"


class MasterRefused(MasterError):  # noqa: N818
    """The ROS master answered with a status other than success.

    Attributes:
        method: What was asked.
        status: -1 for a caller's mistake, 0 for a failure of the master.
        text: The master's words.
    """

    def __init__(self, method: str, status: int, text: str) -> None:
        super().__init__(method, status, text)
        self.method = method
        self.status = status
        self.text = text

    def __str__(self) -> str:
        return f"{self.method}: {self.text}"


class ParameterMissing(RosError, KeyError):  # noqa: N818
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


class MalformedFrame(TcprosError):  # noqa: N818
    """A connection header or frame length that breaks the protocol or a limit."""


class HandshakeRefused(TcprosError):  # noqa: N818
    """The two ends of a connection do not agree; the text says on what."""


class TypeMismatch(RosError):  # noqa: N818
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


class ServiceNotFound(ServiceError):  # noqa: N818
    """Nobody provides the service."""

    text = "it has no provider"


class ServiceLost(ServiceError):  # noqa: N818
    """The provider could not be reached, or its connection broke before the answer."""

    text = "the provider went away"


class ServiceTimeout(ServiceError, TimeoutError):  # noqa: N818
    """No answer came in time."""

    text = "no answer in time"


class ServiceFault(ServiceError):  # noqa: N818
    """The provider answered with an error.

    A service handler raises ``ServiceFault(service, text)`` to answer its caller with ``text``.
    """


class NodeClosed(RosError):  # noqa: N818
    """The node was used before it started or after it ended."""

"""Where a publisher takes connections: the method ``requestTopic`` of its API.

http://wiki.ros.org/ROS/Slave_API
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from rce.ros.errors import TcprosError
from rce.ros.xmlrpc.dispatch import SUCCESS

if TYPE_CHECKING:
    from rce.ros.xmlrpc import RpcClient

_MAX_PORT = 2**16 - 1


async def ask_address(rpc: RpcClient, uri: str, topic: str, caller: str) -> tuple[str, int]:
    """Ask a publisher for the host and port where it takes subscribers.

    Args:
        rpc: Asks.
        uri: The publisher's API.
        topic: The topic.
        caller: Name of the asking node.

    Raises:
        XmlRpcError: It does not answer.
        TcprosError: It does not offer the topic, or its answer has no known form.
    """
    return read_address(await rpc.call(uri, "requestTopic", (caller, topic, [["TCPROS"]])), uri, topic)


def read_address(answer: Any, uri: str, topic: str) -> tuple[str, int]:
    """Return host and port of an answer ``[1, text, ["TCPROS", host, port]]``.

    Args:
        answer: As it came, of any form.
        uri: The publisher, for errors.
        topic: The topic, for errors.

    Raises:
        TcprosError: The publisher does not offer the topic, or its answer has another form.
    """
    try:
        status, text, protocol = answer
        if status != SUCCESS:
            raise TcprosError(f"{uri} does not offer {topic}: {text}")
        _, host, port = protocol
        number = int(port)
    except (TypeError, ValueError, OverflowError) as error:
        raise TcprosError(f"{uri} answers requestTopic in no known form: {answer!r}") from error
    if not isinstance(host, str) or not host or not 0 < number <= _MAX_PORT:
        raise TcprosError(f"{uri} answers requestTopic with an address that cannot be: {host!r}, {port!r}")
    return host, number

"""Finding the discovery that runs at a master, and asking it for all masters."""

from __future__ import annotations

from rce.ros.errors import MasterRefusedError
from rce.ros.multimaster import messages
from rce.ros.multimaster.errors import NoDiscoveryError
from rce.ros.multimaster.peer_table import Neighbour
from rce.ros.node import Node
from rce.ros.node.master import MasterClient
from rce.ros.xmlrpc import RpcClient

LIST_SERVICE = "/list_masters"
ASK_TIMEOUT = 5.0


async def list_masters(master_uri: str) -> list[Neighbour]:
    """Return the masters that the discovery at ``master_uri`` knows, fkie's or ours.

    Raises:
        NoDiscoveryError: None runs there.
        MasterError: The master does not answer.
        ServiceError: The discovery does not answer.
    """
    asker = Node(
        "list_masters",
        argv=[],
        master_uri=master_uri,
        types=messages.registry(),
        anonymous=True,
        master_timeout=0,
    )
    async with RpcClient() as rpc, asker as node:
        return await masters_known_at(node, MasterClient(master_uri, node.name, node.uri, rpc))


async def masters_known_at(node: Node, master: MasterClient) -> list[Neighbour]:
    """Return the masters that the discovery in a node's graph knows.

    Raises:
        NoDiscoveryError: None runs there.
        MasterError: The master does not answer.
        ServiceError: The discovery does not answer.
    """
    service = await find_service(master, LIST_SERVICE)
    client = node.service_client(service, messages.DISCOVER_MASTERS, persistent=False)
    try:
        answer = await client.call({}, timeout=ASK_TIMEOUT)
    finally:
        await client.close()
    return [messages.read_ros_master(entry) for entry in answer.masters]


async def find_service(master: MasterClient, ending: str) -> str:
    """Return the first service whose name ends so.

    Raises:
        NoDiscoveryError: No such service is registered.
        MasterUnreachableError: The master does not answer.
    """
    try:
        state = await master.call("getSystemState")
    except MasterRefusedError as error:
        raise NoDiscoveryError(str(error)) from error
    names: list[str] = [name for name, _ in state[2] if name.endswith(ending)]
    if not names:
        raise NoDiscoveryError(f"no discovery runs at {master.uri}: start 'rce discovery' there")
    return min(names)

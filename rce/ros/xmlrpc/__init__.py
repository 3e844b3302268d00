"""XML-RPC over HTTP/1.1 in asyncio, as ROS masters and nodes speak it."""

from rce.ros.xmlrpc.client import RpcClient
from rce.ros.xmlrpc.dispatch import BadArgumentError, Dispatcher
from rce.ros.xmlrpc.server import RpcServer

__all__ = ["BadArgumentError", "Dispatcher", "RpcClient", "RpcServer"]

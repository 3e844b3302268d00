"""A robot for measurements: a minimal client of the client protocol.

Its JSON is read and written by msgspec, as in ``rce_client``; with the standard library's ``json`` the client
would take most of the time of a large message.
"""

from __future__ import annotations

import asyncio
import contextlib
import hashlib
import ssl
import struct
import urllib.request
from collections.abc import AsyncIterator
from typing import Any

import msgspec
from websockets.asyncio.client import ClientConnection, connect

STRING = "std_msgs/String"
ECHO = "Test/StringEcho"
_ID = b"0" * 32
_SINGLE = struct.Struct("!BH")
_write = msgspec.json.Encoder().encode
_read = msgspec.json.Decoder().decode


def serialized_string(size: int) -> bytes:
    """A serialized std_msgs/String of ``size`` characters."""
    return struct.pack("<I", size) + b"x" * size


class Robot:
    """One connected robot."""

    def __init__(self, socket: ClientConnection, name: str) -> None:
        self.socket = socket
        self.name = name
        self.status: dict[str, bool] = {}

    async def send(self, kind: str, data: object) -> None:
        """Send a message without binary values."""
        await self.socket.send(_write({"type": kind, "data": data}), text=True)

    async def receive_json(self) -> dict[str, Any]:
        """The data of the next data message; statuses on the way are noted, errors raised."""
        while True:
            frame = await self.socket.recv()
            if isinstance(frame, bytes):
                continue
            message = _read(frame)
            if message["type"] == "DM":
                return dict(message["data"])
            self._note(message)

    async def receive_binary(self) -> bytes:
        """The next binary value."""
        while True:
            frame = await self.socket.recv()
            if isinstance(frame, bytes):
                return frame
            if not frame.startswith('{"type":"DM"') and not frame.startswith('{"type": "DM"'):
                self._note(_read(frame))

    def _note(self, message: dict[str, Any]) -> None:
        if message["type"] == "ST":
            self.status[message["data"]["iTag"]] = message["data"]["status"]
        elif message["type"] == "ER":
            raise RuntimeError(message["data"])

    async def wait_active(self, *tags: str, timeout: float = 60) -> None:
        """Wait until interfaces are active."""
        async with asyncio.timeout(timeout):
            while not all(self.status.get(tag) for tag in tags):
                frame = await self.socket.recv()
                if isinstance(frame, str):
                    self._note(_read(frame))

    async def wait_inactive(self, *tags: str, timeout: float = 60) -> None:
        """Wait until all of these interfaces are inactive."""
        async with asyncio.timeout(timeout):
            while any(self.status.get(tag) for tag in tags):
                frame = await self.socket.recv()
                if isinstance(frame, str):
                    self._note(_read(frame))

    async def send_forwarded(
        self, tag: str, payload: bytes, *, number: str = "nil", message_type: str = STRING
    ) -> None:
        """Send a serialized message: its text frame and its binary frame."""
        data = {"iTag": tag, "type": message_type, "msgID": number, "msg*": _ID.decode()}
        await self.socket.send(_write({"type": "DM", "data": data}), text=True)
        await self.socket.send(_ID + payload)

    async def send_single(
        self, tag: str, payload: bytes, *, number: str = "nil", message_type: str = STRING
    ) -> None:
        """Send a serialized message in one frame; for robots that asked for it."""
        header = _write({"iTag": tag, "type": message_type, "msgID": number})
        await self.socket.send(_SINGLE.pack(1, len(header)) + header + payload)


async def locate(master: str) -> str:
    """Ask a master for the URL of a robot endpoint."""
    query = "userID=testUser&version=20130902"
    with await asyncio.to_thread(urllib.request.urlopen, f"{master}?{query}", timeout=10) as reply:
        return str(_read(reply.read())["url"])


@contextlib.asynccontextmanager
async def robot(master: str, name: str, *, features: str = "") -> AsyncIterator[Robot]:
    """Connect a robot of testUser, which asks for features of the protocol."""
    async with robot_at(await locate(master), name, features=features) as found:
        yield found


@contextlib.asynccontextmanager
async def robot_at(
    url: str, name: str, tls: ssl.SSLContext | None = None, *, features: str = ""
) -> AsyncIterator[Robot]:
    """Connect a robot of testUser to a certain endpoint."""
    password = hashlib.sha256(b"testUser").hexdigest()
    target = f"{url}?userID=testUser&robotID={name}&password={password}&features={features}"
    async with connect(target, ssl=tls, max_size=None, compression=None, ping_interval=None) as socket:
        assert socket.response is not None
        assert socket.response.headers.get("RCE-Features", "") == features
        yield Robot(socket, name)


async def wire_echo(client: Robot, form: str, container: str = "bench") -> None:
    """Make a container with the echo node, its topics and its service wired to the robot by ``form``."""
    ends = [
        ("request", "Publisher", "Subscriber", STRING, "/stringEchoReq"),
        ("response", "Subscriber", "Publisher", STRING, "/stringEchoResp"),
        ("service", "ServiceClient", "ServiceProvider", ECHO, "/stringEchoService"),
    ]
    interfaces = []
    for tag, inside, outside, message_type, address in ends:
        interfaces.append(
            {
                "endpointTag": container,
                "interfaceTag": tag,
                "interfaceType": f"{inside}Interface",
                "className": message_type,
            }
            | {"addr": address}
        )
        interfaces.append(
            {
                "endpointTag": client.name,
                "interfaceTag": tag,
                "interfaceType": f"{outside}{form}",
                "className": message_type,
            }
        )
    node = {"containerTag": container, "nodeTag": "echo", "pkg": "Test", "exe": "stringEcho.py"}
    await client.send("CC", {"containerTag": container})
    await client.send("CN", {"addNodes": [node], "addInterfaces": interfaces})
    pairs = [{"tagA": f"{client.name}/{tag}", "tagB": f"{container}/{tag}"} for tag, *_ in ends]
    await client.send("CX", {"connect": pairs})
    await client.wait_active(*(tag for tag, *_ in ends))

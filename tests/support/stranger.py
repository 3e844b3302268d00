"""A client written from ``docs/protocol.md`` alone: imports nothing of the project, uses aiohttp."""

from __future__ import annotations

import asyncio
import contextlib
import hashlib
import itertools
import json
from collections.abc import AsyncIterator
from typing import Any

import aiohttp

TIMEOUT_S = 90.0
"""How long to wait for what should come at once: the machine may be busy."""


class Stranger:
    """Speaks the wire protocol and keeps what it hears."""

    def __init__(self, socket: aiohttp.ClientWebSocketResponse) -> None:
        self.socket = socket
        self.status: dict[str, bool] = {}
        self.statuses: list[tuple[str, bool]] = []
        self.errors: list[str] = []
        self.data: dict[str, asyncio.Queue[dict[str, Any]]] = {}
        self.binaries: dict[str, bytes] = {}
        self._changed = asyncio.Condition()
        self._numbers = itertools.count()

    async def listen(self) -> None:
        waiting: list[dict[str, Any]] = []
        async for frame in self.socket:
            if frame.type == aiohttp.WSMsgType.BINARY:
                self.binaries[frame.data[:32].decode()] = frame.data[32:]
            elif frame.type == aiohttp.WSMsgType.TEXT:
                waiting.append(json.loads(frame.data))
            for message in list(waiting):
                if self._fill(message.get("data")):
                    waiting.remove(message)
                    await self._take(message)
        async with self._changed:
            self._changed.notify_all()

    def _fill(self, value: object) -> bool:
        if not isinstance(value, dict):
            return True
        if not all(self._fill(inner) for inner in value.values()):
            return False
        for key in [key for key in value if key.endswith("*")]:
            if value[key] not in self.binaries:
                return False
            value[key[:-1]] = self.binaries.pop(value.pop(key))
        return True

    async def _take(self, message: dict[str, Any]) -> None:
        data = message["data"]
        async with self._changed:
            match message["type"]:
                case "ST":
                    self.status[data["iTag"]] = data["status"]
                    self.statuses.append((data["iTag"], data["status"]))
                case "ER":
                    self.errors.append(data)
                case "DM":
                    self.queue(data["iTag"]).put_nowait(data)
                case _:
                    pass  # a message of a later engine
            self._changed.notify_all()

    def queue(self, tag: str) -> asyncio.Queue[dict[str, Any]]:
        return self.data.setdefault(tag, asyncio.Queue())

    async def send(self, kind: str, data: object) -> None:
        await self.socket.send_str(json.dumps({"type": kind, "data": data}))

    async def publish(self, tag: str, message_type: str, message: object) -> None:
        await self.send("DM", {"iTag": tag, "type": message_type, "msgID": "nil", "msg": message})

    async def call(self, tag: str, message_type: str, message: object, *, timeout: float = TIMEOUT_S) -> Any:
        number = f"call{next(self._numbers)}"
        await self.send("DM", {"iTag": tag, "type": message_type, "msgID": number, "msg": message})
        async with asyncio.timeout(timeout):
            answer = await self.queue(tag).get()
        assert answer["msgID"] == number
        return answer["msg"]

    async def receive(self, tag: str, *, timeout: float = TIMEOUT_S) -> Any:
        async with asyncio.timeout(timeout):
            return (await self.queue(tag).get())["msg"]

    async def wait_status(self, tags: dict[str, bool], *, timeout: float = TIMEOUT_S) -> None:
        try:
            async with asyncio.timeout(timeout), self._changed:
                await self._changed.wait_for(
                    lambda: all(self.status.get(tag) == state for tag, state in tags.items())
                )
        except TimeoutError:
            raise AssertionError(f"wanted {tags}; status {self.status}, errors {self.errors}") from None

    async def wait_error(self, text: str, *, timeout: float = TIMEOUT_S) -> str:
        try:
            async with asyncio.timeout(timeout), self._changed:
                await self._changed.wait_for(lambda: any(text in error for error in self.errors))
        except TimeoutError:
            raise AssertionError(f"no error with {text!r} in {self.errors}") from None
        return next(error for error in self.errors if text in error)


@contextlib.asynccontextmanager
async def stranger(
    url: str, *, user: str = "testUser", robot: str = "testRobot", password: str = "testUser"
) -> AsyncIterator[Stranger]:
    """Connect as the protocol page says: HTTP to the master, WebSocket to the endpoint that it names."""
    async with aiohttp.ClientSession() as session:
        async with session.get(url, params={"userID": user, "version": "20130902"}) as reply:
            assert reply.status == 200, await reply.text()
            endpoint = (await reply.json())["url"]
        query = {"userID": user, "robotID": robot, "password": hashlib.sha256(password.encode()).hexdigest()}
        async with session.ws_connect(endpoint, params=query, max_msg_size=0) as socket:
            client = Stranger(socket)
            listener = asyncio.create_task(client.listen())
            try:
                yield client
            finally:
                await socket.close()
                await listener


ECHO_INTERFACES = [
    ("cTag_01", "requestOut", "PublisherInterface", "std_msgs/String", "/stringEchoReq"),
    ("testRobot", "requestIn", "SubscriberConverter", "std_msgs/String", ""),
    ("cTag_01", "responseIn", "SubscriberInterface", "std_msgs/String", "/stringEchoResp"),
    ("testRobot", "responseOut", "PublisherConverter", "std_msgs/String", ""),
    ("cTag_01", "serviceOut", "ServiceClientInterface", "Test/StringEcho", "/stringEchoService"),
    ("testRobot", "serviceIn", "ServiceProviderConverter", "Test/StringEcho", ""),
]
ECHO_CONNECTIONS = [("requestIn", "requestOut"), ("responseOut", "responseIn"), ("serviceIn", "serviceOut")]
ROBOT_TAGS = ("requestIn", "responseOut", "serviceIn")


async def wire_echo(client: Stranger, *, container: str = "cTag_01", robot: str = "testRobot") -> None:
    """Create a container with ``Test/stringEcho.py`` and wire its topics and its service to the robot."""
    await ask_for_echo(client, container, robot)
    await client.wait_status(dict.fromkeys(ROBOT_TAGS, True))


async def ask_for_echo(
    client: Stranger, container: str, robot: str, requested: dict[str, Any] | None = None, **node: object
) -> None:
    """Ask for what :func:`wire_echo` makes, with resources for its container and more keys for its node.

    May be repeated.
    """
    await client.send("CC", {"containerTag": container, "containerData": requested or {}})
    await client.send(
        "CN",
        {
            "addNodes": [
                {"containerTag": container, "nodeTag": "echo", "pkg": "Test", "exe": "stringEcho.py", **node}
            ],
            "addInterfaces": [
                {
                    "endpointTag": {"cTag_01": container, "testRobot": robot}[endpoint],
                    "interfaceTag": tag,
                    "interfaceType": kind,
                    "className": message_type,
                    **({"addr": addr} if addr else {}),
                }
                for endpoint, tag, kind, message_type, addr in ECHO_INTERFACES
            ],
        },
    )
    await client.send(
        "CX", {"connect": [{"tagA": f"{robot}/{a}", "tagB": f"{container}/{b}"} for a, b in ECHO_CONNECTIONS]}
    )


async def check_echo(client: Stranger, text: str) -> None:
    """Send a string by topic and by service and get it back."""
    await client.publish("requestIn", "std_msgs/String", {"data": text})
    while (await client.receive("responseOut"))["data"] != text:
        pass
    assert await client.call("serviceIn", "Test/StringEcho", {"data": text}) == {"data": text}

"""One client stops reading a stream of 5 MB images at 15 Hz: others get every image, nothing piles up."""

from __future__ import annotations

import asyncio
import contextlib
import hashlib
import json
import struct
from collections.abc import AsyncIterator
from pathlib import Path
from urllib.parse import urlencode

import pytest
from support.engine import Engine, running_engine, until
from support.stranger import Stranger, stranger
from websockets.asyncio.client import ClientConnection, connect

pytestmark = [pytest.mark.e2e]

IMAGE = "sensor_msgs/Image"
WIDTH, HEIGHT = 1600, 1042
PIXELS = bytes(WIDTH * HEIGHT * 3)
RATE_HZ = 15
FILLING = 12
"""Images after which every queue on the way to the stalled client is full."""
MORE = 30
SLACK_BYTES = 8 * len(PIXELS)


def image(number: int) -> bytes:
    """A serialized image of 5 MB whose ``header.seq`` is ``number``."""
    header = struct.pack("<IIII", number, 0, 0, 0)
    shape = struct.pack("<III4sBII", HEIGHT, WIDTH, 4, b"rgb8", 0, 3 * WIDTH, len(PIXELS))
    return header + shape + PIXELS


def number_of(payload: bytes) -> int:
    assert payload[16:] == image(0)[16:], "an image was changed on its way"
    return int(struct.unpack_from("<I", payload)[0])


@contextlib.asynccontextmanager
async def client_that_can_stall(engine: Engine, robot: str) -> AsyncIterator[ClientConnection]:
    url = engine.get("/?userID=testUser&version=20130902", token="")["url"]
    password = hashlib.sha256(b"testUser").hexdigest()
    query = urlencode({"userID": "testUser", "robotID": robot, "password": password})
    async with connect(f"{url}?{query}", max_size=None, max_queue=1, ping_interval=None) as socket:
        yield socket


async def wire(camera: Stranger) -> None:
    """Camera -> topic /image in a container -> a node -> topic /copy -> healthy and stalled."""

    def interface(endpoint: str, tag: str, kind: str, **more: str) -> dict[str, str]:
        names = {"endpointTag": endpoint, "interfaceTag": tag, "interfaceType": kind}
        return {**names, "className": IMAGE, **more}

    await camera.send("CC", {"containerTag": "box"})
    interfaces = [
        interface("camera", "out", "SubscriberForwarder"),
        interface("box", "in", "PublisherInterface", addr="/image"),
        interface("box", "out", "SubscriberInterface", addr="/copy"),
        interface("healthy", "in", "PublisherForwarder"),
        interface("stalled", "in", "PublisherForwarder"),
    ]
    node = {"containerTag": "box", "nodeTag": "relay", "pkg": "relays", "exe": "relay.py"}
    await camera.send("CN", {"addNodes": [node], "addInterfaces": interfaces})
    pairs = [("camera/out", "box/in"), ("healthy/in", "box/out"), ("stalled/in", "box/out")]
    await camera.send("CX", {"connect": [{"tagA": a, "tagB": b} for a, b in pairs]})


RELAY = """#!/usr/bin/env python3
from rce.ros.node import Node, run


async def main():
    async with Node("relay") as node:
        copies = await node.advertise("/copy", "sensor_msgs/Image")
        await node.subscribe_serialized(
            "/image", "sensor_msgs/Image", lambda payload, _: copies.publish_serialized(payload)
        )
        await node.spin()


run(main())
"""


@pytest.fixture
def packages(tmp_path: Path) -> Path:
    """A package whose node repeats images on another topic."""
    package = tmp_path / "packages" / "relays"
    package.mkdir(parents=True)
    package.joinpath("package.yaml").write_text("name: relays\nversion: 1.0.0\n")
    node = package / "relay.py"
    node.write_text(RELAY)
    node.chmod(0o755)
    return package.parent


class Stream:
    """Sends images from the camera and sees to it that the healthy client gets each of them."""

    def __init__(
        self, engine: Engine, camera: Stranger, healthy: Stranger, stalled: ClientConnection
    ) -> None:
        self.camera = camera
        self.healthy = healthy
        self.stalled = stalled
        self.sent = 0
        self._path = engine.processes_of("rce-robot") + engine.processes_of("rce_container.environment")
        self._path += engine.processes_of("relay.py")

    async def run(self, count: int) -> int:
        """Send ``count`` more images; returns the most memory of the engine's data path meanwhile, bytes."""
        peak = 0
        for _ in range(count):
            pause = asyncio.create_task(asyncio.sleep(1 / RATE_HZ))
            self.sent += 1
            id_ = f"{self.sent:032x}"
            await self.camera.send("DM", {"iTag": "out", "type": IMAGE, "msgID": "nil", "msg*": id_})
            await self.camera.socket.send_bytes(id_.encode() + image(self.sent))
            assert number_of(await self.healthy.receive("in")) == self.sent
            peak = max(peak, self._memory())
            await self.stalled.pong()  # a sign of life, without which its connection would end after 20 s
            await pause
        return peak

    def _memory(self) -> int:
        return sum(int(process.memory_info().rss) for process in self._path)


def established(engine: Engine) -> int:
    return sum(c["established"] for c in engine.get("/api/v1/connections")["connections"])


def dropped_at_the_stalled_client(engine: Engine) -> int:
    interfaces = engine.get("/api/v1/interfaces")["interfaces"]
    return next(int(i["dropped"]) for i in interfaces if i["endpoint"] == "stalled")


async def newest_image(socket: ClientConnection) -> int:
    """Number of the image that comes next."""
    while True:
        frame = await socket.recv()
        if isinstance(frame, bytes):
            return number_of(frame[32:])
        assert json.loads(frame)["type"] != "ER", frame


async def test_a_client_that_stops_reading_harms_only_itself(packages: Path) -> None:
    async with (
        running_engine(packages=packages) as engine,
        stranger(engine.url, robot="camera") as camera,
        stranger(engine.url, robot="healthy") as healthy,
        client_that_can_stall(engine, "stalled") as stalled,
    ):
        await wire(camera)
        await camera.wait_status({"out": True})
        await healthy.wait_status({"in": True})
        await until(lambda: established(engine) == 3, what="all connections")
        stalled.transport.pause_reading()

        stream = Stream(engine, camera, healthy, stalled)
        before = await stream.run(FILLING)
        after = await stream.run(MORE)

        assert after < before + SLACK_BYTES, "memory grows with the images that nobody takes"
        await until(
            lambda: dropped_at_the_stalled_client(engine) >= MORE,
            what="the stalled client's images are counted as dropped",
        )
        assert camera.errors == healthy.errors == []

        stalled.transport.resume_reading()
        async with asyncio.timeout(30):
            while await newest_image(stalled) != stream.sent:
                pass
        await stream.run(1)

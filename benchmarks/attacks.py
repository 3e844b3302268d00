"""Ways to abuse the robot endpoint: ``python -m benchmarks.attacks KIND URL`` attacks until it is killed.

It prints once a second how often it has done what it does, unless it can do nothing.
"""

from __future__ import annotations

import asyncio
import contextlib
import hashlib
import io
import json
import os
import struct
import sys
from collections.abc import AsyncIterator, Awaitable, Callable
from time import monotonic

import uvloop
from websockets.asyncio.client import ClientConnection, connect
from websockets.exceptions import WebSocketException

USER = PASSWORD = "abuser"
BUSY = "busy processes"
PROGRESS = "progress"
"""First word of the lines with the count."""
STRING, IMAGE = "std_msgs/String", "sensor_msgs/Image"
_MASK = bytes(4)
_ID = b"0" * 32

Attack = Callable[[str], Awaitable[None]]


class Progress:
    """How often this process has done what it does."""

    def __init__(self) -> None:
        self._count = 0
        self._printed_at = 0.0

    def add(self) -> None:
        """Count, and print the count once a second."""
        self._count += 1
        if (now := monotonic()) - self._printed_at >= 1.0:
            self._printed_at = now
            print(PROGRESS, self._count, flush=True)


_progress = Progress()


@contextlib.asynccontextmanager
async def robot(url: str, name: str = "a0") -> AsyncIterator[ClientConnection]:
    """Connect a robot of the abuser."""
    digest = hashlib.sha256(PASSWORD.encode()).hexdigest()
    target = f"{url}?userID={USER}&robotID={name}&password={digest}"
    async with connect(target, max_size=None, compression=None, ping_interval=None) as socket:
        yield socket


async def loop_back(socket: ClientConnection, message_type: str, out: str = "out") -> None:
    """Connect two of the robot's interfaces, so that its messages come back to it.

    Args:
        socket: The robot's connection.
        message_type: Of both interfaces.
        out: Tag of the one that takes messages; those of attacks before this one are still there.

    Raises:
        ConnectionError: The engine has refused it.
    """
    back = f"{out}Back"
    ends = [
        {"endpointTag": "a0", "interfaceTag": tag, "interfaceType": kind, "className": message_type}
        for tag, kind in ((out, "SubscriberConverter"), (back, "PublisherConverter"))
    ]
    await send(socket, "CN", {"addInterfaces": ends})
    await send(socket, "CX", {"connect": [{"tagA": f"a0/{out}", "tagB": f"a0/{back}"}]})
    while True:
        message = json.loads(await socket.recv())
        if message["type"] == "ER":
            raise ConnectionError(message["data"])
        if message["type"] == "ST" and message["data"]["iTag"] == back and message["data"]["status"]:
            return


async def send(socket: ClientConnection, kind: str, data: object) -> None:
    """Send a message."""
    await socket.send(json.dumps({"type": kind, "data": data}))


async def push(socket: ClientConnection, frame: str | bytes) -> None:
    """Send a frame of an attack."""
    await socket.send(frame)
    _progress.add()


def data_message(msg: str, message_type: str = STRING) -> str:
    """The text of a data message of the looped interface."""
    return f'{{"type":"DM","data":{{"iTag":"out","type":"{message_type}","msgID":"nil","msg":{msg}}}}}'


async def drain(socket: ClientConnection) -> None:
    """Read and discard all messages."""
    async for _ in socket:
        pass


def texts(*messages: str) -> Attack:
    """Send texts over and over."""

    async def attack(url: str) -> None:
        async with robot(url) as socket:
            await loop_back(socket, STRING)
            reading = asyncio.create_task(drain(socket))
            while not reading.done():
                for message in messages:
                    await push(socket, message)

    return attack


async def frames(url: str) -> None:
    """Small frames, as many as the network takes."""
    async with robot(url) as socket:
        reading = asyncio.create_task(drain(socket))
        piece = (struct.pack("!BB", 0x81, 0x82) + _MASK + b"{}") * 8192
        while not reading.done():
            socket.transport.write(piece)
            await push(socket, "{}")  # waits for room in the buffer


async def wrong_requests(url: str) -> None:
    """Requests of 500 wrong items each, without a pause."""
    async with robot(url) as socket:
        reading = asyncio.create_task(drain(socket))
        item = {"endpointTag": "a0", "interfaceTag": "x", "interfaceType": "Nonsense", "className": "a/B"}
        text = json.dumps({"type": "CN", "data": {"addInterfaces": [item] * 500}})
        while not reading.done():
            await push(socket, text)


async def changes(url: str) -> None:
    """Requests that make and remove 500 interfaces, without a pause: the master does it, or refuses."""
    async with robot(url) as socket:
        reading = asyncio.create_task(drain(socket))
        names = [{"endpointTag": "a0", "interfaceTag": f"i{number}"} for number in range(500)]
        kind = {"interfaceType": "SubscriberConverter", "className": STRING}
        made = json.dumps({"type": "CN", "data": {"addInterfaces": [{**name, **kind} for name in names]}})
        gone = json.dumps({"type": "CN", "data": {"removeInterfaces": names}})
        while not reading.done():
            await push(socket, made)
            await push(socket, gone)


def images(picture: bytes) -> Attack:
    """Pictures that are decoded and encoded again."""

    async def attack(url: str) -> None:
        async with robot(url) as socket:
            await loop_back(socket, IMAGE, "picture")
            reading = asyncio.create_task(drain(socket))
            text = {"iTag": "picture", "type": IMAGE, "msgID": "nil", "msg*": _ID.decode()}
            while not reading.done():
                await send(socket, "DM", text)
                await push(socket, _ID + picture)

    return attack


def png(width: int, height: int) -> bytes:
    """A black picture."""
    from PIL import Image

    file = io.BytesIO()
    Image.new("RGB", (width, height)).save(file, "PNG", compress_level=1)
    return file.getvalue()


def png_bomb() -> bytes:
    """A small picture whose header says that it is huge."""
    import zlib

    data = bytearray(png(8, 8))
    data[16:24] = struct.pack("!II", 60_000, 60_000)
    data[29:33] = struct.pack("!I", zlib.crc32(data[12:29]))
    return bytes(data)


async def slow(url: str) -> None:
    """A robot sends 5 MB messages to itself and reads nothing."""
    async with robot(url) as socket:
        await loop_back(socket, STRING)
        socket.transport.pause_reading()
        text = data_message(json.dumps({"data": "x" * 5_000_000}))
        while True:
            await push(socket, text)


async def halves(url: str) -> None:
    """Ten robots each send 60 MB of a binary value except its last byte, and start again."""

    async def one(name: str) -> None:
        size = 60_000_000
        header = struct.pack("!BBQ", 0x82, 0xFF, size) + _MASK
        while True:
            with contextlib.suppress(WebSocketException, OSError):
                async with robot(url, name) as socket:
                    socket.transport.write(header + bytes(size - 1))
                    for _ in range(10):
                        _progress.add()
                        with contextlib.suppress(TimeoutError):
                            await asyncio.wait_for(socket.wait_closed(), 1.0)
                            break

    await asyncio.gather(*(one(f"a{number}") for number in range(10)))


async def binaries(url: str) -> None:
    """Binary values of 60 MB that no message asks for."""
    async with robot(url) as socket:
        reading = asyncio.create_task(drain(socket))
        value = bytes(60_000_000)
        for number in range(1_000_000):
            if reading.done():
                return
            await push(socket, b"%032x" % number + value)


_MANY = 199_000
KINDS: dict[str, Callable[[], Attack]] = {
    "too many elements": lambda: texts(data_message("[" + "[]," * 5_000_000 + "[]]")),
    "many elements": lambda: texts(data_message("[" + "[]," * (_MANY - 10) + "[]]")),
    "many keys": lambda: texts(data_message("{" + ",".join(f'"k{n}":1' for n in range(_MANY)) + "}")),
    "many light texts": lambda: texts(data_message("[" + "[]," * 2000 + "[]]")),
    "nested": lambda: texts(data_message("[" * 4000 + "]" * 4000)),
    "10 MB strings": lambda: texts(data_message(json.dumps({"data": "x" * 10_000_000}))),
    "15 MB of escapes": lambda: texts(data_message(json.dumps({"data": "\xe4" * 2_500_000}))),
    "small frames": lambda: frames,
    "wrong requests": lambda: wrong_requests,
    "changes": lambda: changes,
    "images": lambda: images(png(4000, 4000)),
    "image bombs": lambda: images(png_bomb()),
    "slow reading": lambda: slow,
    "half binaries": lambda: halves,
    "binaries": lambda: binaries,
}
"""Makes each attack, by its name."""


async def attack(kind: str, url: str) -> None:
    """Attack until killed; connect again after a disconnection or a refusal."""
    chosen = KINDS[kind]()
    while True:
        try:
            await chosen(url)
        except (WebSocketException, OSError) as error:
            print(f"{type(error).__name__}: {error}", flush=True)
        await asyncio.sleep(0.1)


def burn(nice: int) -> None:
    """Use a processor at a priority until killed, without anything to do with the engine."""
    os.nice(nice)
    while True:
        _progress.add()


if __name__ == "__main__":
    if sys.argv[1] == BUSY:
        burn(int(sys.argv[2]))
    os.nice(19)  # attackers have their own machine
    uvloop.run(attack(sys.argv[1], sys.argv[2]))
